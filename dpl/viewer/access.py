"""Access control of the viewer: a token in the path, names of this host, and its own page only.

A page from elsewhere in the same browser can send requests to 127.0.0.1, and a host name of an
attacker can be resolved to 127.0.0.1 (DNS rebinding). Every request must therefore contain the
token and name this host, and a web socket must be opened by the page of this server.
"""

import asyncio
import contextlib
import hmac
import http
import inspect
import ipaddress
import logging
import math
import re
import secrets
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import websockets.asyncio.server
from websockets.http11 import Request, Response

RequestHandler = Callable[[Any, Request], Response | None]
MAX_MESSAGE = 2**18  # largest message from the browser [bytes]
LOOPBACK = ("127.0.0.1", "localhost", "::1")
HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    # All scripts are in the page; those that Emscripten generated need 'unsafe-eval'. Other hosts
    # are not reachable.
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; "
        "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; "
        "connect-src 'self' {sockets} data: blob:; worker-src blob: data:; "
        "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    ),
}
MIN_INTERVAL = 1.0  # shortest time between two lines [s]
MAX_CHARACTERS = 200  # longest message


class RateLimitedHandler(logging.Handler):
    """Handler of log records that prints one line per record, without a traceback.

    A browser decides how often requests fail and can influence the text of errors. Lines within
    `MIN_INTERVAL` of the last one are counted and not printed. Lines are shortened and contain no
    control characters. `logger` has this handler only.
    """

    def __init__(self) -> None:
        """Create the handler and its logger."""
        super().__init__(logging.ERROR)
        self.logger = logging.Logger("dpl.viewer", logging.ERROR)
        self.logger.addHandler(self)
        self._last_line, self._n_omitted = -math.inf, 0

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record and its exception in one line, or count it if the last is too recent.

        `logging.Handler.handle` calls this method under a lock.
        """
        now = time.monotonic()
        if now - self._last_line < MIN_INTERVAL:
            self._n_omitted += 1
            return
        omitted = f" ({self._n_omitted} more were not printed)" if self._n_omitted else ""
        self._last_line, self._n_omitted = now, 0
        error = record.exc_info[1] if record.exc_info else None
        cause = "" if error is None else f": {type(error).__name__}: {error}"
        line = "".join(c if c.isprintable() else " " for c in f"{record.getMessage()}{cause}")
        line = " ".join(line.split())[:MAX_CHARACTERS].encode("ascii", "backslashreplace").decode()
        print(f"warning: browser request failed: {line}{omitted}", file=sys.stderr, flush=True)

    def catch_errors(self, callback: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """Return a callback, or a coroutine function, whose exceptions are reported here."""
        if not inspect.iscoroutinefunction(callback):
            return self._report_errors()(callback)

        async def call(event: Any) -> None:
            with self._report_errors():
                await callback(event)

        return call

    @contextlib.contextmanager
    def _report_errors(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # no request of a browser may stop the server
            self.logger.error("control", exc_info=error)


@dataclass(frozen=True, eq=False)
class AccessPolicy:
    """A bound socket and the rules for requests to it.

    Attributes:
        socket: Bound socket that does not listen yet.
        host: Host name or address to which it is bound.
        allowed_hosts: Names of this host that requests may use besides those of the loopback.
        token: First part of the path of every request.
        log: Handler that prints failed requests.
    """

    socket: socket.socket
    host: str
    allowed_hosts: tuple[str, ...] = ()
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)
    log: RateLimitedHandler = field(default_factory=RateLimitedHandler, repr=False)

    @classmethod
    def bind(cls, host: str, port: int, allowed_hosts: Sequence[str] = ()) -> "AccessPolicy":
        """Return the policy of a socket bound to a host and a port; port 0: any free one."""
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with contextlib.ExitStack() as on_error:
            bound = on_error.enter_context(socket.socket(family, socket.SOCK_STREAM))
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bound.bind((host, port))
            on_error.pop_all()
        return cls(bound, host, tuple(name.lower() for name in allowed_hosts))

    @property
    def port(self) -> int:
        """Port of the socket."""
        return int(self.socket.getsockname()[1])

    @property
    def is_public(self) -> bool:
        """True if other machines can reach the socket."""
        return self.host not in LOOPBACK

    @property
    def url(self) -> str:
        """Address of the page for the browser, with the token."""
        shown = "127.0.0.1" if self.host in ("0.0.0.0", "::") else self.host
        shown = f"[{shown}]" if ":" in shown else shown
        return f"http://{shown}:{self.port}/{self.token}/"

    def denial_reason(self, request: Request) -> tuple[http.HTTPStatus, str] | None:
        """Return status and message for a request that is denied; None if it is allowed."""
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if len(hosts) != 1 or not self.is_own_host(hosts[0]):
            return http.HTTPStatus.MISDIRECTED_REQUEST, "The requested host is not this one.\n"
        own = [f"http://{hosts[0]}"]
        upgrade = "upgrade" in ",".join(request.headers.get_all("Connection")).lower()
        if origins != own and (upgrade or origins):
            return http.HTTPStatus.FORBIDDEN, "Only the page of this server may open a socket.\n"
        parts = re.split("[/?]", request.path, maxsplit=2)[1:2] or [""]
        found = parts[0].encode("ascii", "surrogateescape")  # websockets decodes paths this way
        if not hmac.compare_digest(found, self.token.encode()):
            return http.HTTPStatus.FORBIDDEN, "The address does not contain the printed token.\n"
        return None

    def authenticate(self, handle: RequestHandler) -> RequestHandler:
        """Return a request handler that passes allowed requests on, without the token."""

        def handle_allowed(connection: Any, request: Request) -> Response | None:
            if denied := self.denial_reason(request):
                return connection.respond(*denied)
            path = request.path.removeprefix(f"/{self.token}")
            inner = Request(path if path.startswith("/") else "/" + path, request.headers)
            try:
                response = handle(connection, inner)
            except (LookupError, OSError, ValueError):  # a repeated header or a path too long
                return connection.respond(
                    http.HTTPStatus.BAD_REQUEST, "The request is malformed.\n"
                )
            if response is not None:
                sockets = f"ws://{request.headers['Host']}"
                for name, value in HEADERS.items():
                    response.headers[name] = value.replace("{sockets}", sockets)
            return response

        return handle_allowed

    def is_own_host(self, host: str) -> bool:
        """Return True if the value of a Host header names this host and port."""
        found = re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[^:\[\]/@]+)(?::([0-9]{1,5}))?", host)
        if found is None or int(found[2] or 80) != self.port:
            return False
        name = found[1].strip("[]").lower()
        if name in (*LOOPBACK, *self.allowed_hosts):
            return True
        if not self.is_public:
            return False
        try:  # DNS rebinding needs a name; a numeric address is safe
            ipaddress.ip_address(name)
        except ValueError:
            return name in (self.host.lower(), socket.gethostname().lower())
        return True


@contextlib.contextmanager
def serve_with(policy: AccessPolicy) -> Iterator[None]:
    """Apply a policy to the websockets server that is started in this context.

    viser calls `websockets.asyncio.server.serve` and has no option for access control, so that this
    function is replaced while viser starts. An error is raised if it was not called.
    """
    original, started = websockets.asyncio.server.serve, False

    def serve(
        handler: Any, host: str, port: int, *, process_request: RequestHandler, **options: Any
    ) -> Any:
        nonlocal started
        started = True
        options |= {"max_size": MAX_MESSAGE, "server_header": None, "logger": policy.log.logger}
        asyncio.get_running_loop().set_exception_handler(
            lambda loop, context: policy.log.logger.error(
                context["message"], exc_info=context.get("exception")
            )
        )
        authenticated = policy.authenticate(process_request)
        return original(handler, sock=policy.socket, process_request=authenticated, **options)

    websockets.asyncio.server.serve = serve
    try:
        yield
    finally:
        websockets.asyncio.server.serve = original
    if not started:
        raise RuntimeError("access control: viser started another server; the page is not served")
