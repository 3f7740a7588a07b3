"""Export a trained surrogate: ONNX, results for ParaView, C++: python scripts/export.py run=...

The exit status is 1 if ONNX and torch differ by more than `tol`.
"""

import json
import sys
import time
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

from omegaconf import DictConfig

from dpl import config, export, training
from dpl.commands.cli import command
from dpl.evaluation import tables
from dpl.system.files import atomic_write
from dpl.version import install

RESULT_STREAM = (0, 12)  # random stream of the loads in results


@command("export")
def main(cfg: DictConfig) -> None:
    """Write the parts that `outputs` names."""
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
            every = config.to_container(run)
            kept = {key: every[key] for key in config.PREDICTION if key in every}
            _, files = config.with_copied_files(run, Path(cfg.run), required=True)
            path = export.write_published(
                surrogate.scene, folder / "published", config=kept, run=Path(cfg.run),
                files=[own for _, own in files.values()], license=cfg.license,
            )  # fmt: skip
        print(f"to share: {path.parent}; dpl.load reads this folder, also as hf://OWNER/NAME")


def export_model(cfg: DictConfig, surrogate: "training.TrainedSurrogate", folder: Path) -> None:
    """Write the graph and its folder, and compare the graph with torch."""
    from dpl.export import comparison
    from dpl.export.folder import MODEL
    from dpl.export.onnx_graph import PACKAGES

    errors = _test_errors(Path(cfg.run))
    path, start = folder / MODEL, time.perf_counter()
    with config.error_in("run"):
        export.export_onnx(surrogate, path, numbers=cfg.numbers, dtype=cfg.dtype)
    seconds = time.perf_counter() - start
    export.write_folder(surrogate, folder, tol=cfg.tol, errors=errors)
    session = export.OnnxSession(path)
    loads = comparison.sample_check_loads(surrogate.scene, cfg.samples)
    rows = comparison.compare_outputs(surrogate, session, *loads)
    tables.show(rows, "ONNX against torch")
    times = comparison.latencies(surrogate, session, cfg.samples)
    largest = max(row.max_error for row in rows)
    size = sum(file.stat().st_size for file in folder.glob(f"{MODEL}*"))
    report = {
        "network": type(surrogate.net).__name__,
        "passed": largest <= cfg.tol,
        "tolerance": cfg.tol,
        "largest_error": largest,
        "loads": [asdict(row) for row in rows],
        "bytes": size,
        "export_seconds": round(seconds, 2),
        "milliseconds": {name: asdict(own) for name, own in times.items()},
        "machine": tables.machine(),
        "versions": {name: version(name) for name in ("torch", *PACKAGES)},
    }
    with atomic_write(folder / "report.json") as file:
        file.write((json.dumps(report, indent=1) + "\n").encode())
    if largest > cfg.tol:
        for part in folder.glob(f"{MODEL}*"):
            part.unlink()
        print(
            f"error: ONNX and torch differ by {largest:.2g}, more than tol = {cfg.tol:g}; {path} "
            "was removed",
            file=sys.stderr,
        )
        sys.exit(1)
    print(f"largest difference {largest:.1e}; {path}, {size / 1e6:.3g} MB, {seconds:.1f} s")
    print("; ".join(f"{name}: {own}" for name, own in times.items()))


def _test_errors(folder: Path) -> dict[str, float] | None:
    """Return the errors of the network on the test set; None if the run was not evaluated."""
    from dpl.evaluation import PREDICTION

    path = folder / "evaluation.json"
    if not path.is_file():
        return None
    repeat = f"repeat it with python scripts/evaluate.py run={folder}, or remove the file"
    damaged = ValueError, KeyError, TypeError, AttributeError
    with config.error_in(f"run: {path} is not an evaluation; {repeat}", *damaged):
        rows = {row["solver"]: row["errors"] for row in json.loads(path.read_text())}
        return {str(key): float(value) for key, value in rows[PREDICTION].items()}


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
