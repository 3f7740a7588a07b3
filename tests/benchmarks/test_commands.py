"""Every benchmark command on tiny runs: the files that it writes, and the input that it refuses."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from benchmarks.ablation import PARTS

RUNS, UNROLLED, OUT = "run=runs/tiny", "run=runs/tiny/unrolled", "folder=out"
MODES = ["galerkin.rank=5", "corrected.rank=8"]
SMALL = ["data.train=12", "data.val=4", "data.test=4", "data.workers=0", "mesh.nodes=[5,3,3]"]
ABLATION = [
    *(*SMALL, "loads.n_modes=3", "solver.linear=superlu", "model.rank=12", "model.cells=4"),
    *("model.stages=1", "counts=[8,12]", "ablation_loads=12", "count=2"),
    *("options.stages=[0]", "options.cells=[2]", "options.rank=[6]"),
]
FEW = ["tols=[1e-3]", "count=2", "solvers=[plain Newton]"]
BOTH = ["fcnn", "unrolled"]
BODY = ["bodies=[beam]", "train=8", "val=2", "test=2", "softened=1", "epochs=1"]
DEVICE = [
    *("mesh.nodes=[5,3,3]", "loads.n_modes=3", "solver.linear=superlu", "repeats=2"),
    *("samples=8", "predictions=[1]", "batches=[4]", "device=cpu"),
]

# command, arguments, and the values of a column of each table that it writes
COMMANDS = {
    "results": (
        ["name=tiny", "count=3", *MODES],
        {"tiny.csv": ("method", ["linear", "POD-Galerkin", *BOTH, "unrolled corrected"])},
    ),
    "results of one load": (["name=tiny", "single=true"], {"tiny_single.csv": ("method", BOTH)}),
    "rivals": (
        [*SMALL, "counts=[8]", "models=[]", "rivals=[]", "count=2", "solver.linear=superlu"],
        {"rivals.csv": ("method", ["linear solution"])},
    ),
    "pareto": (
        [RUNS, *MODES],
        {
            "pareto_tiny.csv": (
                "solver",
                [
                    *("linear", "Newton to 0.001", "Newton to 1e-06", "Newton to 1e-08"),
                    *("POD-Galerkin", *BOTH, "unrolled, corrected"),
                    *("fcnn, hybrid", "unrolled, hybrid"),
                ],
            )
        },
    ),
    "convergence": (
        [RUNS, *FEW, "max_plain_iterations=6"],
        {
            "hybrid_newton.csv": (
                "solver",
                [
                    *("paper: Newton", "paper: hybrid Newton", "plain Newton", "robust Newton"),
                    "plain Newton, at most 6 iterations",
                ],
            )
        },
    ),
    "grasps": (
        [UNROLLED, "count=2", "amplitudes=1", "hands=1", "frames=10"],
        {"grasps.csv": ("method", ["prediction", "corrected", "hybrid to 1e-6"])},
    ),
    "transfer": (["run=runs"], {"transfer.csv": ("trained_on", ["other", "tiny"])}),
    "error_estimates of runs": ([RUNS, "test=3"], {"error_estimates.csv": ("prediction", BOTH)}),
    "error_estimates": (
        BODY,
        {
            "error_estimates.csv": (
                "loads",
                ["compressed", "in range", "pinched", "twice the range", "twisted"],
            ),
            "error_estimates_loads.csv": ("prediction", ["fcnn", "pod", "unrolled", "pod + modes"]),
        },
    ),
    "ablation": (ABLATION, {"unrolled.csv": ("part", list(PARTS))}),
    "devices": ([*DEVICE, "networks=[fcnn]"], {"devices_cpu.csv": ("network", ["fcnn"])}),
    "benchmark of latency": (
        ["cases=[latency]", UNROLLED, "samples=2", "repeats=1"],
        {
            "latency.csv": (
                "call",
                [
                    *("prediction", "residual and min det F", "sim(force)"),
                    *(f"sim(force, {limit})" for limit in ("error=1e-3", "tol=1e-3", "tol=1e-6")),
                    *(f"sim(force, tol=1e-8, budget_ms={ms})" for ms in (10, 20, 50, 100)),
                    *("grasp, first frame", "grasp, next frame"),
                ],
            )
        },
    ),
    "benchmark of local loads": (
        ["cases=[local]", UNROLLED, "count=2"],
        {"local_loads_unrolled.csv": ("loads", ["loads of the run", "point force", "small patch"])},
    ),
}


def column(path: Path, name: str) -> list[str]:
    """Return the different values of a column in the order of the file."""
    with path.open(newline="") as file:
        return list(dict.fromkeys(row[name] for row in csv.DictReader(file)))


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_writes_its_rows_machine_and_figure(name, trained, script, tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.latency.missing_packages", lambda: ["onnx"])
    arguments, tables = COMMANDS[name]
    ended = script(name.split()[0], *arguments, f"folder={tmp_path}", cwd=trained)
    assert ended.status == 0, ended.err
    for table, (field, values) in tables.items():
        found = column(tmp_path / table, field)
        assert found[: len(values)] == values
        assert all(value in ended.out for value in found) or "_loads" in table
    machines = [json.loads(path.read_text()) for path in tmp_path.glob("*.json")]
    assert machines
    assert all(one.get("machine") or one["device"] == "cpu" for one in machines)
    for path in tmp_path.glob("*.png"):
        assert np.ptp(imread(path)[..., :3]) > 0.3
    assert list(tmp_path.glob("*.png")) or name.startswith(("devices", "benchmark"))


REFUSED = [
    ("paper groups=[two]", "plan: groups = 'two' must be one of networks"),
    ("paper scale=tiny", "scale = tiny must be one of full, small"),
    ("stress cases=[T99]", "cases: 'T99' is none of T1"),
    ("results name=none", "run = runs/none contains no runs"),
    ("results name=tiny corrected.depth=2", "corrected.depth"),
    ("results name=tiny galerkin.rank=1000", "galerkin: rank = 1000 must lie between 1 and 16"),
    (f"convergence {RUNS} solvers=[fast]", "solvers: ['fast'] must be names of solvers"),
    ("transfer run=runs/none", "run = runs/none contains no runs"),
    ("error_estimates bodies=[beam,table]", "must be some of beam, column, propeller, bracket"),
    ("error_estimates epochs=0", "epochs = 0"),
    ("devices networks=[rnn]", "error: networks = 'rnn' must be one of fcnn"),
    (" ".join(["ablation", *ABLATION, "counts=[8,13]"]), "data.train = 12 must be 13 or more"),
    (" ".join(["ablation", *ABLATION, "+options.stage=[1]"]), "'stage'"),
    (
        " ".join(["ablation", *SMALL, "counts=[8]", "ablation_loads=8", "model=fcnn"]),
        "model must be unrolled",
    ),
    ("benchmark cases=[nonsense]", "cases = 'nonsense' must be one of"),
    ("benchmark cases=[latency]", "run = null must name the trained run"),
    ("benchmark cases=[local] run=runs/tiny/fcnn", "must be a run of model=unrolled"),
]


@pytest.mark.parametrize(("line", "message"), REFUSED)
def test_invalid_input_ends_with_one_line(line, message, trained, script, tmp_path):
    name, *arguments = line.split()
    ended = script(name, *arguments, f"folder={tmp_path / 'out'}", cwd=trained)
    assert ended.status == 2
    assert message in ended.err
    assert ended.err.count("\n") == 1
    assert not list(tmp_path.glob("out/*.csv"))
