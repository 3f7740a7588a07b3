"""Laws of the tables of results: what is measured is what was requested, and nothing is made up."""

import pytest
import torch

from benchmarks import methods, paper_tables, samples
from benchmarks.paper_tables import Result
from dpl.evaluation.tables import write
from dpl.fem import solve
from dpl.models import PODNet
from dpl.training import MSE, ErrorMetrics, Surrogate

SMALL = {"width": 16, "blocks": 1}


@pytest.fixture(scope="module")
def sets(scene, batch):
    return paper_tables.load_sets(scene, batch, 6)


@pytest.fixture(scope="module")
def rows(scene, batch, sets):
    """Rows of the linear solution and of the truth itself, by method and set."""
    known = {
        tuple(f.flatten().tolist()): u for s in sets.values() for f, u in zip(*s[:2], strict=True)
    }

    def cheat(load):
        return torch.stack([known[tuple(f.flatten().tolist())] for f in load.force])

    compared = {"linear": methods.linear(scene), "truth": methods.Method(cheat, 12, 1.5, 7)}
    found = paper_tables.measure(compared, sets, scene.solver, generation_minutes=3.0, repeats=1)
    return {(row.method, row.loads): row for row in found}


def sizes(field):
    return field.flatten(1).norm(dim=1)


def test_sets_are_in_range_beyond_it_and_far_below(scene, batch, sets):
    assert list(sets) == ["in range", "twice", "small"]
    assert sets["in range"] is batch
    drawn = {k: scene.loads.sample((0, s), range(6)).force for k, s in paper_tables.STREAMS.items()}
    for name, (low, high) in {"twice": (1, 2), "small": (0.01, 0.1)}.items():
        factor = sizes(sets[name].force) / sizes(drawn[name])
        assert float(factor[0]) == pytest.approx(low)
        assert float(factor[-1]) == pytest.approx(high)
        assert (factor.diff() > 0).all()


def test_loads_without_an_answer_are_left_out(scene, batch, monkeypatch):
    def fails(solver, load):
        answer = solve(solver, load)
        answer.status[1] = 2
        return answer

    monkeypatch.setattr(samples, "solve", fails)
    found = paper_tables.load_sets(scene, batch, 4)
    assert [len(found[name].force) for name in ("twice", "small")] == [3, 3]


def test_every_method_is_measured_on_every_set(rows, sets):
    assert set(rows) == {(m, s) for m in ("linear", "truth") for s in sets}
    for (_, name), row in rows.items():
        assert row.count == len(sets[name].force)
        assert 0 < row.ms <= row.ms_p99
    linear, truth = (rows[method, "in range"] for method in ("linear", "truth"))
    assert (linear.samples, linear.generation_minutes, linear.parameters) == (None, None, None)
    assert (truth.samples, truth.generation_minutes, truth.training_minutes) == (12, 3.0, 1.5)
    assert truth.newton_iterations == 0
    assert 1 < linear.newton_iterations < 10
    assert rows["linear", "twice"].newton_iterations is None


def test_errors_are_those_of_the_metrics(scene, rows, sets):
    for name, sample in sets.items():
        answer = torch.stack([scene.linear.solve(f) for f in sample.force])
        expected = ErrorMetrics(scene.problem)
        expected.update(answer, sample)
        row = rows["linear", name]
        for key in ("e_mean", "e_max", "SNR_min", "rel_L2_worst", "residual", "min_det_F"):
            assert getattr(row, key) == pytest.approx(float(expected.compute()[key]), rel=1e-9)
    assert rows["truth", "in range"].e_mean == 0


def test_an_error_of_one_percent_of_one_load_has_40_db(scene, batch):
    """With u = 1.01 v, relative L2 is 0.01 and the SNR is 20 log10(101)."""
    largest = batch.displacement.norm(dim=2).amax(dim=1)
    k = int(largest.argmax())
    sets = paper_tables.one_load(batch, 1e3)
    near = methods.Method(lambda load: 1.01 * batch.displacement[k : k + 1])
    (row,) = paper_tables.measure({"near": near}, sets, scene.solver, repeats=1)
    assert (row.method, row.count) == ("near", 1)
    assert row.rel_L2_median == row.rel_L2_worst == pytest.approx(0.01)
    assert row.e_max == pytest.approx(0.01 * float(largest[k]))
    assert pytest.approx(40.0864, abs=1e-3) == row.SNR_min


def test_corrections_bring_answers_nearer_and_leave_the_network_alone(scene, batch):
    torch.manual_seed(0)
    module = Surrogate(PODNet(scene, **SMALL), MSE(), scene).eval()
    module.predictor.fit_bases(batch)
    with torch.no_grad():
        for parameter in module.net.parameters():
            parameter.mul_(0.1)
    plain = methods.Method(module.predict, len(batch.force), 2.0, 5)
    corrected = methods.corrected(module, plain, batch, rank=20, tolerance=1e-4, steps=2)
    with torch.no_grad():
        first, after, again = (m.predict(batch.load) for m in (plain, corrected, plain))
    assert torch.equal(first, again)
    before, after = sizes(first - batch.displacement), sizes(after - batch.displacement)
    small = sizes(batch.displacement) < 0.5  # from an untrained network larger ones may fail
    assert int(small.sum()) >= 4
    assert float(after[small].median()) < 0.1 * float(before[small].median())
    assert (after <= before * (1 + 1e-9)).all()
    assert (corrected.samples, corrected.parameters) == (plain.samples, 5)
    assert corrected.training_minutes > 2


def test_minutes_are_summed_over_sessions(tmp_path):
    assert methods.training_minutes(tmp_path) is None
    (tmp_path / "training.jsonl").write_text('{"seconds": 30.0}\n{"seconds": 90.0}\n')
    assert methods.training_minutes(tmp_path) == 2.0


def test_rows_of_the_paper_are_marked_as_such():
    (row,) = paper_tables.paper("beam_svk")
    assert (row.method, row.e_mean, row.SNR_min, row.ms) == ("paper", 8e-6, 8.4, None)
    assert row.rel_L2_worst == pytest.approx(0.38, abs=0.005), "the paper's text: 38 %"
    both = paper_tables.paper("beam_young")
    assert [(row.method, row.samples) for row in both] == [("paper", 10650), ("paper, 3b", None)]
    (wide,) = paper_tables.paper("beam_young_wide")
    assert (wide.method, wide.e_mean, wide.e_max) == ("paper", 1e-4, None)
    assert paper_tables.paper("mine") == paper_tables.paper("mine", single=True) == []
    _, single = paper_tables.paper("beam_svk", single=True)
    assert single.rel_L2_worst == pytest.approx(0.0098, abs=1e-4), "40.2 dB"


def test_rows_of_other_methods_can_be_kept(tmp_path):
    write(
        [Result(name, "in range", 3, samples=7, ms=1.5) for name in ("cnn", "fcnn")], tmp_path / "a"
    )
    new = [Result("fcnn", loads, 3, samples=16) for loads in ("in range", "twice")]
    rows = paper_tables.with_kept_rows(new, tmp_path / "a")
    assert [(row.method, row.loads, row.samples) for row in rows] == [
        ("fcnn", "in range", 16),
        ("cnn", "in range", 7),
        ("fcnn", "twice", 16),
    ]
    assert paper_tables.with_kept_rows(new, tmp_path / "none") == new
