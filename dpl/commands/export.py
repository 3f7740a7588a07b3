"""A trained surrogate for others, and its results for ParaView: python scripts/export.py run=...

Ends with 1 where the graph is farther from torch than `tol`.
"""

import json
import sys
import time
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from dpl import config
from dpl.commands.cli import command
from dpl.evaluation import tables as table
from dpl.system.files import atomic_write
from dpl.version import install

if TYPE_CHECKING:
    from dpl.training import Surrogate

PARTS = ("model", "results")
SHOWN = (0, 12)  # the stream of the loads in results


@command("export")
def main(cfg: DictConfig) -> None:
    """Write the parts that are asked for."""
    from dpl.export.onnx_graph import missing

    config.check(cfg)
    if unknown := [part for part in cfg.parts if part not in PARTS]:
        raise config.ConfigError(f"parts: {unknown[0]!r} is none of {', '.join(PARTS)}")
    if not cfg.parts:
        raise config.ConfigError(f"parts: choose of {', '.join(PARTS)}")
    if "model" in cfg.parts and (absent := missing()):
        told = f"parts: model needs {', '.join(absent)}: {install('onnx')}, or take parts=[results]"
        raise config.ConfigError(told)
    _, surrogate = config.load_run(cfg.run)
    folder = Path(cfg.run) / "export" if cfg.folder is None else Path(cfg.folder)
    if "model" in cfg.parts:
        model(cfg, surrogate, folder)
    if "results" in cfg.parts:
        results(cfg, surrogate, folder / "results")


def model(cfg: DictConfig, surrogate: "Surrogate", folder: Path) -> None:
    """Write the graph and what goes with it; compare it with torch, and time both."""
    from dpl.evaluation import timing
    from dpl.export import check, export, opset, read_reference, verify, write
    from dpl.export.folder import described, reference
    from dpl.export.onnx_graph import NEEDED, Graph, Session
    from dpl.inference import Simulator

    graph, path = Graph(surrogate), folder / "model.onnx"
    start = time.perf_counter()
    try:
        export(graph, path)
    except ValueError as error:
        raise config.ConfigError(f"run: {error}") from error
    seconds = time.perf_counter() - start
    session = Session(path)
    tried = check.trial(surrogate.scene, cfg.samples)
    compared = check.compare(graph, session, tried)
    told = reference(graph)
    meta = described(graph, path, told, tol=cfg.tol, errors=_errors(Path(cfg.run)))
    write(folder, surrogate, told, meta)
    verify(folder, surrogate, told, meta)
    kept = read_reference(folder)
    again = session(*(kept[name] for name in graph.inputs))
    repeated = float(check.distance(again.displacement, kept["displacement"]).max())
    worst = max(repeated, *(row.error for row in compared))
    times = check.clock(graph, session, tried, calls=cfg.repeats)
    sample = surrogate.scene.loads.sample(check.TRIED, range(cfg.samples))
    measured = timing.latencies(Simulator(surrogate), sample)
    report: dict[str, Any] = {
        "network": type(surrogate.net).__name__,
        "passed": worst <= cfg.tol,
        "tolerance": cfg.tol,
        "largest_error": worst,
        "reference_error": repeated,
        "loads": [{key: _known(value) for key, value in asdict(row).items()} for row in compared],
        "milliseconds": [asdict(row) for row in times],
        "latency": {name: asdict(one) for name, one in measured.items()},
        "threads": 1,
        "repeats": cfg.repeats,
        "export_seconds": round(seconds, 2),
        "bytes": sum(file.stat().st_size for file in folder.glob("model.onnx*")),
        "opset": opset(path),
        "machine": table.machine(),
        "versions": {name: version(name) for name in ("torch", *NEEDED)},
    }
    with atomic_write(folder / "report.json") as file:
        file.write((json.dumps(report, indent=1) + "\n").encode())
    table.show(compared, "ONNX against torch")
    table.show(times, "bare network, loads of the range that are not local [ms], 1 thread")
    print(timing.describe(measured))
    if not report["passed"]:
        for part in folder.glob("model.onnx*"):
            part.unlink()
        told_of = f"{worst:.2g} of an answer, more than tol = {cfg.tol:g}; {path} is removed"
        print(f"error: ONNX and torch differ by {told_of}", file=sys.stderr)
        sys.exit(1)
    if graph.flags:
        print(
            "output 'local': loads whose linear answer the basis of the network misses by more "
            f"than {surrogate.net.linear_tol:.2g}; dpl answers these with a factor of K(0), "
            "which is not in the graph, and the graph's answer is off by as much as 'local error'"
        )
    size = report["bytes"] / 1e6
    print(f"largest difference {worst:.1e}; {path}, {size:.3g} MB, {seconds:.1f} s to write")


def _errors(folder: Path) -> dict[str, float] | None:
    """Return the errors of the network on the test set; None if it was not evaluated."""
    path = folder / "evaluation.json"
    if not path.is_file():
        return None
    try:
        rows = {row["solver"]: row["errors"] for row in json.loads(path.read_text())}
        return {str(key): float(value) for key, value in rows["network"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise config.ConfigError(
            f"run: {path} is no evaluation; make it anew with python scripts/evaluate.py "
            f"run={folder}, or remove it"
        ) from error


def _known(value: Any) -> Any:
    """Return a number for JSON, which has no NaN."""
    return value if value == value else None


def results(cfg: DictConfig, surrogate: "Surrogate", folder: Path) -> None:
    """Write answers to random loads for ParaView."""
    from dpl.export import results as written

    if cfg.count < 1:
        raise config.ConfigError(f"count = {cfg.count} must be 1 or more; or take parts=[model]")
    for old in folder.glob("results_[0-9]*.vtu"):  # there may have been more
        old.unlink()
    load = surrogate.scene.loads.sample(SHOWN, range(cfg.count))
    rows, files = written(surrogate, load, folder / "results", exact=cfg.exact)
    table.write(rows, folder / "results.csv")
    table.show(rows, "answers of the network")
    print(f"for ParaView: {' or '.join(map(str, files))}")
