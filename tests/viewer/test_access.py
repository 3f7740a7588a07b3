"""Access control: the rules of a policy, and a running server that follows them."""

import asyncio
import contextlib
import gc
import math
import socket
import threading
from http.client import HTTPConnection
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="the extra viewer is not installed")

import msgspec
import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.server import ServerProtocol
from websockets.sync.client import connect

from dpl.viewer import AccessPolicy
from dpl.viewer.access import (
    MAX_CHARACTERS,
    MAX_MESSAGE,
    MIN_INTERVAL,
    RateLimitedHandler,
    serve_with,
)

LONG = 120  # time-out, which no test reaches if the server works [s]
PORT, TOKEN = 8123, "Token-7_x"
HOME = f"127.0.0.1:{PORT}"
UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
}
OTHER_HOST = 421, "The requested host"
OTHER_PAGE = 403, "Only the page of this server"
NO_TOKEN = 403, "The address does not contain"


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


# ------------------------------------------------------------------ the rules

OWN, FOREIGN = ("Origin", f"http://{HOME}"), ("Origin", "http://foreign.example")
OPEN = ("Connection", "keep-alive, Upgrade")
ALLOWED = [
    *(request(host=host) for host in (HOME, f"localhost:{PORT}", f"LocalHost:{PORT}")),
    *(request(host=host) for host in (f"[::1]:{PORT}", f"lab-7:{PORT}")),
    *(request(f"/{TOKEN}{rest}") for rest in ("", "/a.js", "/a/b?c=1", "?x=/y", "?", "//")),
    *(request(f"/{TOKEN}/", *more) for more in ([OWN], [OWN, OPEN], [("Connection", "x")])),
    request(f"/{TOKEN}/", ("Origin", f"http://localhost:{PORT}"), host=f"localhost:{PORT}"),
]
DENIED = [
    *((request(host=host), OTHER_HOST) for host in (
        *("", ":", f":{PORT}", "127.0.0.1", "127.0.0.1:", f"127.0.0.1:{PORT + 1}", "127.0.0.1:0"),
        *(f"127.0.0.1:00{PORT}", f"127.0.0.1:{PORT}x", f"127.0.0.1::{PORT}", f" 127.0.0.1:{PORT}"),
        *(f"a@127.0.0.1:{PORT}", f"127.0.0.1/:{PORT}", f"[127.0.0.1:{PORT}", f"::1:{PORT}"),
        *(f"[::2]:{PORT}", f"[zz]:{PORT}", f"192.168.0.7:{PORT}", f"lab-8:{PORT}", "localhost"),
        *(f"127.0.0.1.rebound.example:{PORT}", f"127.0.0.1:{PORT}@rebound.example:{PORT}", None),
    )),
    (request(f"/{TOKEN}/", ("Host", HOME)), OTHER_HOST),  # two of them
    *((request(f"/{TOKEN}/", *more), OTHER_PAGE) for more in (
        *([FOREIGN], [OPEN], [FOREIGN, OPEN], [OWN, FOREIGN], [OWN, OWN, OPEN]),
        *([("Origin", "null")], [("Origin", f"https://{HOME}")], [("Origin", HOME)]),
        [("Origin", f"http://localhost:{PORT}")],
    )),
    *((request(path), NO_TOKEN) for path in (
        *("", "/", "//", "?", TOKEN, f"{TOKEN}/", f"//{TOKEN}/", f"/x/{TOKEN}/", f"/{TOKEN}x/"),
        *(f"/x{TOKEN}/", f"/{TOKEN[:-1]}/", f"/{TOKEN.lower()}/", f"/{TOKEN.upper()}/"),
        *(f"/?{TOKEN}", f"?token={TOKEN}", f"/{TOKEN}%2f", f"/{TOKEN}#", "/%2e%2e/"),
    )),
]  # fmt: skip


def test_requests_of_this_page_are_allowed_and_others_denied_with_their_reason():
    policy = policy_at(allowed_hosts=("lab-7",))
    for allowed in ALLOWED:
        assert policy.denial_reason(allowed) is None, allowed
    for denied, reason in DENIED:
        status, text = policy.denial_reason(denied)
        assert status == reason[0], denied
        assert text.startswith(reason[1]), denied


def test_a_host_without_a_port_means_port_80():
    assert policy_at(port=80).is_own_host("localhost")
    assert policy_at(port=80).is_own_host("localhost:80")


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
        *(("127.0.0.1", "127.0.0.1", False), ("localhost", "localhost", False)),
        *(("::1", "[::1]", False), ("0.0.0.0", "127.0.0.1", True), ("::", "127.0.0.1", True)),
        *(("10.0.0.1", "10.0.0.1", True), ("fe80::1", "[fe80::1]", True)),
    ],
)
def test_the_url_can_be_opened_by_a_browser_on_this_machine(host, address, everyone):
    policy = policy_at(host)
    assert policy.url == f"http://{address}:{PORT}/{TOKEN}/"
    assert policy.is_public is everyone


def respond(*args, answer=None, **more):
    """Return the response to a request, and the requests that reach the handler of the page."""
    seen, connection = [], SimpleNamespace(respond=ServerProtocol().reject)

    def handle(own, inner):
        assert own is connection
        seen.append(inner)
        return answer

    return policy_at().authenticate(handle)(connection, request(*args, **more)), seen


def test_a_denied_request_does_not_reach_the_page():
    found, seen = respond("/wrong/", answer=Response(200, "OK", Headers(), b"page"))
    assert seen == []
    assert (found.status_code, found.reason_phrase) == (403, "Forbidden")
    assert found.body == policy_at().denial_reason(request("/wrong/"))[1].encode()
    assert found.headers["Content-Type"].startswith("text/plain")


@pytest.mark.parametrize(
    ("rest", "inner"),
    [("", "/"), ("/", "/"), ("/a.js", "/a.js"), ("?x=1", "/?x=1"), (f"/{TOKEN}", f"/{TOKEN}")],
)
def test_the_page_receives_requests_without_the_token(rest, inner):
    found, (seen,) = respond(f"/{TOKEN}{rest}", ("Accept", "text/html"))
    assert found is None, "no response of the handler: a socket is opened"
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


@pytest.mark.parametrize(
    ("host", "family"), [("127.0.0.1", socket.AF_INET), ("::1", socket.AF_INET6)]
)
def test_a_socket_is_bound_to_host_and_port_with_a_random_token(host, family):
    try:
        policy = AccessPolicy.bind(host, 0, ["Lab-7", "x"])
    except OSError:
        pytest.skip(f"this machine has no {host}")
    with policy.socket as bound:
        assert (bound.family, bound.type) == (family, socket.SOCK_STREAM)
        assert bound.getsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR)
        assert bound.getsockname()[:2] == (host, policy.port)
        assert (policy.host, policy.allowed_hosts) == (host, ("lab-7", "x"))
        other = AccessPolicy(bound, host)
    assert other.allowed_hosts == ()
    assert other.token != policy.token
    assert other.token not in repr(other)
    assert len(other.token) == 32  # 24 random bytes in base 64


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


def test_an_error_restores_the_websockets_server_and_no_other_server_serves_a_page():
    original = websockets.asyncio.server.serve

    def fail(error=None):
        with serve_with(policy_at()):
            assert websockets.asyncio.server.serve is not original
            if error is not None:
                raise error

    for error, words in ((RuntimeError("stop"), "stop"), (None, "viser started another server")):
        with pytest.raises(RuntimeError, match=words):
            fail(error)
        assert websockets.asyncio.server.serve is original


# ------------------------------------------------------------------ a running server


@pytest.fixture(scope="module")
def served(body, make_page, tmp_path_factory):
    """A page for all tests, none of which changes it."""
    page = make_page(body, tmp_path_factory.mktemp("view"))
    yield page
    page.close()


@pytest.fixture
def policy(served):
    """Access policy of the page, whose next failure is printed."""
    served._policy.log._last_line = -math.inf
    return served._policy


def home(policy):
    return f"127.0.0.1:{policy.port}"


def request_status(policy, path, headers):
    """Return the HTTP status of a request."""
    with contextlib.closing(HTTPConnection("127.0.0.1", policy.port, timeout=LONG)) as connection:
        connection.request("GET", path, headers=headers)
        return connection.getresponse().status


def test_the_server_follows_the_rules(policy):
    path, own = f"/{policy.token}/", {"Host": home(policy)}
    origin = {"Origin": f"http://{home(policy)}"}
    assert policy.socket.getsockname()[0] == "127.0.0.1"
    for status, path_, headers in (
        (200, path, own),
        (200, path, {"Host": f"localhost:{policy.port}"}),
        (404, path + "nothing-here.js", own),
        (101, path[:-1], {**own, **origin, **UPGRADE}),
        *((403, wrong, own) for wrong in ("/", "/x/", f"/{policy.token[:-1]}/", "/?token=x")),
        (403, "/", {**own, **origin, **UPGRADE}),
        (403, path, {**own, **UPGRADE}),
        (403, path, {**own, **UPGRADE, "Origin": "http://foreign.example"}),
        (421, path, {"Host": f"rebound.example:{policy.port}"}),
    ):
        assert request_status(policy, path_, headers) == status, (path_, headers)


def raw_status(policy, path, headers=b""):
    """Return the status of the response to a request with these bytes."""
    with socket.create_connection(("127.0.0.1", policy.port), timeout=LONG) as call:
        host = f"Host: {home(policy)}\r\n".encode()
        call.sendall(b"GET " + path + b" HTTP/1.1\r\n" + host + headers + b"\r\n")
        return int(call.recv(4096).decode("latin1").split()[1])


def test_paths_without_the_token_or_a_file_are_denied_without_an_error(policy, capfd):
    no_tokens = (
        "/\u00e9/",
        "/\u00e9",
        "/{}\u00e9/",
        "/\u00e9{}/",
        "/\U0001f600/",
        "/\udcff/",
        "/?\u00e9",
    )
    for path in no_tokens:
        path = path.format(policy.token).encode("utf-8", "surrogateescape")
        assert raw_status(policy, path) == 403, path
    for more in ("\u00e9", "%00", "%ff", "x" * 5000, "../" * 9, "%2e%2e/x"):
        assert raw_status(policy, f"/{policy.token}/{more}".encode()) in (400, 404), more
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("name", ["Connection", "Accept-Encoding", "Upgrade", "Origin", "Host"])
def test_a_repeated_header_causes_no_error(policy, capfd, name):
    twice = f"{name}: x\r\n{name}: y\r\n".encode()
    found = raw_status(policy, f"/{policy.token}/".encode(), twice)
    assert found == {"Host": 421, "Origin": 403, "Connection": 200}.get(name, 400)
    assert capfd.readouterr().err == ""


def test_a_browser_cannot_open_a_tunnel(served):
    assert served.server.request_share_url() is None
    assert served.server._share_tunnel is None


# ------------------------------------------------------------------ invalid messages


def connected(policy):
    """Return a socket of the page."""
    return connect(
        policy.url.replace("http", "ws"),
        origin=f"http://{home(policy)}",
        subprotocols=[f"viser-v{viser.__version__}"],
        max_size=None,
        open_timeout=LONG,
    )


def closing_code(policy, message):
    """Send a message; receive until the server closes the connection and return its code."""
    with connected(policy) as call:
        call.send(message)
        try:
            while True:
                call.recv(timeout=LONG)
        except ConnectionClosed as closed:
            return closed.rcvd and closed.rcvd.code


@pytest.fixture
def failures(policy, monkeypatch):
    """Reported failures of the page: a list, and an event that is set by each new one."""
    seen, original = SimpleNamespace(all=[], added=threading.Event()), policy.log.emit

    def add(record):
        original(record)
        seen.all.append(record)
        seen.added.set()

    monkeypatch.setattr(policy.log, "emit", add)
    return seen


def packed(kind, **fields):
    return msgspec.msgpack.encode({"type": kind, **fields})


def test_a_message_is_read_up_to_the_largest_size(policy, failures):
    assert closing_code(policy, b"x" * (MAX_MESSAGE + 1)) == 1009, "too long"
    whole = packed("GuiModalMessage", title="x" * MAX_MESSAGE)[:MAX_MESSAGE]
    assert closing_code(policy, whole) == 1011, "the message was read and is invalid"


GARBAGE = {
    "text": "hello",
    "nothing": b"",
    "no msgpack": b"\xc1\xff\x00",
    "no mapping": msgspec.msgpack.encode([1, 2]),
    "no type": msgspec.msgpack.encode({"a": 1}),
    "unknown type": packed("\x1b[31m[bold]" + "x" * 5000),
    "unknown field": packed("GuiUpdateMessage", foo=1),
}


@pytest.mark.parametrize("message", GARBAGE.values(), ids=GARBAGE)
def test_an_invalid_message_closes_its_connection_and_prints_one_line(
    policy, failures, capfd, message
):
    closing_code(policy, message)
    assert failures.added.wait(LONG)
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("warning: browser request failed: connection handler failed: ")
    assert line.isascii()
    assert line.isprintable()
    assert len(line) < MAX_CHARACTERS + 60
    others = request_status(policy, f"/{policy.token}/", {"Host": home(policy)})
    assert others == 200


@pytest.mark.parametrize("update", [{"value": "x"}, {"no_such_thing": 1}, {"value": None}])
def test_an_invalid_value_of_a_control_prints_one_line(served, policy, failures, capfd, update):
    slider = served.controls.amplitude
    before = slider.value
    with connected(policy) as call:
        call.send(packed("GuiUpdateMessage", uuid=slider._impl.uuid, updates=update))
        while not failures.added.wait(0.1):
            gc.collect()  # an error of a task is reported once the task is collected
    assert slider.value == before
    err = capfd.readouterr().err
    assert err.count("\n") == 1
    assert err.startswith("warning: browser request failed: ")


def test_an_error_in_a_callback_prints_one_line(served, policy, capfd, monkeypatch):
    now = 0.0
    clock = SimpleNamespace(monotonic=lambda: now)
    monkeypatch.setattr("dpl.viewer.access.time", clock)
    monkeypatch.setattr(served, "_submit", None)  # every call fails
    monkeypatch.setattr(served.worker, "submit", None)
    event = SimpleNamespace(client=object(), target=SimpleNamespace(value="VTU"))
    of_load = "direction", "amplitude", "axis", "angle"
    for name in (*of_load, "young", "edges", "show_newton"):
        (callback,) = getattr(served.controls, name)._impl.update_cb
        callback(event)
        now += MIN_INTERVAL
        (line,) = capfd.readouterr().err.splitlines()
        assert line.startswith("warning: browser request failed: control: TypeError: ")


def test_errors_of_functions_and_coroutines_are_reported(capfd):
    async def awaited(event):
        raise ZeroDivisionError(event)

    def called(event):
        raise ZeroDivisionError(event)

    asyncio.run(RateLimitedHandler().catch_errors(awaited)("far\naway"))
    RateLimitedHandler().catch_errors(called)("far\naway")
    RateLimitedHandler().logger.warning("slow")
    failures = "warning: browser request failed: control: ZeroDivisionError: far away"
    assert capfd.readouterr().err.splitlines() == [failures, failures], "no warning"


def test_one_line_per_second_is_printed_and_others_are_counted(capfd, monkeypatch):
    now = 5.0
    clock = SimpleNamespace(monotonic=lambda: now)
    monkeypatch.setattr("dpl.viewer.access.time", clock)
    complaints = RateLimitedHandler()
    lines = []
    for step in (0.0, 0.25, MIN_INTERVAL - 0.25 - 2**-20, 2**-20, 0.5, 3.0, 0.0):
        now += step
        complaints.logger.error("it failed")
        lines.append(capfd.readouterr().err)
    plain = "warning: browser request failed: it failed"
    assert lines == [
        *(f"{plain}\n", "", "", f"{plain} (2 more were not printed)\n"),
        *("", f"{plain} (1 more were not printed)\n", ""),
    ]
