"""Who may come in, asked with real sockets; and how the command says no."""

import socket
import time

import pytest

pytest.importorskip("viser", reason="the extra viewer is not installed")

import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from dpl.viewer.door import LARGEST, Door, status_of

UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec_WebSocket_Version": "13",
    "Sec_WebSocket_Protocol": f"viser-v{viser.__version__}",
}


@pytest.fixture
def door(page):
    """That of a page."""
    return page._door


def home(door):
    return f"127.0.0.1:{door.port}"


def test_the_page_is_served_to_who_has_its_address(door):
    path = f"/{door.token}/"
    for host in (home(door), f"localhost:{door.port}"):
        assert status_of(door, path, Host=host) == 200
    assert status_of(door, path + "nothing-here.js", Host=home(door)) == 404


@pytest.mark.parametrize("path", ["/", "/x/", "/?token=x", "//", "/%2e%2e/", "/index.html"])
def test_without_the_token_there_is_no_page_and_no_socket(door, path):
    assert status_of(door, path, Host=home(door)) == 403
    origin = f"http://{home(door)}"
    assert status_of(door, path, Host=home(door), Origin=origin, **UPGRADE) == 403


def test_a_token_that_is_nearly_right_is_wrong(door):
    for wrong in (door.token[:-1], door.token + "x", door.token.swapcase()):
        assert status_of(door, f"/{wrong}/", Host=home(door)) == 403


@pytest.mark.parametrize(
    "host",
    [
        *("rebound.example:{port}", "127.0.0.1", "127.0.0.1:1", "127.0.0.1.rebound.example:{port}"),
        *("", "127.0.0.1:{port}@rebound.example:{port}", "192.168.0.7:{port}", "[::2]:{port}"),
    ],
)
def test_a_host_that_is_not_this_one_is_refused(door, host):
    named = host.format(port=door.port)
    assert status_of(door, f"/{door.token}/", Host=named) == 421
    headers = {"Host": named, "Origin": f"http://{named}", **UPGRADE}
    assert status_of(door, f"/{door.token}/", **headers) == 421


@pytest.mark.parametrize(
    "origin",
    [
        *("http://foreign.example", "null", "https://127.0.0.1:{port}", "http://127.0.0.1:1", None),
        *("http://127.0.0.1:{port}.foreign.example", "http://localhost:{port}"),
    ],
)
def test_a_socket_from_another_page_is_refused(door, origin):
    more = {} if origin is None else {"Origin": origin.format(port=door.port)}
    assert status_of(door, f"/{door.token}/", Host=home(door), **more, **UPGRADE) == 403


def test_the_pages_own_socket_is_opened(door):
    headers = {"Host": home(door), "Origin": f"http://{home(door)}", **UPGRADE}
    assert status_of(door, f"/{door.token}", **headers) == 101


def test_only_this_machine_can_reach_it(door):
    assert door.socket.getsockname()[0] == "127.0.0.1"
    assert not door.open_to_all


def drained(call, seconds=20):
    """Receive until the connection ends."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        call.recv(timeout=5)


def test_a_message_that_is_too_long_ends_the_connection(door):
    address, origin = door.address.replace("http", "ws"), f"http://{home(door)}"
    protocol = [f"viser-v{viser.__version__}"]
    with connect(address, origin=origin, subprotocols=protocol, max_size=None) as call:
        call.send(b"x" * (LARGEST + 1))
        with pytest.raises(ConnectionClosed) as closed:
            drained(call)
    assert closed.value.rcvd.code == 1009


def test_the_answer_forbids_to_fetch_from_elsewhere(door):
    with socket.create_connection(("127.0.0.1", door.port), timeout=10) as call:
        call.sendall(f"GET /{door.token}/ HTTP/1.1\r\nHost: {home(door)}\r\n\r\n".encode())
        head = call.recv(4096).decode("latin1").split("\r\n\r\n")[0].lower()
    assert "content-security-policy: default-src 'none'" in head
    assert "referrer-policy: no-referrer" in head
    assert "cache-control: no-store" in head
    assert "access-control-allow-origin" not in head


def test_a_door_to_all_takes_addresses_and_its_names_but_no_others():
    door = Door.bound("0.0.0.0", 0, ["Lab-7"])
    try:
        assert door.open_to_all
        hosts = {"192.168.0.7": True, "lab-7": True, "LAB-7": True, "rebound.example": False}
        for name, ours in hosts.items():
            assert door._ours(f"{name}:{door.port}") is ours
    finally:
        door.socket.close()


def test_a_browser_cannot_ask_for_a_tunnel(page):
    assert page.server.request_share_url() is None
    assert page.server._share_tunnel is None


def test_two_pages_have_two_tokens():
    first, second = Door.bound("127.0.0.1", 0), Door.bound("127.0.0.1", 0)
    assert first.token != second.token
    assert len(first.token) >= 32
    assert first.token not in repr(first)
    for door in (first, second):
        door.socket.close()
