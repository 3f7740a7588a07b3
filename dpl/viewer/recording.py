"""What was shown, kept: a series for ParaView, or a film."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from dpl.export.paraview import nodal_fields
from dpl.fem import write_mesh
from dpl.fem.mesh import write_collection
from dpl.system.files import atomic_write
from dpl.viewer.frames import Body, Frame, Scale
from dpl.viewer.rasterizer import INK, PAPER, Renderer, colours

MOST = 900  # frames of a recording, 30 s at 30 a second
RATE = 20  # frames of a film a second
FORMATS = (".gif", ".mp4")


class Recording:
    """Frames as they were shown, with their times.

    Attributes:
        body: Whose.
        running: Whether frames are taken.
    """

    def __init__(self, body: Body) -> None:
        """Begin empty."""
        self.body, self.running = body, False
        self._frames: list[tuple[float, Frame]] = []
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Return how many frames there are."""
        return len(self._frames)

    def start(self) -> None:
        """Begin anew."""
        with self._lock:
            self._frames, self.running = [], True

    def stop(self) -> None:
        """Take no more."""
        self.running = False

    def take(self, frame: Frame, now: float) -> None:
        """Keep a frame shown at a time [s], while running and there is room."""
        with self._lock:
            if self.running and len(self._frames) < MOST:
                self._frames.append((now, frame))
            self.running &= len(self._frames) < MOST

    def frames(self) -> list[tuple[float, Frame]]:
        """Return what there is, times from 0."""
        with self._lock:
            kept = list(self._frames)
        return [(now - kept[0][0], frame) for now, frame in kept]

    def save_series(self, folder: Path) -> Path:
        """Write frames as VTU files and a PVD file that ParaView opens; return that.

        With what an export has at the nodes, see `dpl.export.paraview.nodal_fields`.

        Raises:
            ValueError: There are none.
        """
        kept, scene = self._some(), self.body.scene
        mesh = scene.problem.mesh_in_metres
        place = free_name(folder, "recording", ".pvd")
        files = []
        for number, (time, frame) in enumerate(kept):
            load = self.body.load(frame.asked)
            with torch.inference_mode():
                found = nodal_fields(scene, load, frame.displacement / scene.length)
            name = f"{place.stem}/frame_{number:04d}.vtu"
            write_mesh(folder / name, mesh, {key: field.numpy() for key, field in found.items()})
            files.append((time, name))
        write_collection(place, files)
        return place

    def save_film(self, folder: Path, scenery: Renderer, kind: str) -> Path:
        """Write frames as a film, ".gif" or ".mp4", as long as it took; return it.

        Raises:
            ValueError: There are no frames, or no such format.
        """
        place = free_name(folder, "recording", kind)
        film(place, evenly(self._some()), scenery)
        return place

    def _some(self) -> list[tuple[float, Frame]]:
        kept = self.frames()
        if not kept:
            raise ValueError("nothing is recorded yet")
        return kept


def evenly(frames: list[tuple[float, Frame]]) -> list[Frame]:
    """Return of frames with times [s] those that a film shows, `RATE` a second."""
    times = np.array([time for time, _ in frames])
    ticks = np.arange(0.0, times[-1] + 1 / RATE, 1 / RATE)
    chosen = np.clip(np.searchsorted(times, ticks + 1e-9) - 1, 0, None)
    return [frames[k][1] for k in chosen]


def film(
    path: Path,
    frames: list[Frame],
    scenery: Renderer,
    words: Callable[[Frame], list[str]] | None = None,
) -> None:
    """Write frames, `RATE` a second, as a film; a GIF runs in a loop.

    Args:
        path: A .gif or .mp4 file.
        frames: One or more.
        scenery: Where they are drawn.
        words: What stands on the picture of a frame; `caption` if left out.

    Raises:
        ValueError: No such format.
    """
    if path.suffix not in FORMATS:
        raise ValueError(f"{path.name} must end with {' or '.join(FORMATS)}")
    pictures = _pictures(frames, scenery, words or caption)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mp4":
        _mp4(path, pictures, scenery.size)
        return
    palette = _palette({frame.quantity for frame in frames})
    flat = [
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
        for picture in pictures
    ]
    with atomic_write(path) as file:
        flat[0].save(
            file,
            format="GIF",
            save_all=True,
            append_images=flat[1:],
            duration=round(1000 / RATE),
            loop=0,
            optimize=False,
        )


def _mp4(path: Path, pictures: Iterator[NDArray[np.uint8]], size: tuple[int, int]) -> None:
    import imageio_ffmpeg

    part = path.with_name(f".{path.stem}.part.mp4")
    writer = imageio_ffmpeg.write_frames(str(part), size, fps=RATE, quality=7, macro_block_size=2)
    writer.send(None)
    try:
        for picture in pictures:
            writer.send(np.ascontiguousarray(picture))
        writer.close()
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _palette(quantities: set[str]) -> Image.Image:
    """Return the colours of a GIF: bands in light and shade, and from paper to ink.

    One palette for all pictures, so that what does not move costs nothing and does not flicker.
    """
    shades = np.linspace(0.45, 1.05, 16 // len(quantities))[:, None, None]
    bands = [np.clip(shades * colours(quantity), 0, 255) for quantity in sorted(quantities)]
    greys = np.linspace(PAPER, INK, 40)
    flat = np.concatenate([*(shade.reshape(-1, 3) for shade in bands), greys]).round()
    image = Image.new("P", (1, 1))
    image.putpalette(flat.astype(np.uint8).tobytes())
    return image


def _pictures(
    frames: list[Frame], scenery: Renderer, words: Callable[[Frame], list[str]]
) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures of frames; colours span what the whole film holds."""
    largest = np.concatenate([frame.values for frame in frames])
    top = Scale().follow(largest)
    before: tuple[Frame, NDArray[np.uint8]] | None = None
    for frame in frames:
        if before is None or frame is not before[0]:
            image = scenery.draw(frame.points, frame.values, top, frame.quantity, words(frame))
            before = frame, np.asarray(image)
        yield before[1]


def caption(frame: Frame) -> list[str]:
    """Return what stands on a picture."""
    answer = frame.answer
    if answer is None:
        return [f"Newton from rest: iteration {frame.iteration}", f"residual {frame.residual:.1e}"]
    return [
        f"{answer.method} · {answer.milliseconds:.1f} ms",
        f"residual {frame.residual:.1e} of the load",
        f"min det F {frame.volume_ratio:.2f}",
    ]


def free_name(folder: Path, stem: str, suffix: str) -> Path:
    """Return the first path stem-001, stem-002, ... of which nothing is there."""
    for number in range(1, 10_000):
        name = f"{stem}-{number:03d}"
        if not any((folder / f"{name}{s}").exists() for s in (suffix, "")):
            return folder / f"{name}{suffix}"
    raise ValueError(f"{folder} is full of recordings")
