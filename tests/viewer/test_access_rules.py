"""Laws of the policy of the viewer, asked of its rules alone: no page and no browser."""

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
LONG = 120  # no test waits so long, unless what it waits for does not come [s]


def policy_at(host="127.0.0.1", port=PORT, allowed_hosts=()):
    """Return a policy whose socket only knows its address."""
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
    """Return the status of the refusal of a request; None if it is not refused."""
    refused = policy.denial_reason(request(*args, **more))
    return None if refused is None else refused[0]


# ------------------------------------------------------------------ the host that is asked for


@pytest.mark.parametrize(
    "host",
    [HOME, f"localhost:{PORT}", f"LocalHost:{PORT}", f"[::1]:{PORT}", f"lab-7:{PORT}"],
)
def test_names_of_the_loopback_and_names_that_are_given_are_this_host(host):
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
def test_another_host_is_refused_as_such(host):
    refused = policy_at(allowed_hosts=("lab-7",)).denial_reason(request(host=host))
    assert refused is not None
    assert refused[0] == http.HTTPStatus.MISDIRECTED_REQUEST
    assert refused[1].startswith("The requested host")


def test_a_request_without_a_host_or_with_two_is_refused():
    assert status(policy_at(), host=None) == 421
    assert status(policy_at(), f"/{TOKEN}/", ("Host", HOME)) == 421


def test_a_door_to_all_takes_any_address_and_the_names_of_this_machine(monkeypatch):
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
def test_the_address_is_one_that_a_browser_of_this_machine_can_open(host, address, everyone):
    policy = policy_at(host)
    assert policy.url == f"http://{address}:{PORT}/{TOKEN}/"
    assert policy.is_public is everyone


# ------------------------------------------------------------------ the page that asks


UPGRADE = ("Connection", "keep-alive, Upgrade")


def test_a_socket_needs_the_origin_of_this_page_and_a_page_needs_none():
    own, foreign = ("Origin", f"http://{HOME}"), ("Origin", "http://foreign.example")
    for several in ([], [own], [own, UPGRADE], [("Connection", "keep-alive")]):
        assert status(policy_at(), f"/{TOKEN}/", *several) is None
    for several in (
        *([foreign], [UPGRADE], [foreign, UPGRADE], [own, foreign], [own, own, UPGRADE]),
        *([("Origin", "null")], [("Origin", f"https://{HOME}")], [("Origin", HOME)]),
    ):
        refused = policy_at().denial_reason(request(f"/{TOKEN}/", *several))
        assert refused is not None, several
        assert refused[0] == http.HTTPStatus.FORBIDDEN
        assert refused[1].startswith("Only the page of this server")


def test_the_origin_is_that_of_the_host_that_was_asked_for():
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
def test_any_other_path_is_refused_for_its_token(path):
    refused = policy_at().denial_reason(request(path))
    assert refused is not None
    assert refused[0] == http.HTTPStatus.FORBIDDEN
    assert refused[1].startswith("The address does not contain")


# ------------------------------------------------------------------ what is handed on


def guarded(*args, answer=None, **more):
    """Return what comes of a request, and the requests that the page's handler has seen."""
    seen = []

    def handle(connection, inner):
        seen.append((connection, inner))
        return answer

    return policy_at().authenticate(handle)("connection", request(*args, **more)), seen


def test_a_refused_request_does_not_reach_the_page():
    found, seen = guarded("/wrong/", answer=Response(200, "OK", Headers(), b"page"))
    assert seen == []
    assert (found.status_code, found.reason_phrase) == (403, "Forbidden")
    assert found.body == policy_at().denial_reason(request("/wrong/"))[1].encode()
    assert found.headers["Content-Length"] == str(len(found.body))
    assert found.headers["Content-Type"] == "text/plain"


@pytest.mark.parametrize(
    ("rest", "inner"),
    [("", "/"), ("/", "/"), ("/a.js", "/a.js"), ("?x=1", "/?x=1"), (f"/{TOKEN}", f"/{TOKEN}")],
)
def test_the_page_is_asked_without_the_token(rest, inner):
    found, ((connection, seen),) = guarded(f"/{TOKEN}{rest}", ("Accept", "text/html"))
    assert found is None, "the handler has answered nothing: a socket is opened"
    assert connection == "connection"
    assert seen.path == inner
    assert list(seen.headers.raw_items()) == [("Host", HOME), ("Accept", "text/html")]


def test_every_answer_forbids_other_pages_to_use_it():
    answer = Response(200, "OK", Headers({"Content-Type": "text/html"}), b"page")
    found, _ = guarded(answer=answer)
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


# ------------------------------------------------------------------ the socket and the server


@pytest.mark.parametrize(
    ("host", "family"), [("127.0.0.1", socket.AF_INET), ("::1", socket.AF_INET6)]
)
def test_a_door_is_bound_where_it_is_asked_to_be(host, family):
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


def test_a_door_has_no_names_and_a_long_token_of_its_own_unless_told():
    with AccessPolicy.bind("127.0.0.1", 0).socket as bound:
        policies = [AccessPolicy(bound, "127.0.0.1") for _ in range(2)]
    assert [policy.allowed_hosts for policy in policies] == [(), ()]
    assert policies[0].token != policies[1].token
    assert all(len(policy.token) == 32 for policy in policies)  # 24 bytes in base 64


def test_a_port_that_is_taken_is_an_error_and_its_socket_is_closed(monkeypatch):
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


def test_a_server_that_starts_behind_a_door_takes_its_socket_and_its_rules(monkeypatch):
    calls, policy = [], policy_at()

    def genuine(handler, **options):
        calls.append((handler, options))
        return "server"

    monkeypatch.setattr(websockets.asyncio.server, "serve", genuine)

    async def start():
        return websockets.asyncio.server.serve(
            "handler", "0.0.0.0", 1, process_request=lambda *_: "passed", compression=None
        )

    with serve_with(policy):
        assert asyncio.run(start()) == "server"
    assert websockets.asyncio.server.serve is genuine
    ((handler, options),) = calls
    assert handler == "handler"
    assert options["sock"] is policy.socket
    assert options["max_size"] == MAX_MESSAGE == 2**18
    assert options["server_header"] is None
    assert options["compression"] is None
    assert options["process_request"](None, request("/wrong/")).status_code == 403
    with pytest.raises(AttributeError):  # "passed" is no response: the page was asked
        options["process_request"](None, request())


def test_an_error_behind_a_door_leaves_servers_as_they_were():
    genuine = websockets.asyncio.server.serve

    def fail():
        with serve_with(policy_at()):
            assert websockets.asyncio.server.serve is not genuine
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        fail()
    assert websockets.asyncio.server.serve is genuine


def answered(listening, answer):
    """Answer one request at a socket; return the thread, and the list that the request joins."""
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
def test_the_status_of_a_request_is_that_of_the_answer(host):
    with socket.create_server((host, 0)) as listening:
        thread, seen = answered(listening, b"HTTP/1.1 418 I'm a teapot\r\n\r\n")
        found = request_status(
            AccessPolicy(listening, host), "/a?b", Host="x:1", Sec_WebSocket_Key="k"
        )
        thread.join(LONG)
    assert found == 418
    assert seen == [b"GET /a?b HTTP/1.1\r\nHost: x:1\r\nSec-WebSocket-Key: k\r\n\r\n"]


def test_a_door_to_all_addresses_is_asked_at_the_loopback(monkeypatch):
    asked = []

    def refused(address, timeout):
        asked.append(address)
        assert 0 < timeout < LONG, "a policy that does not answer is no reason to wait for ever"
        raise ConnectionRefusedError

    monkeypatch.setattr(socket, "create_connection", refused)
    for host in ("::", "0.0.0.0", "10.0.0.1"):
        with pytest.raises(ConnectionRefusedError):
            request_status(policy_at(host), "/")
    assert asked == [("::1", PORT), ("127.0.0.1", PORT), ("10.0.0.1", PORT)]


# ------------------------------------------------------------------ the check before it is served


def tried(monkeypatch, wrong=None):
    """Check a policy that answers by its rules, but for one case; return the requests."""
    asked = []

    def by_rule(policy, path, **headers):
        asked.append((path, headers))
        refused = policy.denial_reason(request(path, *headers.items(), host=None))
        status = 200 if refused is None else int(refused[0])
        if len(asked) - 1 == wrong:
            return 403 if status == 200 else 200
        return status

    monkeypatch.setattr(module, "request_status", by_rule)
    check_server(policy_at())
    return asked


def test_a_door_is_tried_in_every_way_that_must_fail_and_in_the_one_that_must_not(monkeypatch):
    asked = tried(monkeypatch)
    without_token = [path for path, _ in asked if TOKEN not in path]
    hosts = {headers["Host"] for _, headers in asked}
    origins = {headers.get("Origin") for _, headers in asked if "Upgrade" in headers}
    assert without_token
    assert any(host not in (HOME, f"localhost:{PORT}") for host in hosts)
    assert None in origins
    assert any(origin and HOME not in origin for origin in origins)
    for _, headers in asked:
        upgrade = {name: headers[name] for name in ("Connection", "Upgrade") if name in headers}
        assert upgrade in ({}, {"Connection": "Upgrade", "Upgrade": "websocket"})


@pytest.mark.parametrize("wrong", range(5))
def test_a_door_that_answers_one_request_wrongly_is_not_served(monkeypatch, wrong):
    with pytest.raises(RuntimeError, match="access control"):
        tried(monkeypatch, wrong)
