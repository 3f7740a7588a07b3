"""Random bodies, laws, supports, deformations and loads."""

import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import skfem
import torch
from hypothesis import strategies as st
from laws import HOOKEAN
from torch import Tensor

from dpl import fem
from dpl.fem.loads import body_force, traction

CUBOID = {"hexahedron": fem.box, "tetra": fem.box, "quad": fem.rectangle, "triangle": fem.rectangle}
HELD = ("clamp", "clamps", "moved", "bed", "rollers")  # each leaves no rigid motion
# laws of bodies with mean dilatation: the loops of each of them take seconds to compile
DILATED = fem.LinearElastic, fem.SaintVenantKirchhoff, fem.NeoHookeanLn, fem.NeoHookeanIsoK2
SHAKEN = 0.15  # of the distance to a neighbour: cells of any shape keep their sense

seeds = st.integers(0, 2**32 - 1)


def logarithmic(low: float, high: float) -> st.SearchStrategy[float]:
    """Return numbers between two, their orders of magnitude even."""
    return st.floats(np.log10(low), np.log10(high)).map(lambda power: float(10.0**power))


@dataclass(frozen=True)
class Body:
    """A cuboid on a grid, described so that it can be turned, moved, made larger and built anew."""

    cell: str
    degree: int
    law: fem.Material
    support: str  # one of `HELD`, or "free"
    sides: tuple[float, ...]  # over its size, (D,)
    counts: tuple[int, ...]  # of vertices along each side
    grading: tuple[float, ...]  # powers of the coordinates, from 0 to 1
    shaken: float  # largest motion of inner vertices over their distance
    mean_dilatation: bool
    size: float  # unit of length [m]
    turned: int  # seed of the rotation; 0: not turned
    shift: float  # distance from the origin, over the size
    seed: int  # of the rest that is random

    @property
    def dim(self) -> int:
        """D."""
        return len(self.sides)

    @cached_property
    def rotation(self) -> np.ndarray:
        """Q, (D, D)."""
        return rotation(self.dim, self.turned).numpy()

    @cached_property
    def origin(self) -> np.ndarray:
        """Where its corner lies, over its size, (D,)."""
        way = np.random.default_rng(self.turned).standard_normal(self.dim)
        return self.shift * way / np.linalg.norm(way)

    @cached_property
    def mesh(self) -> skfem.Mesh:
        """Its mesh [m]."""
        grid = CUBOID[self.cell]([1.0] * self.dim, self.counts, self.cell)
        powers = np.array(self.grading)
        ticks = [np.linspace(0, 1, n) ** g for n, g in zip(self.counts, powers, strict=True)]
        room = np.array([np.diff(t).min() for t in ticks])
        shift = np.random.default_rng(self.seed).uniform(-1, 1, grid.p.shape)
        shift[:, grid.boundary_nodes()] = 0.0
        p = grid.p ** powers[:, None] + self.shaken * room[:, None] * shift
        p = self.rotation @ (p * np.array(self.sides)[:, None]) + self.origin[:, None]
        return type(grid)(self.size * p, grid.t)

    def face(self, axis: int, end: str):
        """Return one of its sides as a region."""
        at = {"min": 0.0, "max": self.sides[axis]}[end]

        def side(points: np.ndarray) -> np.ndarray:
            own = (points / self.size - self.origin) @ self.rotation
            return np.abs(own[:, axis] - at) < 1e-7

        return side

    def build(self, **options) -> fem.Problem:
        """Return the problem; `options` of `Problem.build` come on top."""
        supports = []
        if self.support in ("clamp", "clamps", "moved"):
            supports.append(fem.DirichletBC(self.face(0, "min")))
        if self.support in ("clamps", "moved"):
            by = np.random.default_rng(self.seed).uniform(-0.1, 0.1, self.dim)
            by = by * min(self.sides) * (self.support == "moved")
            way = (self.size * self.rotation @ by).tolist()
            supports.append(fem.DirichletBC(self.face(0, "max"), way))
        if self.support == "bed":
            supports.append(fem.RobinBC(self.face(0, "min"), 0.5 / self.size))
        if self.support == "rollers":
            for axis in range(self.dim):
                value = [0.0 if i == axis else None for i in range(self.dim)]
                supports.append(fem.DirichletBC(self.face(axis, "min"), value))
        options = {"mean_dilatation": self.mean_dilatation, "degree": self.degree} | options
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # linear elements may lock: not the subject here
            return fem.Problem.build(self.mesh, self.law, supports=supports, **options)


@dataclass(frozen=True)
class Push:
    """A load of one kind, turned as its body is."""

    kind: str  # noise, at one point, traction on a side, weight, or squeeze: pressure on the end
    size: float  # largest displacement of its linear solution over L
    seed: int

    def on(self, body: Body, linear: fem.LinearSolver) -> fem.Load:
        """Return the load on a body."""
        problem, random = linear.problem, np.random.default_rng(self.seed)
        way = random.standard_normal(body.dim)
        if self.kind == "squeeze":
            way = -np.eye(body.dim)[0]

        def stress(x: np.ndarray) -> np.ndarray:
            return np.multiply.outer(body.rotation @ way, np.ones(x.shape[1:]))

        if self.kind == "noise":
            force = torch.from_numpy(random.standard_normal(problem.shape) @ body.rotation.T)
        elif self.kind == "point":
            force = torch.zeros(problem.shape, dtype=torch.float64)
            movable = problem.free.any(dim=1).nonzero().flatten()
            node = movable[random.integers(len(movable))]
            force[node] = torch.from_numpy(body.rotation @ way)
        elif self.kind == "weight":
            force = body_force(problem, stress)
        else:
            axis = 0 if self.kind == "squeeze" else 1
            force = traction(problem, body.face(axis, "max"), stress, problem.length)
        force = self.size * force / linear.solve(force).abs().max()
        return load_of(force[None])


def load_of(force: Tensor) -> fem.Load:
    """Return forces (B, N, D) as a load."""
    return fem.Load(force, torch.ones(len(force), dtype=torch.float64))


def rotation(dim: int, seed: int) -> Tensor:
    """Return a rotation (D, D), the identity for 0."""
    if not seed:
        return torch.eye(dim, dtype=torch.float64)
    Q, R = np.linalg.qr(np.random.default_rng(seed).standard_normal((dim, dim)))
    Q = Q * np.sign(np.diag(R))
    Q[:, 0] *= np.linalg.det(Q)
    return torch.from_numpy(Q)


@st.composite
def laws(draw, finite: bool = False) -> fem.Material:
    """Draw any law (or `finite`: of large strains) that resists shear and pressure at rest."""
    kinds = [kind for kind in HOOKEAN if not (finite and kind is fem.LinearElastic)]
    kind = draw(st.sampled_from([*kinds, fem.MooneyRivlinK2, fem.YeohK2, fem.OgdenK2]))
    if kind in HOOKEAN:
        return kind(draw(st.floats(-0.9, 0.49)))
    bulk = draw(logarithmic(0.1, 100.0))
    if kind is fem.MooneyRivlinK2:
        c10 = draw(st.floats(0.05, 0.5))
        return fem.MooneyRivlinK2(c10, draw(st.floats(-c10 / 2, 0.5)), bulk)
    if kind is fem.YeohK2:
        c10, c20 = draw(st.floats(0.05, 0.5)), draw(st.floats(-0.05, 0.1))
        return fem.YeohK2(c10, c20, draw(st.floats(0.0, 0.05)), bulk)
    exponents = st.floats(0.5, 5.0) | st.floats(-5.0, -0.5)
    first = draw(st.floats(0.1, 0.5)), draw(exponents)
    others = draw(st.lists(st.tuples(st.floats(-0.04, 0.3), exponents), max_size=2))
    shear, powers = zip(first, *others, strict=True)
    return fem.OgdenK2(shear, powers, bulk)


@st.composite
def bodies(draw, supports: tuple[str, ...] = HELD, law: st.SearchStrategy | None = None) -> Body:
    """Draw a body of less than 130 nodes with one of the supports and any law, or a given one."""
    cell, degree = draw(st.sampled_from(sorted(CUBOID))), draw(st.integers(1, 2))
    dim = 3 if CUBOID[cell] is fem.box else 2
    support = draw(st.sampled_from(supports))
    most = {(2, 1): 8, (2, 2): 5, (3, 1): 4, (3, 2): 3}[dim, degree]
    least = [3 if support in ("clamps", "moved") and axis == 0 else 2 for axis in range(dim)]
    counts = tuple(draw(st.integers(low, most)) for low in least)
    even = draw(st.booleans())
    own = draw(laws() if law is None else law)
    return Body(
        cell=cell,
        degree=degree,
        law=own,
        support=support,
        sides=(1.0, *(draw(logarithmic(0.1, 1.0)) for _ in counts[1:])),
        counts=counts,
        grading=tuple(1.0 if even else draw(st.floats(0.6, 1.8)) for _ in counts),
        shaken=0.0 if even else draw(st.floats(0.0, SHAKEN)),
        mean_dilatation=(degree == 2) == (cell in ("triangle", "tetra"))
        and draw(st.booleans())
        and isinstance(own, DILATED),
        size=draw(logarithmic(1e-3, 1e3)),
        turned=0 if support == "rollers" else draw(st.just(0) | seeds),
        shift=draw(st.floats(0.0, 10.0)),
        seed=draw(seeds),
    )


@st.composite
def pushes(draw, body: Body, low: float = 1e-9, high: float = 10.0) -> Push:
    """Draw a load that moves a body; its linear solution over L lies between two bounds."""
    kinds = ["noise", "point", "weight"]
    if body.support not in ("clamps", "moved") or body.counts[0] > 2:
        kinds.append("traction")
    if body.support in ("clamp", "bed", "rollers"):
        kinds.append("squeeze")
    return Push(draw(st.sampled_from(kinds)), draw(logarithmic(low, high)), draw(seeds))


@st.composite
def cases(draw, *, low: float = 1e-9, high: float = 10.0, **options) -> tuple[Body, Push]:
    """Draw a body (`options` of `bodies`) and a load on it (bounds as for `pushes`)."""
    body = draw(bodies(**options))
    return body, draw(pushes(body, low, high))


def gradients(problem: fem.Problem, displacement: Tensor) -> Tensor:
    """Return H of displacements (B, N, D), (B, E, Q, D, D), by the plainest sum."""
    dN = problem.dN.expand(len(problem.cells), -1, -1, -1)
    return torch.einsum("beai,eqaj->beqij", displacement[:, problem.cells], dN)


def bent(problem: fem.Problem, steepness: float, seed: int) -> Tensor:
    """Return a displacement (1, N, D) of waves and some noise, the largest |H| `steepness`.

    Below 1 they invert nothing: no singular value of F is below 1 - |H|.
    """
    random, points = np.random.default_rng(seed), problem.points.numpy()
    points = points - points.mean(axis=0)
    dim = points.shape[1]
    waves = points @ random.standard_normal((dim, dim))
    waves += np.sin(4 * points @ random.standard_normal((dim, dim)) + random.uniform(0, 6, dim))
    waves += random.choice([0.0, 0.02]) * random.standard_normal(points.shape)
    u = torch.from_numpy(waves)[None]
    return u * steepness / gradients(problem, u).norm(dim=(-2, -1)).max()
