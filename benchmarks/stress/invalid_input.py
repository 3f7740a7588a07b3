"""What cannot work and is refused: T9 and T12 to T16."""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.stress import broken_meshes, fixtures
from benchmarks.stress.auditor import Auditor
from benchmarks.stress.case import Case, Outcome, all_of, classify, refused
from benchmarks.stress.fixtures import load_of
from benchmarks.verification.report import Row
from dpl.fem import (
    Box,
    DirichletBC,
    LinearSolver,
    ModalLoads,
    NeoHookeanLn,
    Newton,
    Plane,
    Problem,
    RobinBC,
    Status,
    Tag,
    Traction,
    box,
    eigenmodes,
    installed_backends,
    read_mesh,
)
from dpl.fem.mesh import check_mesh

NH = NeoHookeanLn(0.3)
APART = ["two pieces", "crack"]  # T14; the rest of the flaws are T15's
NOWHERE = {"plane": Plane(0, 0.3), "box": Box([2, 2, 2], [3, 3, 3]), "tag": Tag("end")}
USES: dict[str, Callable[[Any, Any], Any]] = {  # what takes a region: of mesh and region
    "fixed": lambda mesh, region: Problem.build(mesh, NH, fixed=region),
    "moved": lambda mesh, region: Problem.build(mesh, NH, supports=[DirichletBC(region)]),
    "spring": lambda mesh, region: Problem.build(mesh, NH, supports=[RobinBC(region, 1.0)]),
    "loaded": lambda mesh, region: Traction(region, [0, 0, 1.0]).on(Problem.build(mesh, NH)),
}


def of_modulus(young: float) -> ModalLoads:
    """Return loads on the beam of a Young's modulus [Pa]."""
    problem = fixtures.beam_of("hexahedron", 1, NH)
    return ModalLoads(LinearSolver(problem), n_modes=1, young=young)


IMPOSSIBLE: dict[str, tuple[Callable[[], Any], str]] = {  # T9: call, words
    **{
        f"nu = {nu}": (partial(NeoHookeanLn, nu), "poisson")
        for nu in (0.5, 0.7, -1.0, float("nan"), float("inf"))
    },
    **{
        f"E = {young}": (partial(of_modulus, young), "young")
        for young in (0.0, -5.0, float("nan"), float("inf"))
    },
}


def inverted(watch: Auditor) -> Outcome:
    """Check a mesh of which four cells are inverted."""
    return refused(
        "folded", lambda: check_mesh(fixtures.folded()), "4 cells are inverted: 2, 3, 6, 7"
    )


def impossible(watch: Auditor) -> Outcome:
    """Build what cannot be."""
    found = [refused(name, call, said) for name, (call, said) in IMPOSSIBLE.items()]
    return _counted(found)


def _counted(found: list[Outcome]) -> Outcome:
    """Return outcomes as one; where all are as expected, in few words."""
    whole = all_of(found)
    if any(outcome.verdict != found[0].verdict for outcome in found) or len(found) == 1:
        return whole
    return Outcome(f"{len(found)} errors, such as {found[0].happened}", whole.verdict)


def held_too_little(support: str, watch: Auditor) -> Outcome:
    """Load a body that can move as a whole: by every backend, and ask for its modes."""
    problem = fixtures.loose(support)
    linear = LinearSolver(problem)
    outcome = refused(support, lambda: eigenmodes(linear, 3), fixtures.LOOSE[support][1])
    force = Traction(Plane(0, "max"), [0.0, 0.0, -1e-3]).on(problem)
    rows = [Row("factors before the error", "0", float("factor" in linear.__dict__))]
    for name in installed_backends():
        state = watch.solve(Newton(problem, linear=name), problem, load_of(force))
        rows.append(Row(f"{name}: converged", "< 0.5", float(state.converged)))
        rows.append(Row(f"{name}: |u|/L", "0", float(state.displacement.abs().max())))
    return all_of([outcome, classify(f"{Status(int(state.status))}, at rest", rows)])


def read_flawed(names: list[str], watch: Auditor) -> Outcome:
    """Read files of meshes that cannot be solved."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            said, points, cells = broken_meshes.BAD[name]
            path = broken_meshes.write(Path(folder) / "bad.vtu", np.asarray(points, float), **cells)
            found.append(refused(name, partial(read_mesh, path), said))
    return _counted([_without(outcome, folder) for outcome in found])


def read_broken(watch: Auditor) -> Outcome:
    """Read half a file, an empty one, one of nonsense, and none."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        whole = broken_meshes.write(
            Path(folder) / "whole.vtu", broken_meshes.TWO_CUBES, hexahedron=broken_meshes.TWO_HEXES
        ).read_bytes()
        for name, content in (("half", whole[: len(whole) // 2]), ("empty", b""), ("text", b"no")):
            path = Path(folder) / f"{name}.vtu"
            path.write_bytes(content)
            found.append(refused(name, partial(read_mesh, path), f"{name}.vtu"))
        found.append(refused("none", partial(read_mesh, Path(folder) / "none.vtu"), "none.vtu"))
    return _counted([_without(outcome, folder) for outcome in found])


def _without(outcome: Outcome, folder: str) -> Outcome:
    """Return an outcome that does not name a folder of this moment."""
    return Outcome(outcome.happened.replace(folder, "..."), outcome.verdict)


def nowhere(watch: Auditor) -> Outcome:
    """Hold and load bodies where they have no node."""
    mesh = box([1.0, 1.0, 1.0], [3, 3, 3])
    found = []
    for use, call in USES.items():
        for where, region in NOWHERE.items():
            words = "no tags at all" if where == "tag" else "holds no"
            found.append(refused(f"{use}, {where}", partial(call, mesh, region), words))
    return _counted(found)


def cases() -> list[Case]:
    """Return the cases of this theme."""
    found = []
    expected = "an error that names the key, before anything is computed"
    found.append(Case("T9", "nu and E out of range, not finite", expected, impossible))
    expected = "an error with the numbers of the cells"
    found.append(Case("T12", "cells inverted at rest", expected, inverted))
    for support, (_, told) in fixtures.LOOSE.items():
        expected = f"'{told}', before any factor; Newton: no valid equilibrium, at rest"
        found.append(
            Case("T13", f"support: {support}", expected, partial(held_too_little, support))
        )
    others = [name for name in broken_meshes.BAD if name not in APART]
    expected = "an error with the sizes of pieces or the nodes"
    found.append(Case("T14", "two pieces, crack", expected, partial(read_flawed, APART)))
    expected = "each an error of one line with its own words"
    run = partial(read_flawed, others)
    found.append(Case("T15", f"{len(others)} meshes that cannot be solved", expected, run))
    found.append(Case("T15", "half a file, an empty one, nonsense, none", expected, read_broken))
    expected = "an error, not a load or a support left out"
    what = f"{len(USES)} uses of {len(NOWHERE)} regions without a node"
    return [*found, Case("T16", what, expected, nowhere)]
