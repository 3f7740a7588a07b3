"""An animation of the body, bent by a load that moves."""

import math
from pathlib import Path

import numpy as np
import torch

from dpl.viewer.picture import Camera, Scenery
from dpl.viewer.record import RATE, film
from dpl.viewer.state import Body, Frame, Wish

SECONDS = 5


def moving_load(
    body: Body,
    path: Path,
    *,
    size: tuple[int, int] = (720, 405),
    radius: float = 0.45,
    deflection: float = 0.33,
) -> None:
    """Write an animation of the network's answers to a load that goes round; it runs in a loop.

    The load acts on an area around the point farthest from the supports and turns, growing and
    shrinking twice on the way. Colours are von Mises stress.

    Args:
        body: What answers.
        path: A .gif or .mp4 file.
        size: Width and height [pixels].
        radius: Of the area over L [-].
        deflection: Linear displacement of its centre at most, over L [-].
    """
    frames = [frame for _, frame in answers(body, radius=radius, deflection=deflection)]
    camera = Camera.before(body.surface, wide=0.82)
    film(path, frames, Scenery(body.surface, camera, size))


def answers(body: Body, *, radius: float, deflection: float) -> list[tuple[float, Frame]]:
    """Return the answers to the load that goes round, with times [s]."""
    problem = body.scene.problem
    held = problem.points[~problem.free.any(dim=1)]
    points = problem.points[body.surface.nodes]
    far = torch.cdist(points, held).amin(dim=1) if len(held) else points[:, 0]
    node = int(body.surface.nodes[int(far.argmax())])
    patch = body.patch(node, radius)
    across = np.argsort(np.ptp(problem.points.numpy(), axis=0))  # the thinnest first
    wish = Wish(quantity="von Mises stress")
    found = []
    for k in range(SECONDS * RATE):
        angle = 2 * math.pi * k / (SECONDS * RATE)
        target = torch.zeros(problem.shape[1], dtype=torch.float64)
        swing = deflection * (0.8 + 0.2 * math.cos(2 * angle))
        target[int(across[0])] = swing * math.sin(angle)
        if len(across) > 2:
            target[int(across[1])] = swing * math.cos(angle)
        frame = body.answer(body.asked(patch.towards(target), None), wish)
        found.append((k / RATE, frame))
    return found
