"""Parts of the comparison of the mechanics with public codes, see `benchmarks.commands.benchmark`.

Each part is a function of the configuration and of the linear backends to measure. It prints tables
and returns rows to write, or writes them itself and returns None.
"""

import json
import statistics
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks import generation as ways
from benchmarks import peers
from dpl import Scene, config
from dpl.evaluation.tables import machine, power, read, show, write, write_machine
from dpl.fem import NeoHookeanLn, SaintVenantKirchhoff, installed_backends
from dpl.fem.linear import BACKENDS
from dpl.system.threads import one_thread

if TYPE_CHECKING:
    from benchmarks.frame_rate import FrameTimes
    from benchmarks.sizes import Size


CONSOLE = Console(width=150)
CASES = (
    *("scenes", "pieces", "propeller", "large", "robustness", "generation"),
    *("discretisation", "sizes", "modes", "laws", "deflections", "latency", "local", "newton"),
    "frames",
)
FIGURES = "figures"  # the case that draws the rows in `folder` again


def run(cfg: DictConfig) -> None:
    """Time the chosen cases, print tables and write the rows to `folder`.

    Raises:
        ConfigError: A part or a backend does not exist, or no backend is installed.
    """
    cases = CASES if cfg.cases is None else cfg.cases
    if unknown := [case for case in cases if case not in (*CASES, FIGURES)]:
        known = ", ".join((*CASES, FIGURES))
        raise config.ConfigError(f"cases = {unknown[0]!r} must be one of {known}")
    if unknown := [name for name in cfg.linear if name not in ("auto", *BACKENDS)]:
        known = ", ".join(("auto", *BACKENDS))
        raise config.ConfigError(f"linear: {unknown[0]!r} is none of {known}")
    backends = [name for name in cfg.linear if name == "auto" or name in installed_backends()]
    if not backends:
        raise config.ConfigError(
            f"linear = {list(cfg.linear)} must name one that is installed: auto"
        )
    CONSOLE.print(f"{machine()}, 1 thread, medians of {cfg.repeats}")
    folder = Path(cfg.folder)
    folder.mkdir(parents=True, exist_ok=True)
    for case in cases:
        with one_thread():
            results = globals()[case](cfg, backends)
        if results is None:  # the part has written its results
            continue
        text = json.dumps({"machine": machine(), case: results}, indent=1, default=asdict)
        (folder / f"{case}.json").write_text(text + "\n")
    print(f"written to {folder}")


def scenes(cfg: DictConfig, backends: list[str]) -> list[dict[str, peers.Time]]:
    """Return the times on the scenes of `benchmarks.peers`, one row per code."""
    rows = [peers.beams(name, cfg.repeats) for name in backends]
    programs = Path(peers.__file__).parent / "programs"
    for name, python in cfg.reference_codes.items():
        if python:
            program = programs / f"{name}_beam.py"
            try:
                rows.append(peers.time_reference_code(python, program, cfg.repeats))
            except OSError as error:
                raise config.ConfigError(f"reference_codes.{name}: {error}") from error
    table = Table(
        "seconds (Newton iterations)", *peers.CASES, "tip against the reference, residual"
    )
    for row in rows:
        cells = [f"{t.seconds:.3f} ({t.iterations})" for t in row.values()]
        table.add_row(row["S1"].case, *cells, row["S1"].note)
    table.add_section()
    for name, seconds in peers.PUBLISHED.items():
        table.add_row(f"published: {name}", *(f"{s:.3f}" for s in seconds), "on a Zen 5 core")
    CONSOLE.print(table)
    return rows


def pieces(cfg: DictConfig, backends: list[str]) -> list[peers.Time]:
    """Return the times of the parts of an iteration on the beam."""
    return _listed(peers.pieces(3 * cfg.repeats), "beam of 12,000 degrees of freedom")


def propeller(cfg: DictConfig, backends: list[str]) -> list[peers.Time]:
    """Return the time of a random load on the propeller."""
    rows = [peers.propellers(name, 4 * cfg.repeats) for name in backends if name != "band"]
    return _listed(rows, "propeller of 12,075 degrees of freedom, one load")


def large(cfg: DictConfig, backends: list[str]) -> list[peers.Time]:
    """Return the time of an iteration on 100,548 degrees of freedom with the first backend."""
    return _listed([peers.large(backends[0])], "beam of 100,548 degrees of freedom")


def robustness(cfg: DictConfig, backends: list[str]) -> dict[str, dict[str, float]]:
    """Return the numbers of random loads solved in one step and with load steps."""
    builders: dict[str, Callable[[], Scene]] = {
        "beam, NH-ln": partial(peers.beam_scene, NeoHookeanLn(0.3)),
        "beam, SVK": partial(peers.beam_scene, SaintVenantKirchhoff(0.3)),
        "propeller, NH-ln": peers.propeller_scene,
        "beam, fibres": peers.fibre_scene,
        "beam, stiff core": peers.inclusion_scene,
    }
    if unknown := sorted(set(cfg.bodies or ()) - set(builders)):
        raise config.ConfigError(f"bodies: {unknown[0]} must be one of {list(builders)}")
    chosen = {name: builders[name] for name in cfg.bodies or builders}
    results = peers.robustness(chosen, cfg.count, cfg.workers)
    table = Table("random loads", *next(iter(results.values())))
    for name, row in results.items():
        table.add_row(name, *(f"{value:.4g}" for value in row.values()))
    CONSOLE.print(table)
    return results


def generation(cfg: DictConfig, backends: list[str]) -> dict[str, list[ways.Cost]]:
    """Return the cost of a sample on one core for each method."""
    scenes = {
        "paper's beam, NH-ln": peers.beam_scene(NeoHookeanLn(0.3)),
        "paper's propeller, NH-ln": peers.propeller_scene(),
    }
    guess = None
    if cfg.run is not None:
        surrogate = config.load_run(cfg.run)[1]
        scenes, guess = {cfg.run: surrogate.scene}, surrogate.predict
    results = {}
    for name, scene in scenes.items():
        rows = results[name] = ways.costs(scene, cfg.samples, surrogate=guess)
        table = Table(name, "ms", "samples/s on a core", "iterations", "factors", "accepted")
        for row in rows:
            count = f"{row.iterations:.2f}", f"{row.factorisations:.2f}"
            done = f"{row.accepted}/{cfg.samples}"
            table.add_row(row.method, f"{1e3 * row.seconds:.1f}", f"{row.rate:.2f}", *count, done)
        CONSOLE.print(table)
    return results


def discretisation(cfg: DictConfig, backends: list[str]) -> None:
    """Write the errors of coarser, finer and quadratic meshes of the beam and of the propeller."""
    from benchmarks import discretisation as meshes

    for name, law in (("beam_svk", SaintVenantKirchhoff(0.3)), ("propeller_nh", NeoHookeanLn(0.3))):
        family = meshes.FAMILIES[name.partition("_")[0]]
        rows = meshes.discretisations(family, law, repeats=cfg.repeats)
        table = Table(
            f"{name}: Newton to 1e-6 on", "DOFs", "ms", "value", "error against the limit"
        )
        for row in rows:
            cells = f"{'x'.join(map(str, row.cells))}, degree {row.degree}"
            numbers = f"{row.ms:.1f}", f"{row.value:.6g}", f"{row.error:.1e}"
            table.add_row(cells, f"{row.dofs:,}", *numbers)
        CONSOLE.print(table)
        write(rows, Path(cfg.folder) / f"discretisation_{name}.csv")


def sizes(cfg: DictConfig, backends: list[str]) -> None:
    """Write the costs of solvers and networks on beams of growing size."""
    from benchmarks import sizes as beams

    rows: list[Size] = []
    table = Table("beam", "DOFs", "ms", "parameters", "memory [MB]", "peak [MB]")
    with Progress() as progress:
        bar = progress.add_task("beams", total=len(cfg.cells_across))
        for part in beams.sizes(cfg.cells_across, loads=cfg.repeats):
            rows += part
            write(rows, Path(cfg.folder) / "sizes.csv")
            progress.advance(bar)
    for row in rows:
        kept = "" if row.memory_mb is None else f"{row.memory_mb:.1f}"
        count = "" if row.parameters is None else f"{row.parameters:,}"
        table.add_row(
            row.case, f"{row.dofs:,}", f"{row.ms:.2f}", count, kept, f"{row.peak_memory_mb:.0f}"
        )
    CONSOLE.print(table)
    beams.draw(rows, Path(cfg.folder) / "sizes.png")
    write_machine(Path(cfg.folder) / "sizes.json")


def modes(cfg: DictConfig, backends: list[str]) -> None:
    """Write the times of K(0)'s factor and of its modes on beams of growing size."""
    from benchmarks import modes as beams

    rows = []
    table = Table("five modes or more of a beam", "DOFs", "factor of K(0) [s]", "modes [s]", "CPU")
    for row in beams.mode_times(repeats=cfg.repeats):
        rows.append(row)
        write(rows, Path(cfg.folder) / "modes.csv")
        name = f"{row.modes} modes, {row.backend}" if row.backend else "paper"
        factor = "" if row.factor_s is None else f"{row.factor_s:.3f}"
        known = (row.factor_cpu_s, row.modes_cpu_s)
        cpu = "" if None in known else " + ".join(f"{part:.3f}" for part in known)
        table.add_row(name, f"{row.dofs:,}", factor, f"{row.modes_s:.3f}", cpu)
    CONSOLE.print(table)
    write_machine(Path(cfg.folder) / "modes.json")


def laws(cfg: DictConfig, backends: list[str]) -> None:
    """Write the times of tangent and residual of bodies of several laws and with fibres."""
    from benchmarks import law_costs

    rows = list(law_costs.law_costs(repeats=8 * cfg.repeats))
    table = Table("tangent and residual, compiled", "DOFs", "ms", "over one isotropic law")
    for row in rows:
        table.add_row(row.body, f"{row.dofs:,}", f"{row.ms:.2f}", f"{row.ratio:.2f}")
    CONSOLE.print(table)
    write(rows, Path(cfg.folder) / "law_costs.csv")
    write_machine(Path(cfg.folder) / "law_costs.json")
    residual, both = (slow / fast for fast, slow in law_costs.energy_alone_costs())
    CONSOLE.print(f"by the energy alone: residual {residual:.0f}, with tangent {both:.0f} times")


def deflections(cfg: DictConfig, backends: list[str]) -> None:
    """Write the deflections of the paper's beam and propeller under test loads, with histograms."""
    from benchmarks import deflections as sizes

    scenes = {
        "beam_svk": peers.beam_scene(SaintVenantKirchhoff(0.3)),
        "propeller_nh": peers.propeller_scene(),
    }
    rows = sizes.deflections(scenes, cfg.count, cfg.workers)
    table = Table("largest nodal displacement / L", "loads", "smallest", "median", "largest")
    for name, values in sizes.by_body(rows).items():
        numbers = min(values), statistics.median(values), max(values)
        table.add_row(name, f"{len(values)}", *(f"{number:.2g}" for number in numbers))
    CONSOLE.print(table)
    write(rows, Path(cfg.folder) / "deflections.csv")
    sizes.draw(rows, Path(cfg.folder) / "deflections.png")


def latency(cfg: DictConfig, backends: list[str]) -> None:
    """Write the wall times of a trained run.

    Raises:
        ConfigError: No run is named.
    """
    from benchmarks import run_latency
    from dpl.inference import Simulator

    if cfg.run is None:
        raise config.ConfigError("run = null must name the trained run for cases=[latency]")
    simulator = Simulator(config.load_run(cfg.run)[1])
    load = simulator.scene.loads.sample((0, 2), range(cfg.samples))
    calls = list(run_latency.call_times(simulator, load, repeats=cfg.repeats))
    table = Table("one load, one thread", "loads", "p50 [ms]", "p99 [ms]")
    for row in calls:
        table.add_row(row.call, f"{row.loads}", f"{row.p50:.2f}", f"{row.p99:.2f}")
    CONSOLE.print(table)
    rates = list(run_latency.throughputs(simulator, repeats=cfg.repeats))
    table = Table("predictions in batches", "threads", "loads per second")
    for rate in rates:
        table.add_row(f"{rate.batch}", f"{rate.threads}", f"{rate.loads_per_second:.0f}")
    CONSOLE.print(table)
    write(calls, Path(cfg.folder) / "latency.csv")
    write(rates, Path(cfg.folder) / "throughput.csv")
    write_machine(Path(cfg.folder) / "latency.json")


def newton(cfg: DictConfig, backends: list[str]) -> None:
    """Write the times of all runs below a folder to tolerances, beside those of Newton's method.

    Raises:
        ConfigError: No folder is named, or it contains no runs.
    """
    from benchmarks import run_latency
    from dpl.inference import Simulator

    folders = sorted(path.parent for path in Path(cfg.run or "").glob("**/config.yaml"))
    if cfg.run is None or not folders:
        raise config.ConfigError(f"run = {cfg.run} must name a folder of runs for cases=[newton]")
    rows = []
    table = Table("one load, one thread", *("tol", "p50 [ms]", "p99 [ms]", "Newton", "p99"))
    table.add_column("ratios")
    table.add_column("methods")
    for folder in folders:
        simulator = Simulator(config.load_run(folder)[1])
        load = simulator.scene.loads.sample((0, 2), range(cfg.samples))
        name = str(folder.relative_to(cfg.run))
        for row in run_latency.against_newton(name, simulator, load, repeats=cfg.repeats):
            rows.append(row)
            times = (row.p50, row.p99, row.newton_p50, row.newton_p99)
            ratios = f"{row.p50 / row.newton_p50:.2f} {row.p99 / row.newton_p99:.2f}"
            texts = (f"{time:.1f}" for time in times)
            table.add_row(row.run, power(row.tol), *texts, ratios, row.methods)
    CONSOLE.print(table)
    write(rows, Path(cfg.folder) / "against_newton.csv")
    write_machine(Path(cfg.folder) / "against_newton.json")


def local(cfg: DictConfig, backends: list[str]) -> None:
    """Write errors and latencies of a trained run of `unrolled` for loads on small areas.

    Raises:
        ConfigError: No run of `unrolled` is named.
    """
    from benchmarks import local_loads
    from dpl.models import Unrolled

    if cfg.run is None:
        raise config.ConfigError("run = null must name the trained run for cases=[local]")
    surrogate = config.load_run(cfg.run)[1]
    if not isinstance(surrogate.net, Unrolled):
        raise config.ConfigError(f"run = {cfg.run} must be a run of model=unrolled")
    rows = list(local_loads.measure(surrogate, cfg.count, repeats=cfg.repeats))
    titles = "error", "of sim(force)", "predict [ms]", "sim [ms]", "ONNX [ms]"
    table = Table("loads, p50 and p99", *titles)
    for row in rows:
        size = "" if row.deflection is None else f", {row.deflection:g} L"
        errors = (
            f"{row.error_p50:.1e} {row.error_p99:.1e}",
            f"{row.sim_error_p50:.1e} {row.sim_error_p99:.1e}",
        )
        times = (
            f"{row.predict_p50:.1f} {row.predict_p99:.1f}",
            f"{row.sim_p50:.1f} {row.sim_p99:.1f}",
            "" if row.onnx_p50 is None else f"{row.onnx_p50:.1f} {row.onnx_p99:.1f}",
        )
        table.add_row(f"{row.loads}{size}", *errors, *times)
    CONSOLE.print(table)
    stem = Path(cfg.folder) / f"local_loads_{Path(cfg.run).name}"
    write(rows, stem.with_suffix(".csv"))
    write_machine(stem.with_suffix(".json"))


def frames(cfg: DictConfig, backends: list[str]) -> "list[FrameTimes]":
    """Return the times of the frames of the page of a trained run; print latencies beside them.

    Raises:
        ConfigError: No run is named, or the extra `viewer` is not installed.
    """
    from dpl import load, viewer
    from dpl.commands.view import require_viewer
    from dpl.evaluation.timing import describe

    if cfg.run is None:
        raise config.ConfigError("run = null must name the trained run for cases=[frames]")
    require_viewer()
    from benchmarks import frame_rate

    body, policy = viewer.Body(load(cfg.run)), viewer.AccessPolicy.bind("127.0.0.1", 0)
    page = viewer.Page(body, policy, title=str(cfg.run), folder=Path(cfg.folder))
    try:
        rows, latencies = frame_rate.measure_frames(page)
    finally:
        page.close()
    show(rows, "times per frame on the server, and frames received by a client")
    CONSOLE.print(describe(latencies))
    return rows


def figures(cfg: DictConfig, backends: list[str]) -> None:
    """Draw the figures of `sizes`, `deflections`, ablation and estimated errors from their rows."""
    from benchmarks import ablation, ablation_figures, error_estimate_figure, error_estimates
    from benchmarks import deflections as bent
    from benchmarks import sizes as beams

    folder = Path(cfg.folder)
    if (path := folder / "sizes.csv").is_file():
        beams.draw(read(beams.Size, path), path.with_suffix(".png"))
    if (path := folder / "deflections.csv").is_file():
        bent.draw(read(bent.Deflection, path), path.with_suffix(".png"))
    if (path := folder / "unrolled.csv").is_file():
        ablation_figures.draw(read(ablation.Row, path), path.with_suffix(".png"))
    for path in folder.glob("error_estimates*_loads.csv"):
        found = read(error_estimates.Estimate, path)
        error_estimate_figure.draw(found, folder / f"{path.stem.removesuffix('_loads')}.png")


def _listed(rows: list[peers.Time], title: str) -> list[peers.Time]:
    table = Table(title, "ms", "iterations", "")
    for row in rows:
        count = f"{row.iterations:.1f}" if row.iterations == row.iterations else ""
        table.add_row(row.case, f"{1e3 * row.seconds:.2f}", count, row.note)
    CONSOLE.print(table)
    return rows
