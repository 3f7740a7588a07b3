"""Measurement of frame times, frames received by a browser, and latencies of the simulator."""

import statistics
import time
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
from dpl.viewer.frames import QUANTITIES, ViewSettings
from dpl.viewer.nodes import DRAG_MESH
from dpl.viewer.page import Page
from dpl.viewer.recording import circular_load
from dpl.viewer.renderer import colour_bands
from dpl.viewer.requests import LoadRequest

TIMED_FRAMES = 40
START_UP = 0.5  # time before frames are counted, in which the scene is sent [s]
REQUEST_RATE = 20  # rate at which a browser sends drag events [1/s]


@dataclass(frozen=True)
class FrameTimes:
    """Median times of a frame, and the rate at which frames are received.

    Attributes:
        quantity: Quantity that colours show.
        solve_ms: Time of the simulator and of the values on the surface [ms].
        bands_ms: Time of the division into colour bands [ms].
        frames_per_s: Frames received through the web socket [1/s].
        megabytes_per_s: Data received through the web socket [MB/s].
    """

    quantity: str
    solve_ms: float
    bands_ms: float
    frames_per_s: float
    megabytes_per_s: float


def measure_frames(
    page: Page, seconds: float = 4.0
) -> tuple[list[FrameTimes], dict[str, timing.Latency]]:
    """Return the frame times for a rotating load, and the latencies of the simulator.

    A client connects to the page and counts frames for `seconds` [s] per quantity.
    """
    body = page.body
    loads = [frame.load for frame in circular_load(body)]
    columns = zip(*(load.dimensionless(body.scene) for load in loads), strict=True)
    latencies = timing.latencies(body.simulator, Load(*map(torch.cat, columns)))
    rows = []
    for quantity in QUANTITIES:
        settings, times = ViewSettings(quantity=quantity), []
        for load in loads[:TIMED_FRAMES]:
            start = time.perf_counter()
            frame = body.solve(load, settings)
            solved = time.perf_counter()
            colour_bands(body.surface, frame, float(frame.values.max()))
            times.append((1e3 * (solved - start), 1e3 * (time.perf_counter() - solved)))
        page.worker.submit(settings=settings)
        frames, size = _received(page, loads, seconds)
        solve_ms, bands_ms = map(statistics.median, zip(*times, strict=True))
        rates = frames / seconds, size / seconds / 1e6
        rows.append(FrameTimes(quantity, solve_ms, bands_ms, *rates))
    return rows, latencies


def _received(page: Page, loads: list[LoadRequest], seconds: float) -> tuple[int, int]:
    """Return the number of frames and bytes that a client receives during a rotating load."""
    url = page.url.replace("http", "ws", 1)
    origin = Origin("/".join(page.url.split("/")[:3]))
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    frames = size = submitted = 0
    with websockets.sync.client.connect(
        url, origin=origin, subprotocols=[protocol], max_size=None, compression=None
    ) as connection:
        start = time.monotonic()
        while (now := time.monotonic() - start) < seconds + START_UP:
            if now * REQUEST_RATE > submitted:
                page.worker.submit(partial(loads.__getitem__, submitted % len(loads)))
                submitted += 1
            try:
                message = connection.recv(timeout=0.01)
            except TimeoutError:
                continue
            if now > START_UP:
                frames += _is_frame(message)
                size += len(message)
    return frames, size


def _is_frame(message: bytes | str) -> bool:
    """Return True if a message updates the vertices of the mesh to drag."""
    assert isinstance(message, bytes)
    length = int.from_bytes(message[8:16], "little")
    plain = zstandard.ZstdDecompressor().decompress(message[16 : 16 + length])
    return any(
        entry.get("name", "").endswith(DRAG_MESH) and "vertices" in entry.get("updates", {})
        for entry in msgspec.msgpack.decode(plain)["messages"]
    )
