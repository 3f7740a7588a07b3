"""The mechanics against public codes: python scripts/benchmark.py.

Long parts on demand: parts=[large] (run alone, it reports its memory), parts=[robustness],
parts=[generation].
"""

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path

import hydra
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from dpl import peers, run, throughput
from dpl.fem.linear import installed
from dpl.fem.materials import NeoHookeanLn, SaintVenantKirchhoff
from dpl.fem.solution import one_thread

CONSOLE = Console(width=150)
PARTS = ("scenes", "pieces", "propeller", "large", "robustness", "generation")


@hydra.main(version_base="1.3", config_path="../conf", config_name="benchmark")
@run.command
def main(cfg: DictConfig) -> None:
    """Time the parts that are asked for, print tables and write them down."""
    run.check(cfg)
    if unknown := [part for part in cfg.parts if part not in PARTS]:
        raise run.ConfigError(f"parts: {unknown[0]!r} is none of {', '.join(PARTS)}")
    backends = [name for name in cfg.linear if name == "auto" or name in installed()]
    CONSOLE.print(f"{peers.machine()}, 1 thread, medians of {cfg.repeats}")
    folder = Path(cfg.folder)
    folder.mkdir(parents=True, exist_ok=True)
    for part in cfg.parts:
        with one_thread():
            results = globals()[part](cfg, backends)
        text = json.dumps({"machine": peers.machine(), part: results}, indent=1, default=asdict)
        (folder / f"{part}.json").write_text(text + "\n")
    print(f"written to {folder}")


def scenes(cfg: DictConfig, backends: list[str]) -> list[dict[str, peers.Time]]:
    """Return the field's scenes, a row for each code measured here."""
    rows = [peers.beams(name, cfg.repeats) for name in backends]
    programs = Path(__file__).parent / "peers"
    for name, python in cfg.peers.items():
        if python:
            program = programs / f"{name}_beam.py"
            try:
                rows.append(peers.measured_peer(python, program, cfg.repeats))
            except OSError as error:
                raise run.ConfigError(f"peers.{name}: {error}") from error
    table = Table("seconds (Newton iterations)", *peers.CASES, "residual, tip against the field")
    for row in rows:
        cells = [f"{t.seconds:.3f} ({t.iterations})" for t in row.values()]
        table.add_row(row["S1"].what, *cells, row["S1"].note)
    table.add_section()
    for name, seconds in peers.PUBLISHED.items():
        table.add_row(f"published: {name}", *(f"{s:.3f}" for s in seconds), "on a Zen 5 core")
    CONSOLE.print(table)
    return rows


def pieces(cfg: DictConfig, backends: list[str]) -> list[peers.Time]:
    """Return what an iteration on the beam is made of."""
    return _listed(peers.pieces(3 * cfg.repeats), "beam of 12,000 degrees of freedom")


def propeller(cfg: DictConfig, backends: list[str]) -> list[peers.Time]:
    """Return the time of a random load on the propeller."""
    rows = [peers.propellers(name, 4 * cfg.repeats) for name in backends if name != "band"]
    return _listed(rows, "propeller of 12,075 degrees of freedom, one load")


def large(cfg: DictConfig, backends: list[str]) -> list[peers.Time]:
    """Return the time of an iteration on 100,548 degrees of freedom with the first backend."""
    return _listed([peers.large(backends[0])], "beam of 100,548 degrees of freedom")


def robustness(cfg: DictConfig, backends: list[str]) -> dict[str, dict[str, float]]:
    """Return how many random loads are solved in one step and how many at all."""
    builders = {
        "beam, NH-ln": partial(peers.beam_scene, NeoHookeanLn(0.3)),
        "beam, SVK": partial(peers.beam_scene, SaintVenantKirchhoff(0.3)),
        "propeller, NH-ln": peers.propeller_scene,
    }
    results = peers.robustness(builders, cfg.count, cfg.workers)
    table = Table("random loads", *next(iter(results.values())))
    for name, row in results.items():
        table.add_row(name, *(f"{value:.4g}" for value in row.values()))
    CONSOLE.print(table)
    return results


def generation(cfg: DictConfig, backends: list[str]) -> dict[str, list[throughput.Cost]]:
    """Return what a sample costs on one core, with and without what makes it faster."""
    scenes = {
        "paper's beam, NH-ln": peers.beam_scene(NeoHookeanLn(0.3)),
        "paper's propeller, NH-ln": peers.propeller_scene(),
    }
    guess = None
    if cfg.run is not None:
        surrogate = run.load_run(cfg.run)[1]
        scenes, guess = {cfg.run: surrogate.scene}, surrogate.predict
    results = {}
    for name, scene in scenes.items():
        rows = results[name] = throughput.costs(scene, cfg.samples, surrogate=guess)
        table = Table(name, "ms", "samples/s on a core", "iterations", "factors", "accepted")
        for row in rows:
            count = f"{row.iterations:.2f}", f"{row.factorisations:.2f}"
            done = f"{row.accepted}/{cfg.samples}"
            table.add_row(row.way, f"{1e3 * row.seconds:.1f}", f"{row.rate:.2f}", *count, done)
        CONSOLE.print(table)
    return results


def _listed(rows: list[peers.Time], title: str) -> list[peers.Time]:
    table = Table(title, "ms", "iterations", "")
    for row in rows:
        count = f"{row.iterations:.1f}" if row.iterations == row.iterations else ""
        table.add_row(row.what, f"{1e3 * row.seconds:.2f}", count, row.note)
    CONSOLE.print(table)
    return rows


if __name__ == "__main__":
    main()
