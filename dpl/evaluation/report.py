"""Solvers against each other on the same loads, one at a time: how wrong, how sure, how slow."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from dpl.evaluation.timing import Latency, describe, latencies, percentiles, time_interleaved
from dpl.fem import Problem, Solution, Solver
from dpl.fem import write_mesh as write_mesh
from dpl.inference import Direct, Hybrid, Simulator, default_hybrid
from dpl.scene import Sample
from dpl.system.threads import one_thread
from dpl.training import RelativeL2, Surrogate
from dpl.training.metrics import default_metrics, median
from dpl.visualization import plot_deformed


@dataclass(frozen=True)
class Row:
    """One solver over all loads.

    Attributes:
        solver: Its name.
        errors: The numbers of `dpl.training.metrics` against the truth.
        converged: Loads answered to the tolerance with nothing inverted.
        loads: Loads asked.
        iterations: Mean linear solves a load.
        worst_iterations: Most of them for one load.
        milliseconds: Median wall time of one load, its residual and min det F included [ms].
        slowest: 99th percentile of the same [ms].
        latency: Of the network's row: that of `sim(force)` and of the bare network.
    """

    solver: str
    errors: dict[str, float]
    converged: int
    loads: int
    iterations: float
    worst_iterations: int
    milliseconds: float
    slowest: float
    latency: Mapping[str, Latency] = field(default_factory=dict)


def clock(
    solvers: Mapping[str, Solver], batch: Sample, problem: Problem
) -> tuple[list[Row], dict[str, Tensor]]:
    """Return a row for each solver, and the displacements (B, N, D) [-] that it answered.

    Loads are asked one at a time, see `dpl.evaluation.timing.time_interleaved`.

    Args:
        solvers: Named.
        batch: The loads with the truth.
        problem: The body.
    """
    whole = time_interleaved(solvers, batch.load)
    rows = [_row(name, *taken, batch, problem) for name, taken in whole.items()]
    return rows, {name: answer.displacement for name, (answer, _) in whole.items()}


def _row(name: str, answer: Solution, times: Tensor, batch: Sample, problem: Problem) -> Row:
    errors = default_metrics(problem)
    errors.update(answer.displacement, batch)
    median, slowest = percentiles(times)
    return Row(
        solver=name,
        errors={key: float(value) for key, value in errors.compute().items()},
        converged=int(answer.converged.sum()),
        loads=len(answer.converged),
        iterations=float(answer.iterations.double().mean()),
        worst_iterations=int(answer.iterations.max()),
        milliseconds=median,
        slowest=slowest,
    )


def show(rows: Sequence[Row], title: str) -> None:
    """Print rows as a table."""
    table = Table(title=title, title_justify="left")
    columns = (
        "solver", "e_mean", "e_max", "SNR min [dB]", "rel. L2 median", "worst",
        "||R||/||f||", "min det F", "converged", "iterations", "worst", "p50 [ms]", "p99 [ms]",
    )  # fmt: skip
    for column in columns:
        table.add_column(column, justify="left" if column == "solver" else "right")
    for row in rows:
        e = row.errors
        table.add_row(
            row.solver,
            f"{e['e_mean']:.1e}",
            f"{e['e_max']:.1e}",
            f"{e['SNR_min']:.1f}",
            f"{e['rel_L2_median']:.2%}"
            if e["rel_L2_median"] > 1e-5
            else f"{e['rel_L2_median']:.0e}",
            f"{e['rel_L2_worst']:.1%}" if e["rel_L2_worst"] > 1e-4 else f"{e['rel_L2_worst']:.0e}",
            f"{e['residual']:.1e}",
            f"{e['min_det_F']:.2f}",
            f"{row.converged}/{row.loads}",
            f"{row.iterations:.1f}",
            f"{row.worst_iterations}",
            f"{row.milliseconds:.1f}",
            f"{row.slowest:.1f}",
        )
    Console(width=max(Console().width, 160)).print(table)


def compare(folder: Path) -> None:
    """Print the network and the hybrid of every evaluated run below a folder, then medians.

    Runs that differ in nothing but `seed` in their folder's name form a group.

    Raises:
        FileNotFoundError: No run below the folder has been evaluated.
    """
    found = sorted(folder.rglob("evaluation.json"))
    if not found:
        raise FileNotFoundError(f"{folder} holds no evaluated run")
    table = Table(title=str(folder), title_justify="left")
    names = ("e_mean", "e_max", "SNR_min", "rel_L2_median", "rel_L2_worst", "residual")
    for column in ("run", *names, "hybrid iterations", "hybrid ms / Newton ms"):
        table.add_column(column, justify="left" if column == "run" else "right")
    groups: dict[str, list[list[float]]] = {}
    for path in found:
        rows = {row["solver"]: row for row in json.loads(path.read_text())}
        network, hybrid = rows["network"]["errors"], rows["hybrid Newton"]
        ratio = hybrid["milliseconds"] / rows["Newton from zero"]["milliseconds"]
        numbers = [*(network[name] for name in names), hybrid["iterations"], ratio]
        name = str(path.parent.relative_to(folder))
        table.add_row(name, *(f"{number:.3g}" for number in numbers))
        groups.setdefault(re.sub(r",?seed=\d+,?", "", name), []).append(numbers)
    table.add_section()
    for name, members in groups.items():
        medians = median(torch.tensor(members)).tolist()
        table.add_row(f"median of {len(members)}: {name}", *(f"{number:.3g}" for number in medians))
    Console(width=max(Console().width, 160)).print(table)


def save(rows: Sequence[Row], path: Path) -> None:
    """Write rows as JSON."""
    path.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")


def evaluate(surrogate: Surrogate, test: Sample, folder: Path, *, tol: float = 1e-8) -> list[Row]:
    """Judge a surrogate: a table of five solvers, printed and saved, with a figure and one case.

    Linear answer, network, hybrid Newton from the network by the paper's rule and by the best, and
    Newton from zero, each asked one load at a time on one thread; and the latency of `sim(force)`
    and of the bare network. Writes `evaluation.json`, `shapes.png` and `worst.vtu`.

    Args:
        surrogate: On the CPU.
        test: Loads with the truth.
        folder: Where results go.
        tol: Residual ratio of Newton and the hybrid [-].
    """
    scene = surrogate.scene
    newton = replace(scene.newton, tol=tol)
    # with Poisson's ratios of their own, loads have their own K(0): each solver makes it for itself
    shared = scene.loads.poisson_range is None
    own = scene if shared else replace(scene, solver=replace(scene.newton))
    solvers: dict[str, Solver] = {
        "linear": replace(newton.linear_solver, tol=tol),
        "network": Direct(surrogate.predict, scene.problem, tol),
        "hybrid Newton": Hybrid(surrogate.predict, newton if shared else replace(newton), "paper"),
        "hybrid, best rule": default_hybrid(surrogate.predict, own, tol),
        "Newton from zero": newton,
    }
    with one_thread():
        rows, answers = clock(solvers, test, scene.problem)
    measured = latencies(Simulator(surrogate), test.load)
    rows = [replace(row, latency=measured) if row.solver == "network" else row for row in rows]
    show(rows, f"{len(test.force)} fresh loads, one at a time, 1 thread, tol {tol:g}")
    print(describe(measured))
    save(rows, folder / "evaluation.json")
    _picture(surrogate, test, answers, folder)
    return rows


def _picture(
    surrogate: Surrogate, test: Sample, answers: Mapping[str, Tensor], folder: Path
) -> None:
    """Draw the best, the median and the worst load of the network; write the worst as VTU."""
    scene, network = surrogate.scene, answers["network"]
    error = RelativeL2().measure(network, test)
    order = error.argsort()
    chosen = order[
        [0, (len(order) - 1) // 2, -1]
    ]  # of an even number of loads the better one in the middle
    names = [
        f"{name} load: relative L2 {error[k]:.2%}"
        for name, k in zip(("best", "median", "worst"), chosen, strict=True)
    ]
    shown = [(name, answers[name][chosen]) for name in ("network", "linear")]
    figure = plot_deformed(scene.problem, test.displacement[chosen], shown, names=names)
    figure.savefig(folder / "shapes.png", dpi=150)
    worst = int(order[-1])
    length, force_unit = scene.length, scene.force_unit * float(test.young[worst])
    fields = {
        "displacement [m]": length * test.displacement[worst],
        "network [m]": length * network[worst],
        "error [m]": length * (network[worst] - test.displacement[worst]).norm(dim=1),
        "force [N]": force_unit * test.force[worst],
    }
    write_mesh(
        folder / "worst.vtu",
        scene.problem.mesh_in_metres,
        {name: field.numpy() for name, field in fields.items()},
    )
