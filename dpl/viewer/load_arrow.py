"""Arrow of the total force of a load or a gripper."""

import numpy as np

from dpl.viewer.frames import Frame
from dpl.viewer.surface import Floats, Ints, Surface

ARROW_LENGTH = 0.09, 0.07  # length at amplitude 0 and its increase per amplitude, over L [-]
MAX_AMPLITUDE = 2.0  # amplitude of the longest arrow [-]
BALANCED = 1e-6  # total force over the sum of nodal forces below which there is no direction
ARROW_COLOUR = (200, 24, 45)


def arrow_ends(surface: Surface, frame: Frame) -> Floats | None:
    """Return start and end of the arrow over L, (2, 3); None if the total force is zero.

    The axis of the arrow passes through the centre of the nodal forces. The arrow starts where its
    axis leaves the body, so that the body does not hide it; in 2D it starts at the centre.
    """
    force = frame.hand_force.numpy()
    total = np.pad(force.sum(axis=0), (0, 3 - force.shape[1]))
    sizes = np.linalg.norm(force, axis=1)
    if not np.linalg.norm(total) > BALANCED * sizes.sum():
        return None
    direction = total / np.linalg.norm(total)
    points = np.nan_to_num(frame.points)
    weights = sizes[surface.nodes] if sizes[surface.nodes].any() else np.ones(len(points))
    centre = weights @ points / weights.sum()
    start = centre + exit_distance(points, surface.triangles, centre, direction) * direction
    amplitude = min(max(frame.amplitude, 0.0), MAX_AMPLITUDE)
    length = ARROW_LENGTH[0] + ARROW_LENGTH[1] * amplitude
    return np.stack([start, start + length * direction])


def exit_distance(points: Floats, triangles: Ints, origin: Floats, direction: Floats) -> float:
    """Return the distance at which a ray first leaves a surface; 0 if it does not.

    Möller, Trumbore (1997), Fast, minimum storage ray-triangle intersection.
    """
    a, b, c = (points[triangles[:, k]] for k in range(3))
    first, last = b - a, c - a
    normal = np.cross(first, last)
    slope = normal @ direction
    scale = np.where(slope > 1e-12, slope, np.inf)  # only triangles that the ray leaves through
    distance = ((a - origin) * normal).sum(axis=1) / scale
    hit = origin + distance[:, None] * direction - a
    across = np.linalg.norm(normal, axis=1) ** 2
    u = (np.cross(hit, last) * normal).sum(axis=1) / np.maximum(across, 1e-300)
    v = (np.cross(first, hit) * normal).sum(axis=1) / np.maximum(across, 1e-300)
    inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (slope > 1e-12)
    found = distance[inside & (distance > 0)]
    return float(found.min()) if len(found) else 0.0
