"""Recordings of frames: series for ParaView and animations."""

import threading
from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.colors import to_rgb
from PIL import Image

from dpl.evaluation.nodal_fields import nodal_fields
from dpl.fem import write_mesh
from dpl.fem.mesh import write_collection
from dpl.system.files import atomic_write
from dpl.viewer.frames import Body, ColourScale, Frame
from dpl.viewer.load_arrow import ARROW_COLOUR
from dpl.viewer.renderer import BACKGROUND, NEUTRAL, TEXT, Renderer, band_colours

MAX_FRAMES = 900  # frames of a recording, 30 s at 30 frames per second
FRAME_RATE = 20  # frames per second of an animation
FORMATS = (".gif", ".mp4")
SUFFIXES = {"VTU": ".pvd", "GIF": ".gif", "MP4": ".mp4"}


class Recording:
    """Frames with the times at which they were shown.

    Attributes:
        body: The body.
        running: True while frames are recorded.
    """

    def __init__(self, body: Body) -> None:
        """Create an empty recording."""
        self.body, self.running = body, False
        self._frames: list[tuple[float, Frame]] = []
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._frames)

    def start(self) -> None:
        """Remove all frames and start recording."""
        with self._lock:
            self._frames, self.running = [], True

    def stop(self) -> None:
        """Stop recording."""
        self.running = False

    def add(self, frame: Frame, time: float) -> None:
        """Append a frame that is shown at a time [s]; ignored if stopped or full."""
        with self._lock:
            if self.running and len(self._frames) < MAX_FRAMES:
                self._frames.append((time, frame))
            self.running &= len(self._frames) < MAX_FRAMES

    def frames(self) -> list[tuple[float, Frame]]:
        """Return times [s] from the first frame on, and frames."""
        with self._lock:
            frames = list(self._frames)
        return [(time - frames[0][0], frame) for time, frame in frames]

    def save_series(self, folder: Path) -> Path:
        """Write VTU files with `nodal_fields` and a PVD file; return the path of the PVD file.

        Raises:
            ValueError: The recording is empty.
        """
        scene = self.body.scene
        path = self._free_path(folder, ".pvd")
        files = []
        for number, (time, frame) in enumerate(self.frames()):
            load = frame.load.dimensionless(scene)
            with torch.inference_mode():
                fields = nodal_fields(scene, load, frame.displacement / scene.length)
            files.append((time, f"{path.stem}/frame_{number:04d}.vtu"))
            arrays = {name: field.numpy() for name, field in fields.items()}
            write_mesh(folder / files[-1][1], scene.problem.mesh_in_metres, arrays)
        write_collection(path, files)
        return path

    def save_animation(self, folder: Path, suffix: str, size: tuple[int, int] = (960, 540)) -> Path:
        """Write an animation in real time, ".gif" or ".mp4", and return its path.

        The camera shows the body in all frames; `size` is width and height [pixel].

        Raises:
            ValueError: The recording is empty, or the format is unknown.
        """
        path = self._free_path(folder, suffix)
        frames = resample(self.frames())
        renderer = Renderer.fitting(self.body.surface, frames, size)
        write_animation(path, frames, renderer, default_captions)
        return path

    def _free_path(self, folder: Path, suffix: str) -> Path:
        """Return the first unused path of recording-001, ..., with and without the suffix."""
        if not self._frames:
            raise ValueError("the recording is empty; start recording first")
        for number in range(1, 10_000):
            path = folder / f"recording-{number:03d}{suffix}"
            if not path.exists() and not path.with_suffix("").exists():
                return path
        raise ValueError(f"{folder} contains 9999 recordings; remove some")


def resample(frames: list[tuple[float, Frame]]) -> list[Frame]:
    """Return the frames shown at multiples of 1 / `FRAME_RATE`, of frames with times [s]."""
    times = np.array([time for time, _ in frames])
    ticks = np.arange(0.0, times[-1] + 1 / FRAME_RATE, 1 / FRAME_RATE)
    chosen = np.clip(np.searchsorted(times, ticks + 1e-9) - 1, 0, None)
    return [frames[k][1] for k in chosen]


def default_captions(frame: Frame) -> list[str]:
    """Return the lines of text for a frame of a recording."""
    answer = frame.answer
    if answer is None:
        return [f"Newton, iteration {frame.iteration}", f"relative residual {frame.residual:.1e}"]
    return [
        f"{answer.method} · {answer.milliseconds:.1f} ms",
        f"relative residual {frame.residual:.1e}",
        f"min det F {frame.volume_ratio:.2f}",
    ]


def write_animation(
    path: Path, frames: list[Frame], renderer: Renderer, captions: Callable[[Frame], list[str]]
) -> None:
    """Write frames, `FRAME_RATE` per second, as an animation; a GIF loops.

    Raises:
        ValueError: The path does not end with one of `FORMATS`.
    """
    if path.suffix not in FORMATS:
        raise ValueError(f"path = {path.name} must end with {' or '.join(FORMATS)}")
    images = _render(frames, renderer, captions)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mp4":
        _write_mp4(path, images, renderer.size)
    else:
        _write_gif(path, images, {frame.quantity for frame in frames})


def _render(
    frames: list[Frame], renderer: Renderer, captions: Callable[[Frame], list[str]]
) -> Iterator[Image.Image]:
    """Yield the images of frames with one colour scale for all."""
    top = ColourScale().update(np.concatenate([frame.values for frame in frames]))
    for _, (frame, *again) in groupby(frames, key=id):
        image = renderer.render(frame, top, captions(frame))
        yield from [image] * (1 + len(again))


def _write_gif(path: Path, images: Iterator[Image.Image], quantities: set[str]) -> None:
    palette = _palette(quantities)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    options: dict[str, Any] = {"duration": round(1000 / FRAME_RATE), "loop": 0, "optimize": False}
    with atomic_write(path) as file:
        first.save(file, format="GIF", save_all=True, append_images=others, **options)


def _write_mp4(path: Path, images: Iterator[Image.Image], size: tuple[int, int]) -> None:
    import imageio_ffmpeg

    part = path.with_name(f".{path.stem}.part.mp4")
    options = {"fps": FRAME_RATE, "quality": 7, "macro_block_size": 2}
    writer = imageio_ffmpeg.write_frames(str(part), size, **options)
    writer.send(None)
    try:
        for image in images:
            writer.send(image.tobytes())
        writer.close()
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _palette(quantities: set[str]) -> Image.Image:
    """Return one palette for all images: shades of the band colours, of the arrow and of grey.

    With a common palette, unchanged pixels take no space and do not flicker.
    """
    shades = np.linspace(0.45, 1.05, 16 // len(quantities))[:, None, None]
    bands = [np.clip(shades * band_colours(quantity), 0, 255) for quantity in sorted(quantities)]
    greys = 255 * np.linspace(to_rgb(BACKGROUND), to_rgb(TEXT), 40)
    reds = np.linspace(ARROW_COLOUR, (255, 255, 255), 8)
    neutral = np.clip(np.linspace(0.45, 1.05, 16)[:, None] * NEUTRAL, 0, 255)
    parts = (*(shade.reshape(-1, 3) for shade in bands), greys, reds, neutral)
    colours = np.concatenate(parts).round()
    image = Image.new("P", (1, 1))
    image.putpalette(colours.astype(np.uint8).tobytes())
    return image
