"""Forces of fingertips on the paper's beam: an example of the forces that a user gives in a file.

Each force is that of two fingertips which press on the long faces or the end of the beam and drag
the surface. The program writes them to a file of `loads=file`, from the top folder of the
repository: python benchmarks/loads/fingertips.py benchmarks/loads/fingertips.npz
"""

import sys

import numpy as np
from numpy.typing import NDArray

from dpl.fem import box

SIZE = 100.0, 25.0, 25.0  # of the beam [m]
NODES = 40, 10, 10
COUNT = 32  # forces
FACES = (1, 0), (1, 1), (2, 0), (2, 1), (0, 1)  # axis and end of each face that is pressed
RADII = 4.0, 8.0  # smallest and largest radius of a fingertip [m]
PUSH = 2e3, 1e4  # smallest and largest force across the face [N]
FRICTION = 0.5  # largest force along the face over that across it [-]
NEAREST = 0.3  # smallest distance of a fingertip from the clamped end over the length [-]


def fingertip(points: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the nodal forces (N, 3) [N] of one fingertip on the boundary nodes (N, 3) [m]."""
    axis, end = FACES[rng.integers(len(FACES))]
    centre = rng.uniform([NEAREST, 0.0, 0.0], 1.0) * SIZE
    centre[axis] = end * SIZE[axis]
    away = np.linalg.norm(points - centre, axis=1) / rng.uniform(*RADII)
    weights = np.where(np.isclose(points[:, axis], centre[axis]), np.exp(-(away**2) / 2), 0.0)
    weights[weights < 0.05] = 0.0
    push = rng.uniform(*PUSH)
    force = push * rng.uniform(-FRICTION, FRICTION, 3)
    force[axis] = push * (1 - 2 * end)
    result: NDArray[np.float64] = np.outer(weights / weights.sum(), force)
    return result


def main(path: str) -> None:
    """Write `COUNT` forces of two fingertips each, (COUNT, N, 3) [N]."""
    points, rng = box(SIZE, NODES).p.T, np.random.default_rng(0)
    forces = [fingertip(points, rng) + fingertip(points, rng) for _ in range(COUNT)]
    np.savez_compressed(path, forces=np.array(forces, dtype=np.float32))


if __name__ == "__main__":
    main(sys.argv[1])
