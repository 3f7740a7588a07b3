"""Bodies of two laws: a bonded beam of two layers, and a stiff ball in a large matrix."""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from itertools import pairwise
from operator import add
from pathlib import Path

import numpy as np
import skfem
from torch import Tensor

from benchmarks.study import picture
from benchmarks.verification.bodies import Array, balanced
from benchmarks.verification.drawing import measured, panel
from benchmarks.verification.report import Row, Section
from dpl.fem import DirichletBC, LinearElastic, LinearSolver, Newton, Plane, Problem, box
from dpl.fem.loads import traction

LENGTH, HEIGHT, WIDTH = 10.0, 1.0, 0.5  # of the beam [mm]
LAYER = 0.4  # thickness of its lower layer [mm]
RATIOS = (2.0, 10.0, 100.0)  # of the Young's moduli of its layers, lower over upper
POISSON = 0.3
STIFFNESS = 10.0  # Young's modulus of the ball over that of the matrix
SIZES = (2.0, 4.0, 8.0, 16.0)  # radius of the matrix over that of the ball
CELLS = (1, 2, 3)  # cells along an edge of the block in the ball
REMOTE = (0.0, 0.0, 1e-3)  # principal strains far from the ball [-]
PATCH = 0.45  # half side of this block in the space of parameters


def transformed_section(ratio: float) -> tuple[float, float]:
    """Return z [mm] of the neutral axis and E I per width [mm^3] of the two layers, upper E = 1.

    Source: Gere, Timoshenko (1997), Mechanics of Materials, section 6.3, transformed section.
    """
    areas = np.array([ratio * LAYER, HEIGHT - LAYER])
    centres = np.array([LAYER / 2, (HEIGHT + LAYER) / 2])
    axis = float(areas @ centres / areas.sum())
    own = ratio * LAYER**3 / 12 + (HEIGHT - LAYER) ** 3 / 12
    return axis, float(own + areas @ (centres - axis) ** 2)


def layered_beam(ratio: float, cells: int) -> Problem:
    """Return half of the beam, symmetric to x = 0, nu = 0, E = `ratio` below and 1 above."""
    mesh = box([LENGTH, WIDTH, 1.0], [cells + 1, 2, 3])
    x, y, z = mesh.p
    mesh = skfem.MeshHex(np.stack([x, y, np.interp(z, [0, 0.5, 1], [0, LAYER, HEIGHT])]), mesh.t)
    return Problem.build(
        mesh,
        {"lower": LinearElastic(0.0, young=ratio), "other": LinearElastic(0.0)},
        regions={"lower": lambda points: points[:, 2] < LAYER},
        supports=[
            DirichletBC(Plane(0, "min"), [0.0, None, None]),
            DirichletBC(Plane(1, "min"), [None, 0.0, None]),
            DirichletBC(lambda x: np.abs(x[:, [0, 2]]).max(axis=1) < 1e-9, [None, None, 0.0]),
        ],
        degree=2,
        length=1.0,
    )


def bent(ratio: float, cells: int = 5) -> tuple[float, float]:
    """Return the curvature over that of the theory, and the largest error of u over its maximum.

    The end has the stress of the theory, E (z - axis) / R; u = (x (axis - z), 0, x^2 / 2) / R is
    then the exact solution for a Poisson's ratio of 0, and quadratic elements contain it.
    """
    problem = layered_beam(ratio, cells)
    axis, stiffness = transformed_section(ratio)
    shift = problem.origin if isinstance(problem.origin, float) else problem.origin[:, None, None]
    moment = 1e-3 * stiffness  # per width, of the radius 1000 mm

    def stress(x: Array) -> Array:
        z = (x + shift)[2]
        young = np.where(z < LAYER, ratio, 1.0)
        return np.stack([moment / stiffness * young * (axis - z), 0 * z, 0 * z])

    force = traction(problem, Plane(0, "max"), stress)
    u = LinearSolver(problem).solve_force(force).numpy()
    x, _, z = (problem.points.numpy() + problem.origin).T
    exact = 1e-3 * np.stack([x * (axis - z), 0 * x, x**2 / 2], axis=1)
    tip = (x > LENGTH - 1e-9) & (z < 1e-9)
    curvature = 2 * u[tip, 2].mean() / LENGTH**2
    return curvature / 1e-3, float(np.abs(u - exact).max() / np.abs(exact).max())


def eshelby(remote: Sequence[float]) -> Array:
    """Return the strain in a ball in an infinite matrix under a remote strain, (3,) [-].

    Source: Eshelby (1957), Proc. R. Soc. A 241, eq. 3.15: alpha and beta of the ball are the parts
    of a free strain that remain. Both bodies have the Poisson's ratio `POISSON`.
    """
    alpha = (1 + POISSON) / (3 * (1 - POISSON))
    beta = 2 * (4 - 5 * POISSON) / (15 * (1 - POISSON))
    mean = np.full(3, np.mean(remote))
    rest = np.asarray(remote) - mean
    return mean / (1 + alpha * (STIFFNESS - 1)) + rest / (1 + beta * (STIFFNESS - 1))


def ball(cells: int, size: float) -> skfem.Mesh:
    """Return an octant of the matrix with radius `size` around a ball of radius 1.

    A block of cells at the centre and shells around it have no degenerate cell.
    """
    block = box([PATCH] * 3, [cells + 1] * 3)
    inside, outside = max(1, cells // 2), cells * round(np.log2(size))
    shell = box([1.0] * 3, [inside + outside + 1, cells + 1, cells + 1])
    steps = np.linspace(0, 1, inside + outside + 1)
    stops = np.concatenate(
        [np.linspace(PATCH, 1, inside + 1), 1 + np.linspace(0, 1, outside + 1)[1:]]
    )
    m = np.interp(shell.p[0], steps, stops)
    face = m * np.stack([np.ones_like(m), shell.p[1], shell.p[2]])
    parts = [skfem.MeshHex(np.roll(face, k, axis=0), shell.t) for k in range(3)]
    mesh = reduce(add, parts, block)
    core = np.flatnonzero(mesh.p[:, mesh.t].max(axis=0).max(axis=0) < 1 + 1e-6)
    mesh = skfem.MeshHex2.from_mesh(mesh)
    return skfem.MeshHex2(_placed(mesh.doflocs, size), mesh.t).with_subdomains({"ball": core})


def _placed(parameters: Array, size: float) -> Array:
    """Return the points of parameters (3, N) with the largest entry m.

    The block m <= PATCH becomes a cube with curved sides; m = 1 is the surface of the ball, and
    beyond, radii grow geometrically to `size` at m = 2.
    """
    m = parameters.max(axis=0)
    scaled = parameters / np.where(m, m, 1.0)
    sphere = np.tan(np.pi / 4 * scaled)
    sphere /= np.maximum(np.linalg.norm(sphere, axis=0), 1e-9)  # 0 at the centre
    at = parameters / PATCH * np.minimum(1.0, PATCH / np.where(m, m, 1.0))
    square = at**2
    bulge = 1 - 0.12 * (square.sum(axis=0) - square)
    inner = 0.5 * at * bulge
    share = np.clip((m - PATCH) / (1 - PATCH), 0.0, 1.0)
    radius = size ** np.clip(m - 1, 0.0, None)
    return np.asarray((1 - share) * inner + share * sphere * radius)


def ball_strain(cells: int, size: float, remote: Sequence[float]) -> tuple[Array, float]:
    """Return the mean strain in the ball, (3,) [-], and its largest deviation in the ball.

    The surface of the matrix, of radius `size`, has the displacement of the remote strain.
    """
    mesh = ball(cells, size)
    build: Callable[..., Problem] = partial(
        Problem.build,
        mesh,
        {"ball": LinearElastic(POISSON, young=STIFFNESS), "other": LinearElastic(POISSON)},
        degree=2,
        length=1.0,
    )
    points = build().points.numpy() + build().origin
    outer = np.linalg.norm(points, axis=1) > size * (1 - 1e-9)
    fixed = (points < 1e-9) | outer[:, None]
    problem = build(fixed=fixed, prescribed=points * np.asarray(remote))
    u = balanced(Newton(problem)).displacement
    strain = problem.tensors.strain(u)[0, mesh.subdomains["ball"]].diagonal(dim1=-2, dim2=-1)
    weights = problem.dV[mesh.subdomains["ball"]][..., None]
    mean: Tensor = (weights * strain).sum((0, 1)) / weights.sum()
    return mean.numpy(), float((strain - mean).abs().max() / mean.norm())


def composites(folder: Path) -> Section:
    """Compare a bonded beam with composite beam theory, and a ball with Eshelby's strain."""
    rows = []
    for ratio in RATIOS:
        curvature, error = bent(ratio)
        name = f"beam, moduli {ratio:g} : 1, 5 × 1 × 2 hex27"
        rows += [
            Row(f"{name}: curvature over M / (E I)", "1", curvature, 1e-8),
            Row(f"{name}: largest error of u over its maximum", "< 1e-8", error),
        ]
    exact = eshelby(REMOTE)
    printed = f"{exact[2] / REMOTE[2]:.6f}"
    errors = {}
    for cells in CELLS:
        for size in SIZES:
            strain, deviation = ball_strain(cells, size, REMOTE)
            errors[cells, size] = float(np.linalg.norm(strain - exact) / np.linalg.norm(exact))
            if size == SIZES[-1]:
                name = f"ball, {cells} cells along the block, R = {size:g} a"
                bound = {1: 0.05, 2: 0.01}.get(cells, 2e-3)
                rows += [
                    Row(f"{name}: ε_zz / ε∞", printed, strain[2] / REMOTE[2], bound),
                    Row(
                        f"{name}: largest deviation from the mean strain", f"< {bound:g}", deviation
                    ),
                ]
    fine = CELLS[-1]
    for small, large in pairwise(SIZES[:-1]):
        name = f"ball, error at R = {small:g} a over that at {large:g} a (8 for an error of a³/R³)"
        rows.append(Row(name, "8", errors[fine, small] / errors[fine, large], 0.25))
    with picture(folder / "composites.png", 2.9) as figure:
        axes = panel(figure, 1, "radius of the matrix over that of the ball", "relative error", "")
        for k, cells in enumerate(CELLS):
            measured(axes, SIZES, [errors[cells, size] for size in SIZES], k, f"{cells} cells")
        axes.set(xscale="log", yscale="log")
        axes.set_xticks(SIZES, [f"{size:g}" for size in SIZES])
        axes.minorticks_off()
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return Section(
        "Bodies of two materials",
        "transformed section; Eshelby 1957 (Proc. R. Soc. A 241)",
        "Bonded layers of 0.4 and 0.6 mm in bending; a ball in a matrix of a tenth of its "
        "modulus under a remote strain, with an error of the order a³/R³ of the finite matrix R.",
        rows,
    )
