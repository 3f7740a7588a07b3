"""Rules of the access policy, without a page or a browser."""

import asyncio
import http
import socket
import threading
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="the extra viewer is not installed")

import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from dpl.viewer import AccessPolicy
from dpl.viewer import access as module
from dpl.viewer.access import MAX_MESSAGE, check_server, request_status, serve_with

PORT, TOKEN = 8123, "Token-7_x"
HOME = f"127.0.0.1:{PORT}"
LONG = 120  # time-out, which no test reaches if the server works [s]


def policy_at(host="127.0.0.1", port=PORT, allowed_hosts=()):
    """Return a policy with a stub socket that knows only its address."""
    return AccessPolicy(
        SimpleNamespace(getsockname=lambda: (host, port)), host, allowed_hosts, TOKEN
    )


def request(path=f"/{TOKEN}/", *pairs, host=HOME):
    """Return a request with one Host, and the other headers that are given."""
    headers = Headers()
    for name, value in (*([("Host", host)] if host is not None else []), *pairs):
        headers[name] = value
    return Request(path, headers)


def status(policy, *args, **more):
    """Return the status with which a request is denied; None if it is allowed."""
    denied = policy.denial_reason(request(*args, **more))
    return None if denied is None else denied[0]


# ------------------------------------------------------------------ host


@pytest.mark.parametrize(
    "host",
    [HOME, f"localhost:{PORT}", f"LocalHost:{PORT}", f"[::1]:{PORT}", f"lab-7:{PORT}"],
)
def test_loopback_names_and_allowed_hosts_are_accepted(host):
    assert status(policy_at(allowed_hosts=("lab-7",)), host=host) is None


def test_a_host_without_a_port_means_port_80():
    assert status(policy_at(port=80), host="localhost") is None
    assert status(policy_at(port=80), host="localhost:80") is None
    assert status(policy_at(), host="localhost") == 421


@pytest.mark.parametrize(
    "host",
    [
        *("", ":", f":{PORT}", "127.0.0.1", "127.0.0.1:", f"127.0.0.1:{PORT + 1}", "127.0.0.1:0"),
        *(f"127.0.0.1:00{PORT}", f"127.0.0.1:{PORT}x", f"127.0.0.1::{PORT}", f" 127.0.0.1:{PORT}"),
        *(f"a@127.0.0.1:{PORT}", f"127.0.0.1/:{PORT}", f"[127.0.0.1:{PORT}", f"::1:{PORT}"),
        *(f"[::2]:{PORT}", f"[zz]:{PORT}", f"192.168.0.7:{PORT}", f"lab-8:{PORT}"),
        f"127.0.0.1.rebound.example:{PORT}",
    ],
)
def test_other_hosts_are_denied(host):
    denied = policy_at(allowed_hosts=("lab-7",)).denial_reason(request(host=host))
    assert denied is not None
    assert denied[0] == http.HTTPStatus.MISDIRECTED_REQUEST
    assert denied[1].startswith("The requested host")


def test_a_request_without_a_host_or_with_two_is_denied():
    assert status(policy_at(), host=None) == 421
    assert status(policy_at(), f"/{TOKEN}/", ("Host", HOME)) == 421


def test_a_public_socket_accepts_any_address_and_the_names_of_this_machine(monkeypatch):
    monkeypatch.setattr(socket, "gethostname", lambda: "Bench-3")
    policy = policy_at("Lab.Example", allowed_hosts=("alias",))
    own = ["192.168.0.7", "[fe80::1]", "[FE80::ab]", "[::ffff:10.0.0.1]", "bench-3", "BENCH-3"]
    for name in [*own, "lab.example", "LAB.EXAMPLE", "alias", "localhost"]:
        assert policy.is_own_host(f"{name}:{PORT}"), name
    for name in ["rebound.example", "192.168.0.7.example", "bench-4", "300.1.1.1", "[1.2.3]"]:
        assert not policy.is_own_host(f"{name}:{PORT}"), name
    assert not policy.is_own_host(f"192.168.0.7:{PORT + 1}")


@pytest.mark.parametrize(
    ("host", "address", "everyone"),
    [
        ("127.0.0.1", "127.0.0.1", False),
        ("localhost", "localhost", False),
        ("::1", "[::1]", False),
        ("0.0.0.0", "127.0.0.1", True),
        ("::", "127.0.0.1", True),
        ("10.0.0.1", "10.0.0.1", True),
        ("fe80::1", "[fe80::1]", True),
    ],
)
def test_the_url_can_be_opened_by_a_browser_on_this_machine(host, address, everyone):
    policy = policy_at(host)
    assert policy.url == f"http://{address}:{PORT}/{TOKEN}/"
    assert policy.is_public is everyone


# ------------------------------------------------------------------ origin


UPGRADE = ("Connection", "keep-alive, Upgrade")


def test_a_socket_needs_the_origin_of_this_page_and_a_page_needs_none():
    own, foreign = ("Origin", f"http://{HOME}"), ("Origin", "http://foreign.example")
    for several in ([], [own], [own, UPGRADE], [("Connection", "keep-alive")]):
        assert status(policy_at(), f"/{TOKEN}/", *several) is None
    for several in (
        *([foreign], [UPGRADE], [foreign, UPGRADE], [own, foreign], [own, own, UPGRADE]),
        *([("Origin", "null")], [("Origin", f"https://{HOME}")], [("Origin", HOME)]),
    ):
        denied = policy_at().denial_reason(request(f"/{TOKEN}/", *several))
        assert denied is not None, several
        assert denied[0] == http.HTTPStatus.FORBIDDEN
        assert denied[1].startswith("Only the page of this server")


def test_the_origin_must_equal_the_requested_host():
    origin = ("Origin", f"http://localhost:{PORT}")
    assert status(policy_at(), f"/{TOKEN}/", origin, host=f"localhost:{PORT}") is None
    assert status(policy_at(), f"/{TOKEN}/", origin) == 403


# ------------------------------------------------------------------ the token


@pytest.mark.parametrize("rest", ["", "/", "/a.js", "/a/b?c=1", "?x=/y", "?", "//"])
def test_the_token_is_the_first_part_of_the_path(rest):
    assert status(policy_at(), f"/{TOKEN}{rest}") is None


@pytest.mark.parametrize(
    "path",
    [
        *("", "/", "//", "?", TOKEN, f"{TOKEN}/", f"//{TOKEN}/", f"/x/{TOKEN}/", f"/{TOKEN}x/"),
        *(f"/x{TOKEN}/", f"/{TOKEN[:-1]}/", f"/{TOKEN.lower()}/", f"/{TOKEN.upper()}/"),
        *(f"/?{TOKEN}", f"?token={TOKEN}", f"/{TOKEN}%2f", f"/{TOKEN}#"),
    ],
)
def test_other_paths_are_denied(path):
    denied = policy_at().denial_reason(request(path))
    assert denied is not None
    assert denied[0] == http.HTTPStatus.FORBIDDEN
    assert denied[1].startswith("The address does not contain")


# ------------------------------------------------------------------ requests that are passed on


def respond(*args, answer=None, **more):
    """Return the response to a request, and the requests that reach the handler of the page."""
    seen = []

    def handle(connection, inner):
        seen.append((connection, inner))
        return answer

    return policy_at().authenticate(handle)("connection", request(*args, **more)), seen


def test_a_denied_request_does_not_reach_the_page():
    found, seen = respond("/wrong/", answer=Response(200, "OK", Headers(), b"page"))
    assert seen == []
    assert (found.status_code, found.reason_phrase) == (403, "Forbidden")
    assert found.body == policy_at().denial_reason(request("/wrong/"))[1].encode()
    assert found.headers["Content-Length"] == str(len(found.body))
    assert found.headers["Content-Type"] == "text/plain"


@pytest.mark.parametrize(
    ("rest", "inner"),
    [("", "/"), ("/", "/"), ("/a.js", "/a.js"), ("?x=1", "/?x=1"), (f"/{TOKEN}", f"/{TOKEN}")],
)
def test_the_page_receives_requests_without_the_token(rest, inner):
    found, ((connection, seen),) = respond(f"/{TOKEN}{rest}", ("Accept", "text/html"))
    assert found is None, "no response of the handler: a socket is opened"
    assert connection == "connection"
    assert seen.path == inner
    assert list(seen.headers.raw_items()) == [("Host", HOME), ("Accept", "text/html")]


def test_every_response_has_the_security_headers():
    answer = Response(200, "OK", Headers({"Content-Type": "text/html"}), b"page")
    found, _ = respond(answer=answer)
    assert found is answer
    headers = dict(found.headers.raw_items())
    policy = headers.pop("Content-Security-Policy")
    assert headers == {
        "Content-Type": "text/html",
        "Cache-Control": "no-store",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cross-Origin-Resource-Policy": "same-origin",
    }
    directives = (part.split() for part in policy.split(";"))
    assert {name: set(sources) for name, *sources in directives} == {
        **{name: {"'none'"} for name in ("default-src", "frame-ancestors", "base-uri")},
        "form-action": {"'none'"},
        "script-src": {"'unsafe-inline'", "'unsafe-eval'", "blob:", "data:"},
        "style-src": {"'unsafe-inline'"},
        "img-src": {"data:", "blob:"},
        "font-src": {"data:"},
        "connect-src": {"'self'", f"ws://{HOME}", "data:", "blob:"},
        "worker-src": {"blob:", "data:"},
    }


# ------------------------------------------------------------------ socket and server


@pytest.mark.parametrize(
    ("host", "family"), [("127.0.0.1", socket.AF_INET), ("::1", socket.AF_INET6)]
)
def test_a_socket_is_bound_to_host_and_port(host, family):
    try:
        policy = AccessPolicy.bind(host, 0, ["Lab-7", "x"])
    except OSError:
        pytest.skip(f"this machine has no {host}")
    with policy.socket as bound:
        assert bound.family == family
        assert bound.type == socket.SOCK_STREAM
        assert bound.getsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR)
        assert bound.getsockname()[:2] == (host, policy.port)
        assert (policy.host, policy.allowed_hosts) == (host, ("lab-7", "x"))


def test_a_policy_has_no_allowed_hosts_and_a_random_token_by_default():
    with AccessPolicy.bind("127.0.0.1", 0).socket as bound:
        policies = [AccessPolicy(bound, "127.0.0.1") for _ in range(2)]
    assert [policy.allowed_hosts for policy in policies] == [(), ()]
    assert policies[0].token != policies[1].token
    assert policies[0].token not in repr(policies[0])
    assert all(len(policy.token) == 32 for policy in policies)  # 24 bytes in base 64


def test_a_port_in_use_raises_an_error_and_closes_the_socket(monkeypatch):
    made = []

    class Recorded(socket.socket):
        def __init__(self, *args):
            super().__init__(*args)
            made.append(self)

    with socket.create_server(("127.0.0.1", 0)) as other:
        monkeypatch.setattr(socket, "socket", Recorded)
        with pytest.raises(OSError, match="in use"):
            AccessPolicy.bind("127.0.0.1", other.getsockname()[1])
    assert made[0].fileno() == -1


def test_a_server_uses_socket_and_rules_of_the_policy(monkeypatch):
    calls, policy = [], policy_at()

    def original(handler, **options):
        calls.append((handler, options))
        return "server"

    monkeypatch.setattr(websockets.asyncio.server, "serve", original)

    async def start():
        return websockets.asyncio.server.serve(
            "handler", "0.0.0.0", 1, process_request=lambda *_: "passed", compression=None
        )

    with serve_with(policy):
        assert asyncio.run(start()) == "server"
    assert websockets.asyncio.server.serve is original
    ((handler, options),) = calls
    assert handler == "handler"
    assert options["sock"] is policy.socket
    assert options["max_size"] == MAX_MESSAGE == 2**18
    assert options["server_header"] is None
    assert options["compression"] is None
    assert options["process_request"](None, request("/wrong/")).status_code == 403
    with pytest.raises(
        AttributeError
    ):  # "passed" is not a response: the handler of the page was called
        options["process_request"](None, request())


def test_an_error_restores_the_websockets_server():
    original = websockets.asyncio.server.serve

    def fail():
        with serve_with(policy_at()):
            assert websockets.asyncio.server.serve is not original
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        fail()
    assert websockets.asyncio.server.serve is original


def respond_once(listening, answer):
    """Respond to one request; return the thread, and the list to which the request is added."""
    seen = []

    def serve():
        call, _ = listening.accept()
        with call:
            seen.append(call.recv(4096))
            call.sendall(answer)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    return thread, seen


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_the_status_of_a_request_is_that_of_the_response(host):
    with socket.create_server((host, 0)) as listening:
        thread, seen = respond_once(listening, b"HTTP/1.1 418 I'm a teapot\r\n\r\n")
        found = request_status(
            AccessPolicy(listening, host), "/a?b", Host="x:1", Sec_WebSocket_Key="k"
        )
        thread.join(LONG)
    assert found == 418
    assert seen == [b"GET /a?b HTTP/1.1\r\nHost: x:1\r\nSec-WebSocket-Key: k\r\n\r\n"]


def test_a_public_socket_is_tested_through_the_loopback(monkeypatch):
    requests = []

    def denied(address, timeout):
        requests.append(address)
        assert 0 < timeout < LONG, "a server without a response causes a time-out"
        raise ConnectionRefusedError

    monkeypatch.setattr(socket, "create_connection", denied)
    for host in ("::", "0.0.0.0", "10.0.0.1"):
        with pytest.raises(ConnectionRefusedError):
            request_status(policy_at(host), "/")
    assert requests == [("::1", PORT), ("127.0.0.1", PORT), ("10.0.0.1", PORT)]


# ------------------------------------------------------------------ check of the server


def checked_requests(monkeypatch, wrong=None):
    """Check a server that follows its policy except for one case; return the requests."""
    requests = []

    def by_rule(policy, path, **headers):
        requests.append((path, headers))
        denied = policy.denial_reason(request(path, *headers.items(), host=None))
        status = 200 if denied is None else int(denied[0])
        if len(requests) - 1 == wrong:
            return 403 if status == 200 else 200
        return status

    monkeypatch.setattr(module, "request_status", by_rule)
    check_server(policy_at())
    return requests


def test_the_check_contains_an_allowed_request_and_each_kind_of_denied_one(monkeypatch):
    requests = checked_requests(monkeypatch)
    without_token = [path for path, _ in requests if TOKEN not in path]
    hosts = {headers["Host"] for _, headers in requests}
    origins = {headers.get("Origin") for _, headers in requests if "Upgrade" in headers}
    assert without_token
    assert any(host not in (HOME, f"localhost:{PORT}") for host in hosts)
    assert None in origins
    assert any(origin and HOME not in origin for origin in origins)
    for _, headers in requests:
        upgrade = {name: headers[name] for name in ("Connection", "Upgrade") if name in headers}
        assert upgrade in ({}, {"Connection": "Upgrade", "Upgrade": "websocket"})


@pytest.mark.parametrize("wrong", range(5))
def test_a_server_with_one_wrong_response_is_not_started(monkeypatch, wrong):
    with pytest.raises(RuntimeError, match="access control"):
        checked_requests(monkeypatch, wrong)
