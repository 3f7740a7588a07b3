"""Evaluation: counts, times, and files that are written."""

import contextlib
import io
import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import matplotlib.image
import meshio
import numpy as np
import pytest
import torch

from dpl import Sample
from dpl.evaluation import compare, evaluate, timing
from dpl.evaluation.comparison import differing_options
from dpl.evaluation.report import measure, show
from dpl.fem import evaluate_solution
from dpl.inference import Simulator
from dpl.models import FCNN
from dpl.training import MSE, Surrogate, relative_errors


@pytest.fixture(scope="module")
def few(batch) -> Sample:
    return Sample(*(column[:4] for column in batch))


class Known:
    """Returns given solutions (B, N, D) and iteration counts."""

    def __init__(self, problem, batch, answers, counts):
        self.problem, self.batch, self.answers, self.counts = problem, batch, answers, counts
        self.requested = []

    def iterate(self, load):
        assert len(load.force) == 1, "one load at a time"
        (k,) = [k for k, force in enumerate(self.batch.force) if torch.equal(force, load.force[0])]
        self.requested.append(k)
        yield evaluate_solution(self.problem, torch.zeros_like(load.force), load, 1e-8)
        answer = self.answers[k : k + 1]
        yield evaluate_solution(self.problem, answer, load, 1e-8, iterations=self.counts[k])


def test_rows_contain_iterations_and_converged_loads(scene, few):
    wrong = few.displacement.clone()
    wrong[2] *= 1.01
    exact = Known(scene.problem, few, few.displacement, [3, 4, 5, 8])
    poor = Known(scene.problem, few, wrong, [0, 0, 0, 0])
    rows, answers = measure({"exact": exact, "poor": poor}, few, scene.problem)
    assert [row.solver for row in rows] == ["exact", "poor"]
    first, second = rows
    assert (first.converged, first.loads) == (4, 4)
    assert (second.converged, second.loads) == (3, 4)
    assert (first.iterations, first.max_iterations) == (5.0, 8)
    assert (second.iterations, second.max_iterations) == (0.0, 0)
    assert first.errors["e_max"] == 0.0
    assert second.errors["rel_L2_worst"] == pytest.approx(0.01, rel=1e-9)
    assert second.errors["rel_L2_median"] == 0.0
    assert torch.equal(answers["poor"], wrong)
    broken = Known(scene.problem, few, torch.full_like(few.displacement, torch.nan), [9] * 4)
    (row,), _ = measure({"broken": broken}, few, scene.problem)
    assert row.converged == 0
    assert row.errors["residual"] == np.inf
    show([row], "broken")


def test_every_solver_is_warmed_up_and_then_timed_alternately(scene, few):
    order = []

    class Spy(Known):
        def iterate(self, load):
            order.append(self)
            return super().iterate(load)

    a, b = (Spy(scene.problem, few, few.displacement, [1] * 4) for _ in range(2))
    measure({"a": a, "b": b}, few, scene.problem)
    assert a.requested == b.requested == [0, 0, 1, 2, 3]
    assert order == [a, b] + [a, b] * 4


def test_the_clock_measures_the_solver(scene, few, monkeypatch):
    watch = SimpleNamespace(now=0.0)
    monkeypatch.setattr(timing, "time", SimpleNamespace(perf_counter=lambda: watch.now))

    class Slow(Known):
        def iterate(self, load):
            yield from super().iterate(load)
            watch.now += 1e-3 * (10 + self.requested[-1])

    slow = Slow(scene.problem, few, few.displacement, [1] * 4)
    fast = Known(scene.problem, few, few.displacement, [1] * 4)
    (first, second), _ = measure({"slow": slow, "fast": fast}, few, scene.problem)
    assert first.ms == pytest.approx(11.5)
    assert first.ms_p99 == pytest.approx(12.97)
    assert second.ms == second.ms_p99 == 0.0


def test_runs_that_differ_in_the_seed_form_a_group(evaluated, tmp_path, capsys):
    rows = evaluated[0]
    for k, (loss, seed) in enumerate((("MSE", 0), ("MSE", 1), ("LrStar", 0))):
        folder = tmp_path / f"loss-{loss}_seed-{seed}"
        folder.mkdir()
        (folder / "config.yaml").write_text(json.dumps({"loss": loss, "seed": seed}))
        prediction = replace(rows[1], errors={**rows[1].errors, "e_mean": 0.125 * (k + 1)})
        content = [asdict(row) for row in (rows[0], prediction, *rows[2:])]
        (folder / "evaluation.json").write_text(json.dumps(content))
    compare(tmp_path)
    lines = capsys.readouterr().out.splitlines()
    (one,) = [line for line in lines if "median of" in line]
    assert one.split()[:4] == ["median", "of", "2", "MSE"], "no seed"
    assert " 1.9e-01 " in one, "the mean of 0.125 and 0.25"
    assert sum("seed-" in line for line in lines) == 3


def test_runs_of_one_configuration_form_a_group_whatever_their_names(evaluated, tmp_path, capsys):
    model = {"_target_": "dpl.models.FCNN"}
    for name, seed, width in (("a", 0, 8), ("b", 1, 8), ("c", 0, 16), ("d" * 50, 0, 32)):
        (tmp_path / name).mkdir()
        options = {"model": {**model, "width": width}, "seed": seed, "data": {"shuffle_seed": seed}}
        (tmp_path / name / "config.yaml").write_text(json.dumps(options))
        content = json.dumps([asdict(row) for row in evaluated[0]])
        (tmp_path / name / "evaluation.json").write_text(content)
    compare(tmp_path)
    out = capsys.readouterr().out
    assert [line.split()[:4] for line in out.splitlines() if "median of" in line] == [
        ["median", "of", "2", "8"]
    ]
    assert max(len(line.rstrip()) for line in out.splitlines()) <= 100


def test_folders_without_an_evaluation_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="no evaluated run"):
        compare(tmp_path)
    (tmp_path / "evaluation.json").write_text('[{"solver": "network"}]')
    with pytest.raises(
        ValueError, match=r"evaluation\.json has no row prediction; run evaluate\.py"
    ):
        compare(tmp_path)


def test_options_in_which_runs_differ_are_columns_and_swept_ones_come_first():
    rates = [{"model": "FCNN", "optimizer.lr": rate, "a.seed": k, "b.seed": k, "x.y.z": k + 1}
             for k, rate in enumerate((0.1, 0.2))]  # fmt: skip
    names = [f"x.y.z-{k}" for k in (1, 2)]
    columns = {"z": ["1", "2"], "a.seed": ["0", "1"], "lr": ["0.1", "0.2"]}
    found = differing_options(names, rates, 100)
    assert found == columns
    assert list(found) == list(columns)
    assert differing_options(names, rates, 5) == {"z": ["1", "2"]}, "there is room for one"
    assert differing_options(["a", "b"], [rates[0], {}], 100)["z"] == ["1", ""]


# ------------------------------------------------------------------ evaluation


@pytest.fixture(scope="module")
def surrogate(scene):
    torch.manual_seed(0)
    return Surrogate(FCNN(scene, width=8), MSE(), scene).eval()


@pytest.fixture(scope="module")
def evaluated(surrogate, few, tmp_path_factory):
    """Rows, folder and output of an evaluation."""
    folder, out = tmp_path_factory.mktemp("evaluated"), io.StringIO()
    threads = torch.get_num_threads()
    with contextlib.redirect_stdout(out):
        rows = evaluate(surrogate, few, folder)
    assert torch.get_num_threads() == threads
    return rows, folder, out.getvalue()


def test_an_evaluation_has_four_rows_that_are_saved(evaluated):
    rows, folder, _ = evaluated
    assert [row.solver for row in rows] == [
        "linear",
        "prediction",
        "paper's hybrid to 1e-6",
        "sim(force, error=1e-3)",
        "sim(force, tol=1e-3)",
        "sim(force, tol=1e-6)",
        "Newton, tol=1e-3",
        "Newton, tol=1e-6",
    ]
    saved = json.loads((folder / "evaluation.json").read_text())
    assert saved == json.loads(json.dumps([asdict(row) for row in rows]))
    for row in saved:
        if row["solver"] != "prediction":
            assert row["latency"] == {}
            continue
        assert list(row["latency"]) == ["sim(force)", "bare network"]
        for one in row["latency"].values():
            assert one["loads"] == 4
            assert 0 < one["p50"] <= one["p99"]
    pixels = matplotlib.image.imread(folder / "shapes.png")
    assert pixels.shape[0] > 300
    assert pixels.shape[1] > 600
    assert pixels[..., :3].std() > 0.01


def test_hybrid_simulator_and_newton_answer_every_load(evaluated):
    linear, prediction, hybrid, to_error, *others = evaluated[0]
    assert to_error.converged == 4
    assert to_error.estimated_error <= 1e-3
    assert to_error.errors["residual"] > 1e-8
    for row in (hybrid, *others):
        tol = 1e-3 if "1e-3" in row.solver else 1e-6
        assert row.converged == 4
        assert row.errors["residual"] < tol
        assert row.errors["rel_L2_worst"] < 100 * tol
        assert row.iterations >= 2
    assert prediction.iterations == 0
    assert linear.iterations == 1


def test_each_row_has_the_median_of_the_estimated_errors(evaluated, surrogate, few):
    linear, prediction, *_, newton = evaluated[0]
    answer = Simulator(surrogate)(**surrogate.scene.si_inputs(few.load))
    assert prediction.estimated_error == pytest.approx(float(np.median(answer.error)))
    error = linear.errors["rel_L2_median"]
    assert 0.5 * error < linear.estimated_error < 10 * error
    assert newton.estimated_error < 1e-6


def test_the_tolerances_of_an_evaluation_replace_that_of_the_scene(surrogate, few, tmp_path):
    one = Sample(*(column[:1] for column in few))
    rows = evaluate(surrogate, one, tmp_path, tols=[1e-2], errors=[])
    assert not [row for row in rows if "error=" in row.solver]
    newton = rows[-1]
    assert newton.converged == 1
    assert 1e-8 < newton.errors["residual"] < 1e-2
    assert surrogate.scene.solver.tol == 1e-8


def test_the_table_prints_every_row(evaluated):
    out = evaluated[2]
    assert "4 test loads, one at a time, 1 thread" in out
    assert max(len(line.rstrip()) for line in out.splitlines()) <= 100
    assert "latency, 1 thread: sim(force) p50 " in out
    (head,) = [line for line in out.splitlines() if "e_mean" in line]
    assert head.split().index("e_max") == head.split().index("e_mean") + 1
    assert "SNR" in out
    for words in ("linear", "prediction", "paper's hybrid", "Newton, tol=1e-6", "4/4", "p99"):
        assert words in out


def test_the_worst_case_is_written_in_si_units(evaluated, surrogate, scene, few):
    case = meshio.read(evaluated[1] / "worst.vtu")
    with torch.no_grad():
        network = surrogate.predict(few.load)
    worst = int(relative_errors(network, few).argmax())
    length, fields = scene.length, case.point_data
    assert np.ptp(case.points, axis=0) == pytest.approx([100.0, 25.0, 25.0])
    assert case.cells_dict["hexahedron"].shape == (16, 8)
    truth = length * few.displacement[worst].numpy()
    assert fields["reference displacement [m]"] == pytest.approx(truth, abs=1e-9)
    assert fields["displacement [m]"] == pytest.approx(length * network[worst].numpy(), abs=1e-5)
    gap = np.linalg.norm(fields["displacement [m]"] - fields["reference displacement [m]"], axis=1)
    assert fields["error [m]"] == pytest.approx(gap, abs=1e-9)
    force, metres = (
        torch.from_numpy(fields[name])[None] for name in ("force [N]", "reference displacement [m]")
    )
    load = scene.load_of(force, torch.tensor([4500.0]))
    assert evaluate_solution(scene.problem, metres / length, load, 1e-7).converged, "in equilibrium"
