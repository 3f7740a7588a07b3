"""What a frame costs, part by part, how many reach a browser, and how long an answer takes."""

import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import msgspec
import torch
import viser
import websockets.sync.client
import zstandard
from websockets.typing import Origin, Subprotocol

from dpl.evaluation import timing
from dpl.fem import Load
from dpl.viewer.animation import answers
from dpl.viewer.drag_loads import LoadRequest
from dpl.viewer.frames import QUANTITIES, Body, ViewSettings
from dpl.viewer.page import Page
from dpl.viewer.rasterizer import BANDS
from dpl.viewer.surface import bands


@dataclass(frozen=True)
class Row:
    """Times of a frame, medians [ms], and frames that arrived.

    Attributes:
        colours: What they show.
        coloured: The answer of the simulator, and what colours show.
        cut: The surface into bands.
        arrived: Frames at the other end of the socket, a second.
        megabytes: Of those, a second.
    """

    colours: str
    coloured: float
    cut: float
    arrived: float
    megabytes: float


def speed(page: Page, seconds: float = 4.0) -> tuple[list[Row], dict[str, timing.Latency]]:
    """Return what frames cost under the load that goes round, and the latency of its answers.

    Args:
        page: Where frames arrive.
        seconds: For how long frames are counted, for each quantity [s].
    """
    body = page.body
    loads = [frame.asked for frame in answers(body, radius=0.45, deflection=0.3)]
    columns = zip(*map(body.load, loads), strict=True)
    measured = timing.latencies(body.simulator, Load(*map(torch.cat, columns)))
    rows = []
    for quantity in QUANTITIES:
        wish = ViewSettings(quantity=quantity)
        coloured, cut = map(statistics.median, zip(*_times(body, loads, wish), strict=True))
        page.worker.ask(wish=wish)
        arrived, size = _arrived(page, loads, seconds)
        rows.append(Row(quantity, coloured, cut, arrived / seconds, size / seconds / 1e6))
    return rows, measured


def _times(
    body: Body, loads: list[LoadRequest], wish: ViewSettings
) -> Iterator[tuple[float, float]]:
    """Yield of each load how long the answer with its colours and the bands took [ms]."""
    for load in loads[:40]:
        begin = time.perf_counter()
        frame = body.answer(load, wish)
        shown = time.perf_counter()
        levels = frame.values / max(float(frame.values.max()), 1e-300) * BANDS
        bands(frame.points, body.surface.triangles, levels, BANDS)
        end = time.perf_counter()
        yield 1e3 * (shown - begin), 1e3 * (end - shown)


def _arrived(page: Page, loads: list[LoadRequest], seconds: float) -> tuple[int, int]:
    """Return frames and bytes that arrive while the load goes round."""
    address = page.address.replace("http", "ws", 1)
    origin = Origin("/".join(page.address.split("/")[:3]))
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    frames = size = asked = 0
    with websockets.sync.client.connect(
        address, origin=origin, subprotocols=[protocol], max_size=None, compression=None
    ) as call:
        begin = time.monotonic()
        while (now := time.monotonic() - begin) < seconds + 0.5:
            if now * 20 > asked:  # as often as a browser sends a drag
                page.worker.ask(partial(loads.__getitem__, asked % len(loads)))
                asked += 1
            try:
                message = call.recv(timeout=0.01)
            except TimeoutError:
                continue
            if now > 0.5:  # the first brings all that there is
                frames += _is_frame(message)
                size += len(message)
    return frames, size


def _is_frame(message: bytes | str) -> bool:
    """Return whether a message moves the surface that is grabbed."""
    assert isinstance(message, bytes)
    length = int.from_bytes(message[8:16], "little")
    plain = zstandard.ZstdDecompressor().decompress(message[16 : 16 + length])
    return any(
        entry.get("name") == "/network/grip" and "vertices" in entry.get("updates", {})
        for entry in msgspec.msgpack.decode(plain)["messages"]
    )
