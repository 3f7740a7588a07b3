"""Invalid input that must raise an error: T9 and T12 to T16."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.stress import broken_meshes, fixtures
from benchmarks.stress.auditor import Auditor
from benchmarks.stress.case import Case, Outcome, classify, combine, expect_error
from benchmarks.stress.fixtures import as_load
from benchmarks.verification.report import Row
from dpl import fem
from dpl.fem.mesh import check_mesh

NH = fem.NeoHookeanLn(0.3)
DISCONNECTED = ["two pieces", "crack"]  # T14; the other meshes are T15
EMPTY_REGIONS = {
    "plane": fem.Plane(0, 0.3),
    "box": fem.Box([2, 2, 2], [3, 3, 3]),
    "tag": fem.Tag("end"),
}
REGION_USES: dict[str, Callable[[Any, Any], Any]] = {  # functions of mesh and region
    "fixed": lambda mesh, region: fem.Problem.build(mesh, NH, fixed=region),
    "moved": lambda mesh, region: fem.Problem.build(mesh, NH, supports=[fem.DirichletBC(region)]),
    "spring": lambda mesh, region: fem.Problem.build(mesh, NH, supports=[fem.RobinBC(region, 1.0)]),
    "loaded": lambda mesh, region: fem.Traction(region, [0, 0, 1.0]).on(
        fem.Problem.build(mesh, NH)
    ),
}


def of_modulus(young: float) -> fem.ModalLoads:
    """Return modal loads on the beam with a Young's modulus [Pa]."""
    problem = fixtures.coarse_beam("hexahedron", 1, NH)
    return fem.ModalLoads(fem.LinearSolver(problem), n_modes=1, young=young)


OUT_OF_RANGE: dict[str, tuple[Callable[[], Any], str]] = {  # T9: call, words
    **{
        f"nu = {nu}": (partial(fem.NeoHookeanLn, nu), "poisson")
        for nu in (0.5, 0.7, -1.0, float("nan"), float("inf"))
    },
    **{
        f"E = {young}": (partial(of_modulus, young), "young")
        for young in (0.0, -5.0, float("nan"), float("inf"))
    },
}


def inverted_cells(auditor: Auditor) -> Outcome:
    """Check a mesh with four inverted cells."""
    mesh = fem.box([1.0, 1.0, 1.0], [3, 3, 3])
    points = mesh.p.copy()
    points[:, (points == 0.5).all(axis=0)] = [[1.4], [0.5], [0.5]]  # the node in the middle
    folded = replace(mesh, doflocs=points)
    return expect_error("folded", lambda: check_mesh(folded), "4 cells are inverted: 2, 3, 6, 7")


def out_of_range_constants(auditor: Auditor) -> Outcome:
    """Construct objects with constants out of range."""
    found = [expect_error(name, call, said) for name, (call, said) in OUT_OF_RANGE.items()]
    return _counted(found)


def _counted(found: list[Outcome], folder: str | None = None) -> Outcome:
    """Return outcomes as one, shortened where all have the same verdict, without a folder."""
    if folder is not None:
        found = [replace(one, observed=one.observed.replace(folder, "...")) for one in found]
    whole = combine(found)
    if any(outcome.verdict != found[0].verdict for outcome in found) or len(found) == 1:
        return whole
    return Outcome(f"{len(found)} errors, such as {found[0].observed}", whole.verdict)


def underconstrained(support: str, auditor: Auditor) -> Outcome:
    """Solve and compute modes of a body with rigid-body modes, with every backend."""
    held, words = fixtures.UNDERCONSTRAINED[support]
    problem = fem.Problem.build(fem.box([4.0, 1.0, 1.0], [5, 2, 2]), NH, fixed=held)
    linear = fem.LinearSolver(problem)
    outcome = expect_error(support, lambda: fem.eigenmodes(linear, 3), words)
    force = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, -1e-3]).on(problem)
    rows = [Row("factors before the error", "0", float("factor" in linear.__dict__))]
    for name in fem.installed_backends():
        state = auditor.solve(fem.Newton(problem, linear=name), problem, as_load(force))
        rows.append(Row(f"{name}: converged", "< 0.5", float(state.converged)))
        rows.append(Row(f"{name}: |u|/L", "0", float(state.displacement.abs().max())))
    return combine([outcome, classify(f"{fem.Status(int(state.status))}, at rest", rows)])


def read_broken_meshes(names: list[str], auditor: Auditor) -> Outcome:
    """Read files of invalid meshes."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            said, points, cells = broken_meshes.BROKEN_MESHES[name]
            path = broken_meshes.write(Path(folder) / "bad.vtu", np.asarray(points, float), **cells)
            found.append(expect_error(name, partial(fem.read_mesh, path), said))
    return _counted(found, folder)


def read_damaged_files(auditor: Auditor) -> Outcome:
    """Read a truncated file, an empty file, a text file and a missing file."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        whole = broken_meshes.write(
            Path(folder) / "whole.vtu", broken_meshes.TWO_CUBES, hexahedron=broken_meshes.TWO_HEXES
        ).read_bytes()
        for name, content in (("half", whole[: len(whole) // 2]), ("empty", b""), ("text", b"no")):
            path = Path(folder) / f"{name}.vtu"
            path.write_bytes(content)
            found.append(expect_error(name, partial(fem.read_mesh, path), f"{name}.vtu"))
        found.append(
            expect_error("none", partial(fem.read_mesh, Path(folder) / "none.vtu"), "none.vtu")
        )
    return _counted(found, folder)


def empty_regions(auditor: Auditor) -> Outcome:
    """Use regions without nodes as supports and loads."""
    mesh = fem.box([1.0, 1.0, 1.0], [3, 3, 3])
    found = []
    for use, call in REGION_USES.items():
        for where, region in EMPTY_REGIONS.items():
            words = "must be a group of the mesh" if where == "tag" else "holds no"
            found.append(expect_error(f"{use}, {where}", partial(call, mesh, region), words))
    return _counted(found)


def cases() -> list[Case]:
    """Return the cases of this module."""
    expected = "an error that names the key, before anything is computed"
    found = [Case("T9", "nu and E out of range, not finite", expected, out_of_range_constants)]
    expected = "an error with the numbers of the cells"
    found.append(Case("T12", "cells inverted at rest", expected, inverted_cells))
    for support, (_, message) in fixtures.UNDERCONSTRAINED.items():
        expected = f"'{message}', before any factor; Newton: no valid equilibrium, at rest"
        run = partial(underconstrained, support)
        found.append(Case("T13", f"support: {support}", expected, run))
    expected = "an error with the sizes of pieces or the nodes"
    run = partial(read_broken_meshes, DISCONNECTED)
    found.append(Case("T14", "two pieces, crack", expected, run))
    others = [name for name in broken_meshes.BROKEN_MESHES if name not in DISCONNECTED]
    description = f"{len(others)} meshes that cannot be solved"
    expected = "each an error of one line with its own words"
    found.append(Case("T15", description, expected, partial(read_broken_meshes, others)))
    description = "half a file, an empty one, nonsense, none"
    found.append(Case("T15", description, expected, read_damaged_files))
    expected = "an error, not a load or a support left out"
    description = f"{len(REGION_USES)} uses of {len(EMPTY_REGIONS)} regions without a node"
    return [*found, Case("T16", description, expected, empty_regions)]
