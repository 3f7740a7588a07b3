"""Animation of the body under a load that rotates once."""

import math
from pathlib import Path

import numpy as np
import torch

from dpl.viewer.frames import STRESS, Body, Frame, ViewSettings
from dpl.viewer.recording import FRAME_RATE, write_animation
from dpl.viewer.renderer import Renderer

DURATION = 5  # [s]
RADIUS = 0.45  # of the patch over L [-]
DEFLECTION = 0.33  # linear displacement of the centre of the patch over L [-]


def animate_load(body: Body, path: Path, *, size: tuple[int, int] = (720, 405)) -> None:
    """Write a looping animation of the network's predictions for a load that rotates once.

    The load acts on a patch around the point farthest from the supports. Colours show the von Mises
    stress. The caption has the median time, and residual and error of each frame. `path` ends with
    .gif or .mp4; `size` is width and height [pixel].
    """
    frames = circular_load(body)
    median = float(np.median([frame.answer.milliseconds for frame in frames if frame.answer]))
    count = math.prod(body.scene.problem.shape)

    def captions(frame: Frame) -> list[str]:
        exact = body.solve(frame.request, ViewSettings(tol=body.scene.solver.tol)).displacement
        error = float((frame.displacement - exact).norm() / exact.norm().clamp(min=1e-300))
        return [
            f"sim(force): {median:.1f} ms",
            f"{count:,} degrees of freedom",
            f"relative residual {frame.residual:.1e}",
            f"displacement error {100 * error:.1g} %",
        ]

    write_animation(path, frames, Renderer.fitting(body.surface, frames, size), captions)


def circular_load(body: Body) -> list[Frame]:
    """Return the predictions for a load that rotates once in `DURATION`.

    The load acts at the node farthest from the fixed nodes. It rotates in the plane of the two
    smallest extents of the body; in 2D it oscillates along the smallest one.
    """
    patch = body.patch(_farthest_node(body), RADIUS)
    points = body.scene.problem.points.numpy()
    axes = np.argsort(np.ptp(points, axis=0))[: points.shape[1] - 1]
    settings = ViewSettings(quantity=STRESS)
    frames, count = [], DURATION * FRAME_RATE
    for k in range(count):
        angle = 2 * math.pi * k / count
        target = torch.zeros(points.shape[1], dtype=torch.float64)
        for axis, component in zip(axes.tolist(), (math.sin(angle), math.cos(angle)), strict=False):
            target[axis] = DEFLECTION * component
        frames.append(body.solve(body.request(patch.force_towards(target)), settings))
    return frames


def _farthest_node(body: Body) -> int:
    """Return the surface node in the middle of those that are farthest from the fixed nodes."""
    problem, nodes = body.scene.problem, body.surface.nodes
    fixed = problem.points[~problem.free.any(dim=1)]
    points = problem.points[nodes]
    distance = torch.cdist(points, fixed).amin(dim=1) if len(fixed) else points[:, 0]
    middle = points[distance > 0.99 * distance.max()].mean(dim=0)
    return int(nodes[int((points - middle).norm(dim=1).argmin())])
