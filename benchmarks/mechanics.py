"""Cases of the comparison of the mechanics with public codes, see `benchmarks.commands.benchmark`.

Each case is a function of the configuration that records the rows of one study or several.
"""

import statistics
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

from omegaconf import DictConfig

from benchmarks import generation as ways
from benchmarks import peers
from benchmarks.study import record, redraw
from dpl import Scene, config
from dpl.evaluation.tables import machine
from dpl.fem import NeoHookeanLn, SaintVenantKirchhoff, installed_backends
from dpl.fem.linear import BACKENDS
from dpl.inference import Simulator
from dpl.system.threads import one_thread

CASES = (
    *("scenes", "pieces", "propeller", "large", "robustness", "generation"),
    *("discretisation", "sizes", "modes", "laws", "deflections", "latency", "local", "newton"),
    "frames",
)
FIGURES = "figures"  # the case that draws the rows in `folder` again


def run(cfg: DictConfig) -> None:
    """Measure the chosen cases; print tables and write rows to `folder`.

    Raises:
        ConfigError: A case or a backend does not exist, or no backend is installed.
    """
    cases = CASES if cfg.cases is None else cfg.cases
    if unknown := [case for case in cases if case not in (*CASES, FIGURES)]:
        known = ", ".join((*CASES, FIGURES))
        raise config.ConfigError(f"cases = {unknown[0]!r} must be one of {known}")
    if unknown := [name for name in cfg.linear if name not in ("auto", *BACKENDS)]:
        known = ", ".join(("auto", *BACKENDS))
        raise config.ConfigError(f"linear: {unknown[0]!r} is none of {known}")
    if not installed(cfg):
        raise config.ConfigError(
            f"linear = {list(cfg.linear)} must name one that is installed: auto"
        )
    print(f"{machine()}, 1 thread, medians of {cfg.repeats}")
    for case in cases:
        with one_thread():
            globals()[case](cfg)


def installed(cfg: DictConfig) -> list[str]:
    """Return the linear backends of the configuration that are installed."""
    return [name for name in cfg.linear if name == "auto" or name in installed_backends()]


def scenes(cfg: DictConfig) -> None:
    """Record the times on the scenes of `benchmarks.peers`, by dpl and by public codes."""
    record(_scene_times(cfg), Path(cfg.folder) / "scenes", "clamped beam, by code and scene")


def _scene_times(cfg: DictConfig) -> Iterator[peers.Time]:
    measured = [partial(peers.beams, name, cfg.repeats) for name in installed(cfg)]
    programs = Path(peers.__file__).parent / "programs"
    for name, python in cfg.reference_codes.items():
        if python:
            program = programs / f"{name}_beam.py"
            measured.append(partial(peers.time_reference_code, python, program, cfg.repeats))
    for measure in measured:
        with config.error_in("reference_codes", OSError):
            rows = measure()
        for scene, row in rows.items():
            yield replace(row, case=f"{row.case}, {scene}")
    for name, seconds in peers.PUBLISHED.items():
        for scene, taken in zip(peers.CASES, seconds, strict=True):
            yield peers.Time(f"published: {name}, {scene}", taken, note="on a Zen 5 core")


def pieces(cfg: DictConfig) -> None:
    """Record the times of the parts of an iteration on the beam."""
    rows = peers.pieces(3 * cfg.repeats)
    record(rows, Path(cfg.folder) / "pieces", "beam of 12,000 degrees of freedom")


def propeller(cfg: DictConfig) -> None:
    """Record the time of a random load on the propeller."""
    names = [name for name in installed(cfg) if name != "band"]
    rows = (peers.propellers(name, 4 * cfg.repeats) for name in names)
    record(rows, Path(cfg.folder) / "propeller", "propeller of 12,075 degrees of freedom, one load")


def large(cfg: DictConfig) -> None:
    """Record the time of an iteration on 100,548 degrees of freedom with the first backend."""
    rows = [peers.large(installed(cfg)[0])]
    record(rows, Path(cfg.folder) / "large", "beam of 100,548 degrees of freedom")


def robustness(cfg: DictConfig) -> None:
    """Record the numbers of random loads solved in one step and with load steps."""
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
    rows = peers.robustness(chosen, cfg.count, cfg.workers)
    record(rows, Path(cfg.folder) / "robustness", "random loads")


def generation(cfg: DictConfig) -> None:
    """Record the cost of a sample on one core for each method."""
    scenes = {
        "paper's beam, NH-ln": peers.beam_scene(NeoHookeanLn(0.3)),
        "paper's propeller, NH-ln": peers.propeller_scene(),
    }
    guess = None
    if cfg.run is not None:
        surrogate = config.load_run(cfg.run)[1]
        scenes, guess = {cfg.run: surrogate.scene}, surrogate.predict
    rows = (
        replace(row, method=f"{name}: {row.method}")
        for name, scene in scenes.items()
        for row in ways.costs(scene, cfg.samples, surrogate=guess)
    )
    record(rows, Path(cfg.folder) / "generation", f"a sample on one core, {cfg.samples} loads")


def discretisation(cfg: DictConfig) -> None:
    """Record the errors of coarser, finer and quadratic meshes of the beam and of the propeller."""
    from benchmarks import discretisation as meshes

    for name, law in (("beam_svk", SaintVenantKirchhoff(0.3)), ("propeller_nh", NeoHookeanLn(0.3))):
        family = meshes.FAMILIES[name.partition("_")[0]]
        rows = meshes.discretisations(family, law, repeats=cfg.repeats)
        record(rows, Path(cfg.folder) / f"discretisation_{name}", f"{name}: Newton to 1e-6")


def sizes(cfg: DictConfig) -> None:
    """Record the costs of solvers and networks on beams of growing size."""
    from benchmarks import sizes as beams

    parts = beams.sizes(cfg.cells_across, loads=cfg.repeats)
    rows = (row for part in parts for row in part)
    record(rows, Path(cfg.folder) / "sizes", "beams of growing size", beams.draw)


def modes(cfg: DictConfig) -> None:
    """Record the times of K(0)'s factor and of its modes on beams of growing size."""
    from benchmarks import modes as beams

    rows = beams.mode_times(repeats=cfg.repeats)
    record(rows, Path(cfg.folder) / "modes", "five modes or more of a beam; first row: the paper")


def laws(cfg: DictConfig) -> None:
    """Record the times of tangent and residual of bodies of several laws and with fibres."""
    from benchmarks import law_costs

    rows = law_costs.law_costs(repeats=8 * cfg.repeats)
    record(rows, Path(cfg.folder) / "law_costs", "tangent and residual, compiled")
    residual, both = (slow / fast for fast, slow in law_costs.energy_alone_costs())
    print(f"by the energy alone: residual {residual:.0f}, with tangent {both:.0f} times")


def deflections(cfg: DictConfig) -> None:
    """Record the deflections of the paper's beam and propeller under test loads."""
    from benchmarks import deflections as sizes

    scenes = {
        "beam_svk": peers.beam_scene(SaintVenantKirchhoff(0.3)),
        "propeller_nh": peers.propeller_scene(),
    }
    rows = sizes.deflections(scenes, cfg.count, cfg.workers)
    rows = record(rows, Path(cfg.folder) / "deflections", None, sizes.draw)
    for name, values in sizes.by_body(rows).items():
        least, middle, most = min(values), statistics.median(values), max(values)
        print(
            f"{name}: largest nodal displacements of {len(values)} loads {least:.2g} to "
            f"{most:.2g} L, median {middle:.2g} L"
        )


def latency(cfg: DictConfig) -> None:
    """Record the wall times of a trained run."""
    from benchmarks import run_latency

    simulator, folder = Simulator(config.load_run(_run(cfg, "latency"))[1]), Path(cfg.folder)
    load = simulator.scene.loads.sample((0, 2), range(cfg.samples))
    calls = run_latency.call_times(simulator, load, repeats=cfg.repeats)
    record(calls, folder / "latency", "one load, one thread [ms]")
    rates = run_latency.throughputs(simulator, repeats=cfg.repeats)
    record(rates, folder / "throughput", "predictions in batches")


def newton(cfg: DictConfig) -> None:
    """Record the times of all runs below a folder to tolerances, beside those of Newton's method.

    Raises:
        ConfigError: No folder is named, or it contains no runs.
    """
    from benchmarks import run_latency

    folders = sorted(path.parent for path in Path(cfg.run or "").glob("**/config.yaml"))
    if cfg.run is None or not folders:
        raise config.ConfigError(f"run = {cfg.run} must name a folder of runs for cases=[newton]")

    def rows() -> Iterator[run_latency.AgainstNewton]:
        for folder in folders:
            simulator = Simulator(config.load_run(folder)[1])
            load = simulator.scene.loads.sample((0, 2), range(cfg.samples))
            name = str(folder.relative_to(cfg.run))
            yield from run_latency.against_newton(name, simulator, load, repeats=cfg.repeats)

    record(rows(), Path(cfg.folder) / "against_newton", "one load, one thread [ms]")


def local(cfg: DictConfig) -> None:
    """Record errors and latencies of a trained run of `unrolled` for loads on small areas.

    Raises:
        ConfigError: The run is none of `unrolled`.
    """
    from benchmarks import local_loads
    from dpl.models import Unrolled

    surrogate = config.load_run(_run(cfg, "local"))[1]
    if not isinstance(surrogate.net, Unrolled):
        raise config.ConfigError(f"run = {cfg.run} must be a run of model=unrolled")
    rows = local_loads.measure(surrogate, cfg.count, repeats=cfg.repeats)
    stem = Path(cfg.folder) / f"local_loads_{Path(cfg.run).name}"
    record(rows, stem, "loads on small areas, one thread [ms]")


def frames(cfg: DictConfig) -> None:
    """Record the times of the frames of the page of a trained run; print latencies beside them.

    Raises:
        ConfigError: The extra `viewer` is not installed.
    """
    from dpl import load, viewer
    from dpl.commands.cli import require_viewer
    from dpl.evaluation.timing import describe

    run = _run(cfg, "frames")
    require_viewer()
    from benchmarks import frame_rate

    body, policy = viewer.Body(load(run)), viewer.AccessPolicy.bind("127.0.0.1", 0)
    page = viewer.Page(body, policy, title=run, folder=Path(cfg.folder))
    try:
        rows, latencies = frame_rate.measure_frames(page)
    finally:
        page.close()
    title = "times per frame on the server, and frames received by a client"
    record(rows, Path(cfg.folder) / "frames", title)
    print(describe(latencies))


def figures(cfg: DictConfig) -> None:
    """Draw the figures of `sizes`, `deflections`, ablation and estimated errors from their rows."""
    from benchmarks import ablation, ablation_figures, error_estimate_figure, error_estimates
    from benchmarks import deflections as bent
    from benchmarks import sizes as beams

    folder = Path(cfg.folder)
    redraw(beams.Size, folder / "sizes.csv", beams.draw)
    redraw(bent.Deflection, folder / "deflections.csv", bent.draw)
    redraw(ablation.Row, folder / "unrolled.csv", ablation_figures.draw)
    for path in folder.glob("error_estimates*_loads.csv"):
        stem = path.stem.removesuffix("_loads")
        redraw(error_estimates.Estimate, path, error_estimate_figure.draw, stem=stem)


def _run(cfg: DictConfig, case: str) -> str:
    """Return the folder of the run that a case needs.

    Raises:
        ConfigError: No run is named.
    """
    if cfg.run is None:
        raise config.ConfigError(f"run = null must name the trained run for cases=[{case}]")
    return str(cfg.run)
