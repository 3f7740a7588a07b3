"""An animation of the body, bent by a load that moves."""

import math
from pathlib import Path

import numpy as np
import torch

from dpl.viewer.frames import Body, Frame, ViewSettings
from dpl.viewer.rasterizer import Camera, Renderer
from dpl.viewer.recording import RATE, film

SECONDS = 5


def animate_load(
    body: Body,
    path: Path,
    *,
    size: tuple[int, int] = (720, 405),
    radius: float = 0.45,
    deflection: float = 0.33,
) -> None:
    """Write an animation of the network's answers to a load that goes round; it runs in a loop.

    The load acts on an area around the point farthest from the supports and turns once. Colours
    are von Mises stress; time is the median, errors are those of each picture.

    Args:
        body: What answers.
        path: A .gif or .mp4 file.
        size: Width and height [pixels].
        radius: Of the area over L [-].
        deflection: Linear displacement of its centre at most, over L [-].
    """
    frames = answers(body, radius=radius, deflection=deflection)
    typical = float(np.median([frame.answer.milliseconds for frame in frames if frame.answer]))
    count = math.prod(body.scene.problem.shape)

    def words(frame: Frame) -> list[str]:
        error = difference(body, frame)
        return [
            f"sim(force): {typical:.1f} ms",
            f"{count:,} degrees of freedom",
            f"residual {frame.residual:.1e} of the load",
            f"displacement within {100 * error:.1g} % of finite elements",
        ]

    camera = Camera.before(body.surface, wide=0.82)
    film(path, frames, Renderer(body.surface, camera, size), words)


def difference(body: Body, frame: Frame) -> float:
    """Return ||u - u_FE|| / ||u_FE|| of an answer, u_FE to the scene's tolerance."""
    wish = ViewSettings(tol=body.scene.solver.tol)
    exact = body.answer(frame.asked, wish).displacement
    return float((frame.displacement - exact).norm() / exact.norm().clamp(min=1e-300))


def answers(body: Body, *, radius: float, deflection: float) -> list[Frame]:
    """Return the answers to the load that goes round once in `SECONDS`, `RATE` a second."""
    problem = body.scene.problem
    held = problem.points[~problem.free.any(dim=1)]
    points = problem.points[body.surface.nodes]
    far = torch.cdist(points, held).amin(dim=1) if len(held) else points[:, 0]
    tip = points[far > 0.99 * far.max()]
    node = int(body.surface.nodes[int((points - tip.mean(dim=0)).norm(dim=1).argmin())])
    patch = body.patch(node, radius)
    across = np.argsort(np.ptp(problem.points.numpy(), axis=0))  # the thinnest first
    wish = ViewSettings(quantity="von Mises stress")
    found = []
    for k in range(SECONDS * RATE):
        angle = 2 * math.pi * k / (SECONDS * RATE)
        target = torch.zeros(problem.shape[1], dtype=torch.float64)
        target[int(across[0])] = deflection * math.sin(angle)
        if len(across) > 2:
            target[int(across[1])] = deflection * math.cos(angle)
        found.append(body.answer(body.asked(patch.towards(target), None), wish))
    return found
