"""Recordings of frames: series for ParaView and animations, and one of a rotating load."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import count, groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from dpl.evaluation.nodal_fields import nodal_fields
from dpl.fem import ModalLoads, write_mesh
from dpl.fem.mesh import write_collection
from dpl.inference.answer import relative
from dpl.system.files import atomic_write
from dpl.viewer.frames import STRESS, Body, Frame, ViewSettings
from dpl.viewer.renderer import Renderer, colour_top
from dpl.viewer.requests import LoadRequest

MAX_FRAMES = 900  # frames of a recording, 30 s at 30 frames per second
FRAME_RATE = 20  # frames per second of an animation
FORMATS = (".gif", ".mp4")
DURATION = 5  # of the animation of a rotating load [s]
RADIUS, DEFLECTION = 0.4, 0.33  # of its patch, and linear displacement of its centre, over L [-]
SAMPLES = 8  # training loads of which the one with the largest displacement is shown
SUFFIXES = {"VTU": ".pvd", "GIF": ".gif", "MP4": ".mp4"}


class Recording:
    """Frames with the times at which they were shown."""

    def __init__(self, body: Body) -> None:
        """Create an empty recording, which adds no frames before `start`."""
        self.body, self.running = body, False
        self.frames: list[tuple[float, Frame]] = []  # with times on any clock [s]

    def start(self) -> None:
        """Remove all frames and start recording."""
        self.frames, self.running = [], True

    def add(self, frame: Frame, time: float) -> None:
        """Append a frame that is shown at a time [s]; ignored if stopped or full."""
        if self.running:
            self.frames.append((time, frame))
            self.running = len(self.frames) < MAX_FRAMES

    def save_series(self, folder: Path) -> Path:
        """Write VTU files with `nodal_fields` and a PVD file; return the path of the PVD file."""
        scene = self.body.scene
        path = self._free_path(folder, ".pvd")
        files = []
        for number, (time, frame) in enumerate(self.frames):
            load = frame.load.dimensionless(scene)
            with torch.inference_mode():
                fields = nodal_fields(scene, load, frame.displacement / scene.length)
            files.append((time - self.frames[0][0], f"{path.stem}/frame_{number:04d}.vtu"))
            arrays = {name: field.numpy() for name, field in fields.items()}
            write_mesh(folder / files[-1][1], scene.problem.mesh_in_metres, arrays)
        write_collection(path, files)
        return path

    def save_animation(self, folder: Path, suffix: str, size: tuple[int, int] = (960, 540)) -> Path:
        """Write an animation in real time, ".gif" or ".mp4", and return its path."""
        path = self._free_path(folder, suffix)

        def captions(frame: Frame) -> list[str]:
            answer = frame.answer
            error, method = relative(float(answer.error)), answer.method
            time, ratio = f"{answer.milliseconds:.1f} ms", f"{answer.volume_ratio:.2f}"
            return [f"estimated error {error}", f"{method}, {time}", f"min det F {ratio}"]

        write_animation(path, self.body, resample(self.frames), size, captions)
        return path

    def _free_path(self, folder: Path, suffix: str) -> Path:
        """Return the first unused path of recording-001, ..., with and without the suffix."""
        if not self.frames:
            raise ValueError("the recording is empty; start recording first")
        paths = (folder / f"recording-{number:03d}{suffix}" for number in count(1))
        return next(p for p in paths if not (p.exists() or p.with_suffix("").exists()))


def resample(frames: list[tuple[float, Frame]]) -> list[Frame]:
    """Return the frames shown at multiples of 1 / `FRAME_RATE`, of frames with times [s]."""
    times = np.array([time for time, _ in frames])
    ticks = np.arange(times[0], times[-1] + 1 / FRAME_RATE, 1 / FRAME_RATE)
    chosen = np.clip(np.searchsorted(times, ticks + 1e-9) - 1, 0, None)
    return [frames[k][1] for k in chosen]


def write_animation(
    path: Path,
    body: Body,
    frames: list[Frame],
    size: tuple[int, int],
    captions: Callable[[Frame], list[str]],
) -> None:
    """Write frames, `FRAME_RATE` per second, with one colour scale; a GIF loops."""
    renderer = Renderer.fitting(body, frames, size)
    top = colour_top(np.concatenate([frame.values for frame in frames]))
    images = (
        image
        for _, (frame, *again) in groupby(frames, key=id)
        for image in [renderer.render(frame, top, captions(frame))] * (1 + len(again))
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mp4":
        import imageio_ffmpeg

        with atomic_write(path) as file:
            writer = imageio_ffmpeg.write_frames(
                str(file.name), size, fps=FRAME_RATE, quality=7, macro_block_size=2,
                output_params=["-f", "mp4"],
            )  # fmt: skip
            writer.send(None)
            for image in images:
                writer.send(image.tobytes())
            writer.close()
        return
    # with a common palette, unchanged pixels take no space and do not flicker
    some = [renderer.render(one, top, captions(one)) for one in frames[:: len(frames) // 3 + 1]]
    colours = Image.fromarray(np.concatenate([np.asarray(image) for image in some]))
    palette = colours.quantize(256, Image.Quantize.MAXCOVERAGE)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    options: dict[str, Any] = {"duration": round(1000 / FRAME_RATE), "loop": 0, "optimize": False}
    with atomic_write(path) as file:
        first.save(file, format="GIF", save_all=True, append_images=others, **options)


def animate_load(body: Body, path: Path, *, size: tuple[int, int] = (720, 405)) -> None:
    """Write a looping animation of `rotating_load`, with the von Mises stress as colours.

    The caption has the largest error of `sim(force)` against finite elements, and its median time.
    """
    request_at, errors = rotating_load(body), []
    times = np.arange(DURATION * FRAME_RATE) / FRAME_RATE
    frames = [body.solve(request_at(time), ViewSettings(quantity=STRESS)) for time in times]
    for frame in frames:
        exact = body.solve(frame.request, ViewSettings(tol=body.scene.solver.tol)).displacement
        apart = (frame.displacement - exact).norm() / exact.norm().clamp(min=1e-300)
        errors.append(float(apart))
    median = np.median([frame.answer.milliseconds for frame in frames])
    captions = [
        f"error at most {relative(max(errors))}",
        f"sim(force): {median:.1f} ms",
        f"{math.prod(body.scene.problem.shape):,} degrees of freedom",
    ]
    write_animation(path, body, frames, size, lambda frame: captions)


def rotating_load(body: Body) -> Callable[[float], LoadRequest]:
    """Return the function from time [s] to a load that rotates once in `DURATION`.

    The load acts at the node farthest from the fixed nodes. It rotates in the plane of the two
    smallest extents of the body; in 2D it oscillates along the smallest one. If the training range
    is not known to contain it, a load of the training is applied and removed instead.
    """
    loads, points = body.scene.loads, body.scene.problem.points.numpy()
    low, high = loads.patch_radius if isinstance(loads, ModalLoads) else (RADIUS, RADIUS)
    patch = body.patch(farthest_node(body), min(max(RADIUS, float(low)), float(high)))
    axes = np.argsort(np.ptp(points, axis=0))[: points.shape[1] - 1].tolist()

    def rotated(time: float) -> LoadRequest:
        angle = 2 * math.pi * time / DURATION
        target = torch.zeros(points.shape[1], dtype=torch.float64)
        for axis, component in zip(axes, (math.sin(angle), math.cos(angle)), strict=False):
            target[axis] = DEFLECTION * component
        return body.request(patch.force_towards(target))

    tried = [body.solve(rotated(DURATION * k / 8), ViewSettings()).answer for k in range(1, 4)]
    if all(not found.out_of_distribution and found.out_of_span >= 0 for found in tried):
        return rotated
    samples = [body.solve(body.sample(index), ViewSettings()) for index in range(SAMPLES)]
    largest = max(samples, key=lambda frame: float(frame.displacement.norm())).load
    rest, force = body.zero_load(), largest.force * (body.young / largest.young)
    goal = replace(rest, force=force)
    return lambda time: rest.interpolate(goal, math.sin(math.pi * time / DURATION) ** 2)


def farthest_node(body: Body) -> int:
    """Return the surface node in the middle of those that are farthest from the fixed nodes."""
    problem, points = body.scene.problem, body.scene.problem.points[body.surface.nodes]
    fixed = problem.points[~problem.free.any(dim=1)]
    distance = torch.cdist(points, fixed).amin(dim=1) if len(fixed) else points[:, 0]
    return body.surface.middle_node((distance > 0.99 * distance.max()).numpy())
