"""Export a trained surrogate: ONNX, results for ParaView, C++: python scripts/export.py run=...

The exit status is 1 if ONNX and torch differ by more than `tol`.
"""

import json
import sys
import time
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

import dpl
from dpl import config, export, training
from dpl.commands.cli import command
from dpl.evaluation import tables
from dpl.system.files import atomic_write
from dpl.version import install

RESULT_STREAM = (0, 12)  # random stream of the loads in results


@command("export")
def main(cfg: DictConfig) -> None:
    """Write the parts that `outputs` names."""
    if not cfg.outputs:
        known = "model, results, runtime, dataset, publish"
        raise config.ConfigError(f"outputs = [] must contain one of {known}")
    if "results" in cfg.outputs and cfg.count < 1:
        raise config.ConfigError(f"count = {cfg.count} must be 1 or more; or use outputs=[model]")
    config.files_of_run(cfg.run)  # refuses a missing run before torch is imported
    from dpl.export.onnx_graph import missing_packages

    if "model" in cfg.outputs and (absent := missing_packages()):
        raise config.ConfigError(
            f"outputs: model needs {', '.join(absent)}: {install('onnx')}, or use outputs=[results]"
        )
    run, surrogate = config.load_run(cfg.run, trust=cfg.trust)
    folder = Path(cfg.run) / "export" if cfg.folder is None else Path(cfg.folder)
    if "model" in cfg.outputs:
        export_model(cfg, surrogate, folder)
    if "results" in cfg.outputs:
        export_results(cfg, surrogate, folder / "results")
    if "runtime" in cfg.outputs:
        with config.error_in("outputs: runtime"):
            path = export.write_runtime(folder, surrogate)
        print(f"for C++: {path}, {path.stat().st_size / 1e6:.3g} MB, with dpl_runtime.hpp")
    if "dataset" in cfg.outputs:
        data = config.load_data(run, surrogate.scene)
        splits = {split: data.samples(split) for split, size in data.sizes.items() if size}
        path = export.write_pairs(surrogate.scene, splits, folder / "dataset")
        print(f"for other programs: {path}, {path.stat().st_size / 1e6:.3g} MB")
    if "publish" in cfg.outputs:
        with config.error_in("outputs: publish"):
            path = publish(cfg, run, surrogate.scene, folder / "published")
        print(f"to share: {path.parent}; dpl.load reads this folder, also as hf://OWNER/NAME")


def publish(cfg: DictConfig, run: DictConfig, scene: "dpl.Scene", folder: Path) -> Path:
    """Write what `dpl.load` needs of a run to a folder; return the card."""
    kept = {key: node for key, node in config.to_container(run).items() if key in config.PREDICTION}
    _, files = config.with_copied_files(run, Path(cfg.run), required=True)
    copies = [own for _, own in files.values()]
    return export.write_published(
        scene, folder, config=kept, files=copies, run=Path(cfg.run), license=cfg.license
    )


def export_model(cfg: DictConfig, surrogate: "training.TrainedSurrogate", folder: Path) -> None:
    """Write the graph and its folder, compare the graph with torch, and measure latencies."""
    from dpl.export.metadata import describe, solve_reference

    path = folder / "model.onnx"
    start = time.perf_counter()
    with config.error_in("run"):
        graph = export.ExportGraph(surrogate)
        export.export_onnx(graph, path)
    seconds = time.perf_counter() - start
    reference, entry = solve_reference(graph)
    meta = describe(graph, path, entry, tol=cfg.tol, errors=_test_errors(Path(cfg.run)))
    export.write_folder(folder, surrogate, reference, meta)
    report = _report(cfg, graph, export.OnnxSession(path), path) | {
        "export_seconds": round(seconds, 2)
    }
    with atomic_write(folder / "report.json") as file:
        file.write((json.dumps(report, indent=1) + "\n").encode())
    largest = report["largest_error"]
    if not report["passed"]:
        for part in folder.glob("model.onnx*"):
            part.unlink()
        print(
            f"error: ONNX and torch differ by {largest:.2g}, more than tol = {cfg.tol:g}; {path} "
            "was removed",
            file=sys.stderr,
        )
        sys.exit(1)
    megabytes = report["bytes"] / 1e6
    print(f"largest difference {largest:.1e}; {path}, {megabytes:.3g} MB, {seconds:.1f} s to write")


def _report(
    cfg: DictConfig, graph: "export.ExportGraph", session: "export.OnnxSession", path: Path
) -> dict[str, Any]:
    """Measure and print differences and latencies; return them with versions and file size."""
    from dpl.evaluation import timing
    from dpl.export import comparison
    from dpl.export.onnx_graph import PACKAGES

    surrogate = graph.surrogate
    loads = comparison.sample_check_loads(surrogate.scene, cfg.samples)
    differences = comparison.compare_outputs(graph, session, loads)
    stored = export.read_reference(path.parent)
    found = session(**{name: stored[name] for name in graph.inputs})
    distance = comparison.relative_differences(found, stored["displacement"])
    reference_error = float(distance.max())
    largest = max(reference_error, *(row.max_error for row in differences))
    times = comparison.measure_latency(graph, session, loads, calls=cfg.repeats)
    sample = surrogate.scene.loads.sample(comparison.CHECK_STREAM, range(cfg.samples))
    latencies = timing.latencies(dpl.Simulator(surrogate), sample)
    tables.show(differences, "ONNX against torch")
    tables.show(times, "network, loads in the training range [ms], 1 thread")
    print(timing.describe(latencies))
    return {
        "network": type(surrogate.net).__name__,
        "passed": largest <= cfg.tol,
        "tolerance": cfg.tol,
        "largest_error": largest,
        "reference_error": reference_error,
        "loads": [asdict(row) for row in differences],
        "milliseconds": [asdict(row) for row in times],
        "latency": {name: asdict(one) for name, one in latencies.items()},
        "threads": 1,
        "repeats": cfg.repeats,
        "bytes": sum(file.stat().st_size for file in path.parent.glob("model.onnx*")),
        "opset": export.onnx_opset(path),
        "machine": tables.machine(),
        "versions": {name: version(name) for name in ("torch", *PACKAGES)},
    }


def _test_errors(folder: Path) -> dict[str, float] | None:
    """Return the errors of the network on the test set; None if the run was not evaluated."""
    from dpl.evaluation import PREDICTION

    path = folder / "evaluation.json"
    if not path.is_file():
        return None
    try:
        rows = {row["solver"]: row["errors"] for row in json.loads(path.read_text())}
        return {str(key): float(value) for key, value in rows[PREDICTION].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise config.ConfigError(
            f"run: {path} is not an evaluation; repeat it with python scripts/evaluate.py "
            f"run={folder}, or remove the file"
        ) from error


def export_results(cfg: DictConfig, surrogate: "training.TrainedSurrogate", folder: Path) -> None:
    """Write predictions for random loads as files for ParaView."""
    for old in folder.glob("results_[0-9]*.vtu"):  # an earlier series may have been longer
        old.unlink()
    load = surrogate.scene.loads.sample(RESULT_STREAM, range(cfg.count))
    path = folder / "results"
    rows, files = export.write_results(surrogate, load, path, solve_reference=cfg.solve_reference)
    tables.write(rows, folder / "results.csv")
    tables.show(rows, "predictions of the network")
    print(f"for ParaView: {' or '.join(map(str, files))}")
