"""Access control of a running server, tested with real sockets."""

import asyncio
import gc
import math
import socket
import threading
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="the extra viewer is not installed")

import msgspec
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from dpl.viewer import AccessPolicy, Page
from dpl.viewer.access import (
    MAX_CHARACTERS,
    MAX_MESSAGE,
    MIN_INTERVAL,
    RateLimitedHandler,
    check_server,
    request_status,
)

LONG = 120  # time-out, which no test reaches if the server works [s]
UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec_WebSocket_Version": "13",
    "Sec_WebSocket_Protocol": f"viser-v{viser.__version__}",
}


@pytest.fixture(scope="module")
def served(body, tmp_path_factory):
    """A page for all tests, none of which changes it."""
    folder = tmp_path_factory.mktemp("view")
    page = Page(body, AccessPolicy.bind("127.0.0.1", 0), title="tiny", folder=folder)
    yield page
    page.close()


@pytest.fixture
def policy(served):
    """Access policy of the page, whose next failure is printed."""
    served._policy.log._last_line = -math.inf
    return served._policy


def home(policy):
    return f"127.0.0.1:{policy.port}"


def test_the_page_and_its_socket_are_served_at_their_address(policy):
    path, own = f"/{policy.token}/", {"Host": home(policy)}
    assert policy.socket.getsockname()[0] == "127.0.0.1"
    assert not policy.is_public
    for host in (home(policy), f"localhost:{policy.port}"):
        assert request_status(policy, path, Host=host) == 200
    assert request_status(policy, path + "nothing-here.js", **own) == 404
    origin = f"http://{home(policy)}"
    assert request_status(policy, path[:-1], **own, Origin=origin, **UPGRADE) == 101
    for wrong in (policy.token[:-1], policy.token + "x", policy.token.swapcase()):
        assert request_status(policy, f"/{wrong}/", **own) == 403
    check_server(policy)


@pytest.mark.parametrize("path", ["/", "/x/", "/?token=x", "//", "/%2e%2e/", "/index.html"])
def test_requests_without_the_token_are_denied(policy, path):
    assert request_status(policy, path, Host=home(policy)) == 403
    origin = f"http://{home(policy)}"
    assert request_status(policy, path, Host=home(policy), Origin=origin, **UPGRADE) == 403


@pytest.mark.parametrize(
    "host",
    [
        *("rebound.example:{port}", "127.0.0.1", "127.0.0.1:1", "127.0.0.1.rebound.example:{port}"),
        *("", "127.0.0.1:{port}@rebound.example:{port}", "192.168.0.7:{port}", "[::2]:{port}"),
    ],
)
def test_other_hosts_are_denied(policy, host):
    named = host.format(port=policy.port)
    assert request_status(policy, f"/{policy.token}/", Host=named) == 421
    headers = {"Host": named, "Origin": f"http://{named}", **UPGRADE}
    assert request_status(policy, f"/{policy.token}/", **headers) == 421


@pytest.mark.parametrize(
    "origin",
    [
        *("http://foreign.example", "null", "https://127.0.0.1:{port}", "http://127.0.0.1:1", None),
        *("http://127.0.0.1:{port}.foreign.example", "http://localhost:{port}"),
    ],
)
def test_sockets_of_other_pages_are_denied(policy, origin):
    more = {} if origin is None else {"Origin": origin.format(port=policy.port)}
    assert request_status(policy, f"/{policy.token}/", Host=home(policy), **more, **UPGRADE) == 403


def drained(call):
    """Receive until the connection ends."""
    while True:
        call.recv(timeout=LONG)


def connected(policy):
    """Return a socket of the page."""
    return connect(
        policy.url.replace("http", "ws"),
        origin=f"http://{home(policy)}",
        subprotocols=[f"viser-v{viser.__version__}"],
        max_size=None,
        open_timeout=LONG,
    )


def test_a_too_long_message_closes_the_connection(policy):
    with connected(policy) as call:
        call.send(b"x" * (MAX_MESSAGE + 1))
        with pytest.raises(ConnectionClosed) as closed:
            drained(call)
    assert closed.value.rcvd.code == 1009


def test_a_message_of_the_largest_size_is_accepted(policy, failures):
    with connected(policy) as call:
        call.send(packed("GuiModalMessage", title="x" * MAX_MESSAGE)[:MAX_MESSAGE])
        with pytest.raises(ConnectionClosed) as closed:
            drained(call)
    assert closed.value.rcvd.code == 1011, "the message was read and is invalid"


# ------------------------------------------------------------------ invalid requests


@pytest.mark.parametrize(
    "path",
    [
        *("/\u00e9/", "/\u00e9", "/{token}\u00e9/", "/\u00e9{token}/", "/\U0001f600/", "/\udcff/"),
        "/?\u00e9",
    ],
    ids=ascii,
)
def test_a_token_that_is_not_ascii_is_denied_without_an_error(policy, capfd, path):
    path = path.format(token=policy.token)
    assert raw_status(policy, path.encode("utf-8", "surrogateescape")) == 403
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("more", ["\u00e9", "%00", "%ff", "x" * 5000, "../" * 9, "%2e%2e/x"])
def test_an_unknown_path_is_not_found_without_an_error(policy, capfd, more):
    found = raw_status(policy, f"/{policy.token}/{more}".encode())
    assert found in (400, 404)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("name", ["Connection", "Accept-Encoding", "Upgrade", "Origin", "Host"])
def test_a_repeated_header_causes_no_error(policy, capfd, name):
    twice = f"{name}: x\r\n{name}: y\r\n".encode()
    found = raw_status(policy, f"/{policy.token}/".encode(), twice)
    assert found == {"Host": 421, "Origin": 403, "Connection": 200}.get(name, 400)
    assert capfd.readouterr().err == ""


def raw_status(policy, path, headers=b""):
    """Return the status of the response to a request with these bytes."""
    with socket.create_connection(("127.0.0.1", policy.port), timeout=LONG) as call:
        host = f"Host: {home(policy)}\r\n".encode()
        call.sendall(b"GET " + path + b" HTTP/1.1\r\n" + host + headers + b"\r\n")
        return int(call.recv(64).split()[1])


@pytest.fixture
def failures(policy, monkeypatch):
    """Reported failures of the page: a list, and an event that is set by each new one."""
    seen, original = SimpleNamespace(all=[], added=threading.Event()), policy.log.report

    def add(*what):
        original(*what)
        seen.all.append(what)
        seen.added.set()

    monkeypatch.setattr(policy.log, "report", add)
    return seen


def packed(kind, **fields):
    return msgspec.msgpack.encode({"type": kind, **fields})


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
    with connected(policy) as call:
        call.send(message)
        with pytest.raises(ConnectionClosed):
            drained(call)
    assert failures.added.wait(LONG)
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("warning: browser request failed: connection handler failed: ")
    assert line.isascii()
    assert line.isprintable()
    assert len(line) < MAX_CHARACTERS + 60
    others = request_status(policy, f"/{policy.token}/", Host=home(policy))
    assert others == 200


def test_repeated_invalid_messages_print_one_line(policy, failures, capfd, monkeypatch):
    monkeypatch.setattr(policy.log, "_clock", lambda: 0.0)
    for count in range(1, 6):
        failures.added.clear()
        with connected(policy) as call:
            call.send(b"\xc1")
            with pytest.raises(ConnectionClosed):
                drained(call)
        assert failures.added.wait(LONG)
        assert len(failures.all) == count
    assert capfd.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("update", [{"value": "x"}, {"no_such_thing": 1}, {"value": None}])
def test_an_invalid_value_of_a_control_prints_one_line(served, policy, failures, capfd, update):
    slider = served.controls.radius
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
    monkeypatch.setattr(policy.log, "_clock", lambda: now)
    monkeypatch.setattr(served, "_submit", None)  # every call fails
    monkeypatch.setattr(served.worker, "submit", None)
    event = SimpleNamespace(client=object(), target=SimpleNamespace(value="VTU"))
    of_load = "direction", "amplitude", "radius", "axis", "angle"
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
    failures = "warning: browser request failed: control: ZeroDivisionError: far away"
    assert capfd.readouterr().err.splitlines() == [failures, failures]


def test_one_line_per_second_is_printed_and_others_are_counted(capfd):
    now = 5.0
    complaints = RateLimitedHandler(lambda: now)
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


def test_warnings_are_not_printed(capfd):
    RateLimitedHandler().logger.warning("slow")
    assert capfd.readouterr().err == ""


def test_responses_forbid_requests_to_other_hosts(policy):
    with socket.create_connection(("127.0.0.1", policy.port), timeout=LONG) as call:
        call.sendall(f"GET /{policy.token}/ HTTP/1.1\r\nHost: {home(policy)}\r\n\r\n".encode())
        head = call.recv(4096).decode("latin1").split("\r\n\r\n")[0].lower()
    assert "content-security-policy: default-src 'none'" in head
    assert "referrer-policy: no-referrer" in head
    assert "cache-control: no-store" in head
    assert "access-control-allow-origin" not in head


def test_a_browser_cannot_open_a_tunnel(served):
    assert served.server.request_share_url() is None
    assert served.server._share_tunnel is None
