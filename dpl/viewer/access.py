"""Who may come in: a token in the path, names of this host, pages of its own; nobody else.

A page in the same browser can send requests to 127.0.0.1, and a name that an attacker owns can be
made to point there (DNS rebinding). So every request must bring the token, ask for a host that is
this one, and open its socket from this page.
"""

import asyncio
import contextlib
import hmac
import http
import ipaddress
import re
import secrets
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from dpl.viewer.rate_limited_log import RateLimitedHandler

Handle = Callable[[Any, Request], Response | None]
LARGEST = 2**18  # bytes of a message from the browser
HOME = ("127.0.0.1", "localhost", "::1")
HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    # the page holds its scripts itself, some of which Emscripten made and which call Function();
    # nothing may be fetched from anywhere else
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; "
        "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; "
        "connect-src 'self' {sockets} data: blob:; worker-src blob: data:; "
        "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    ),
}


@dataclass(frozen=True, eq=False)
class AccessPolicy:
    """A bound socket and the rule of who may come through it.

    Attributes:
        socket: Bound, not listening yet.
        host: Where it is bound.
        names: Names of this host, besides those of the loopback, that may be asked for.
        token: What the path begins with.
        complaints: Prints what goes wrong with requests.
    """

    socket: socket.socket
    host: str
    names: tuple[str, ...] = ()
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)
    complaints: RateLimitedHandler = field(default_factory=RateLimitedHandler, repr=False)

    @classmethod
    def bound(cls, host: str, port: int, names: Sequence[str] = ()) -> "AccessPolicy":
        """Return the door at a port of a host, 0: any that is free.

        Raises:
            OSError: It is taken, or there is no such host.
        """
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        bound = socket.socket(family, socket.SOCK_STREAM)
        try:
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bound.bind((host, port))
        except OSError:
            bound.close()
            raise
        return cls(bound, host, tuple(name.lower() for name in names))

    @property
    def port(self) -> int:
        """Where it is."""
        return int(self.socket.getsockname()[1])

    @property
    def open_to_all(self) -> bool:
        """Whether other machines can reach it."""
        return self.host not in HOME

    @property
    def address(self) -> str:
        """What is typed into the browser."""
        shown = "127.0.0.1" if self.host in ("0.0.0.0", "::") else self.host
        shown = f"[{shown}]" if ":" in shown else shown
        return f"http://{shown}:{self.port}/{self.token}/"

    def refusal(self, request: Request) -> tuple[http.HTTPStatus, str] | None:
        """Return why a request is refused; None: it is not."""
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if len(hosts) != 1 or not self._ours(hosts[0]):
            return http.HTTPStatus.MISDIRECTED_REQUEST, "This is not the host you asked for.\n"
        own = [f"http://{hosts[0]}"]
        upgrade = "upgrade" in ",".join(request.headers.get_all("Connection")).lower()
        if origins != own and (upgrade or origins):
            return http.HTTPStatus.FORBIDDEN, "Only this page's own socket is served.\n"
        token = re.split("[/?]", request.path, maxsplit=2)[1:2] or [""]
        given = token[0].encode("ascii", "surrogateescape")  # as websockets has decoded it
        if not hmac.compare_digest(given, self.token.encode()):
            return http.HTTPStatus.FORBIDDEN, "The address lacks the token that was printed.\n"
        return None

    def guarding(self, handle: Handle) -> Handle:
        """Return a handler of requests that lets through what is not refused, without the token."""

        def guarded(connection: Any, request: Request) -> Response | None:
            refused = self.refusal(request)
            if refused is not None:
                return _answer(*refused)
            path = request.path.removeprefix(f"/{self.token}")
            inner = Request(path if path.startswith("/") else "/" + path, request.headers)
            try:
                response = handle(connection, inner)
            except (LookupError, OSError, ValueError):  # two of a header, or a path too long
                return _answer(http.HTTPStatus.BAD_REQUEST, "The request cannot be read.\n")
            if response is not None:
                for name, value in HEADERS.items():
                    host = request.headers["Host"]
                    response.headers[name] = value.replace("{sockets}", f"ws://{host}")
            return response

        return guarded

    def _ours(self, host: str) -> bool:
        """Return whether the Host of a request is this one."""
        found = re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[^:\[\]/@]+)(?::([0-9]{1,5}))?", host)
        if found is None or int(found[2] or 80) != self.port:
            return False
        name = found[1].strip("[]").lower()
        if name in (*HOME, *self.names):
            return True
        if not self.open_to_all:
            return False
        try:  # an address is no name, and cannot be made to point elsewhere
            ipaddress.ip_address(name)
        except ValueError:
            return name in (self.host.lower(), socket.gethostname().lower())
        return True


def _answer(status: http.HTTPStatus, words: str) -> Response:
    body = words.encode()
    headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(body))})
    return Response(status.value, status.phrase, headers, body)


@contextlib.contextmanager
def serve_with(door: AccessPolicy) -> Iterator[None]:
    """Let a server that is started in here take its requests through a door.

    viser starts `websockets.asyncio.server.serve` itself and has no option for who may connect.
    """
    genuine = websockets.asyncio.server.serve

    def serve(handler: Any, host: str, port: int, *, process_request: Handle, **more: Any) -> Any:
        more |= {"max_size": LARGEST, "server_header": None, "logger": door.complaints.logger}
        asyncio.get_running_loop().set_exception_handler(
            lambda loop, told: door.complaints.add(told["message"], told.get("exception"))
        )
        return genuine(
            handler, sock=door.socket, process_request=door.guarding(process_request), **more
        )

    websockets.asyncio.server.serve = serve
    try:
        yield
    finally:
        websockets.asyncio.server.serve = genuine


def status_for(door: AccessPolicy, path: str, **headers: str) -> int:
    """Return the status that a door answers a request of this machine with."""
    lines = [f"GET {path} HTTP/1.1"]
    lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(door.host, door.host)
    with socket.create_connection((host, door.port), timeout=60) as call:
        call.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        return int(call.recv(64).split()[1])


def check(door: AccessPolicy) -> None:
    """Try a door from outside.

    Raises:
        RuntimeError: It lets in whom it must not, or not whom it must.
    """
    home = f"127.0.0.1:{door.port}"
    path = f"/{door.token}/"
    socket_of = {"Connection": "Upgrade", "Upgrade": "websocket"}
    cases = [
        (200, path, {"Host": home}),
        (403, "/", {"Host": home}),
        (421, path, {"Host": f"rebound.example:{door.port}"}),
        (403, path, {"Host": home, "Origin": "http://foreign.example", **socket_of}),
        (403, path, {"Host": home, **socket_of}),
    ]
    for status, path, headers in cases:
        if (found := status_for(door, path, **headers)) != status:
            raise RuntimeError(f"the page is not safe: {found} where {status} must be; not served")
