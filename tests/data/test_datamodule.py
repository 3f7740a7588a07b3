"""Laws of the data modules: batches, their order, and which loads are solved or read."""

import itertools
import json
import multiprocessing
from types import SimpleNamespace

import lightning as L
import numpy as np
import pytest
import torch

from dpl import Sample
from dpl.data import DataSet, OfflineData, OnlineData, Samples
from dpl.data.replay_buffer import StreamRates
from dpl.data.solving.solve import LoadKey, solve_load
from dpl.data.storage.integrity import verify
from dpl.data.storage.store import SHARD_SIZE
from dpl.fem import symmetries
from dpl.models import FCNN
from dpl.system.files import exclusive_lock
from dpl.training import MSE, Surrogate

SIZES = {"val": 4, "test": 4, "workers": 0, "batch_size": 4}
STREAM = {"batches": 3, "new_per_round": 4, "reuse": 1, "capacity": 64}


@pytest.fixture(autouse=True)
def threads():
    """Restore the number of threads, which a stream changes."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def offline(scene, folder, data):
    """Return a function that builds data modules of the tiny data set."""

    def offline(**options):
        return OfflineData(scene, folder=str(folder), **{"train": 12, **SIZES, **options})

    return offline


@pytest.fixture
def online(scene, folder, data):
    """Return a function that builds streams; they validate on the tiny data set and are closed."""
    made = []

    def online(**options):
        made.append(OnlineData(scene, folder=str(folder), **{**SIZES, **STREAM, **options}))
        return made[-1]

    yield online
    for one in made:
        one.teardown("fit")


@pytest.fixture
def saving(scene, tmp_path):
    """Return a function that builds streams with a cache in a new data set."""
    made = []

    def saving(**options):
        options = {**SIZES, "val": 1, "test": 1, **STREAM, "cache": True, **options}
        made.append(OnlineData(options.pop("scene", scene), folder=str(tmp_path / "d"), **options))
        made[-1].prepare_data()
        return made[-1]

    yield saving
    for one in made:
        one.teardown("fit")


def placed(module, rank, processes):
    """Return a data module that is one of several training processes."""
    module.trainer = SimpleNamespace(global_rank=rank, world_size=processes, logger=None)
    return module


def order(module, epoch):
    loader = module.train_dataloader()
    loader.sampler.set_epoch(epoch)
    return [force.numpy().tobytes() for batch in loader for force in batch.force]


def forces(batches):
    return [force.numpy().tobytes() for batch in batches for force in batch.force]


def drawn(scene, count):
    return forces([scene.loads.sample((0, 0), range(count))])


# ------------------------------------------------------------------ from disk


def test_an_epoch_holds_every_sample_once(offline):
    module = offline(batch_size=5)
    batches = list(module.train_dataloader())
    assert [len(batch.force) for batch in batches] == [5, 5, 2]
    assert sorted(forces(batches)) == sorted(forces([module.samples("train")]))
    assert all(isinstance(batch, Sample) for batch in batches)


def test_batches_are_a_function_of_shuffle_and_epoch(offline):
    first = order(offline(shuffle_seed=3), epoch=2)
    assert order(offline(shuffle_seed=3), epoch=2) == first
    assert order(offline(shuffle_seed=3), epoch=3) != first
    assert order(offline(shuffle_seed=4), epoch=2) != first


def test_forces_and_displacements_stay_together(offline):
    module = offline(symmetry=True)
    truth = module.samples("train")
    pairs = dict(zip(forces([truth]), truth.displacement, strict=True))
    for batch in module.train_dataloader():
        for force, displacement in zip(batch.force, batch.displacement, strict=True):
            if (key := force.numpy().tobytes()) in pairs:
                assert torch.equal(pairs.pop(key), displacement)
    assert not pairs


def test_validation_and_test_keep_their_order(offline):
    module = offline(batch_size=3)
    assert forces(module.val_dataloader()) == forces([module.samples("val")])
    assert forces(module.test_dataloader()) == forces([module.samples("test")])


def test_splits_are_disjoint(offline):
    module = offline()
    splits = [set(forces([module.samples(split)])) for split in ("train", "val", "test")]
    assert [len(split) for split in splits] == [12, 4, 4]
    assert len(set.union(*splits)) == 20


def test_batches_keep_double_precision(offline):
    batch = next(iter(offline().train_dataloader()))
    assert all(column.dtype == torch.float64 for column in batch)


def test_a_batch_is_a_copy(offline):
    """A training step may change its batch in place."""
    module = offline(symmetry=True)
    before = module.samples("train").force.clone()
    for batch in module.train_dataloader():
        batch.force.zero_()
    assert torch.equal(module.samples("train").force, before)


def test_the_plan_counts_what_is_there(offline, scene, folder, tmp_path):
    where, line = offline().skipped_work()
    assert str(folder) in where
    assert scene.fingerprint[:12] in where
    assert line.startswith("20 of 20 loads not solved again")
    assert offline(train=30).skipped_work()[1].startswith("20 of 38 loads not solved again")
    (where,) = OfflineData(scene, folder=str(tmp_path / "new"), workers=0).skipped_work()
    assert str(tmp_path / "new") in where
    assert not (tmp_path / "new").exists(), "a plan computes nothing and writes nothing"


def test_preparing_twice_solves_nothing(offline, folder, monkeypatch):
    def written():
        return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    module, before, solved = offline(), written(), []
    monkeypatch.setattr(
        "dpl.data.solving.worker_pool.solve_load", lambda *_, **__: solved.append(1)
    )
    module.prepare_data()
    assert solved == []
    assert written() == before != {}


@pytest.mark.parametrize(
    "options",
    [
        {"train": -1}, {"val": 0}, {"test": 0}, {"batch_size": 0}, {"workers": -1}, {"seed": -1},
        {"timeout": 0.0},
    ],
    ids=lambda options: next(iter(options)),
)  # fmt: skip
def test_options_out_of_range_are_refused_by_name(offline, options):
    with pytest.raises(ValueError, match=f"{next(iter(options))} = "):
        offline(**options)


# ------------------------------------------------------------------ young: one data set for all


def test_the_moduli_are_those_of_the_scene_that_reads_the_data_set(
    scene, make_scene, offline, folder
):
    """u/L depends on f/(E L^2) only, so a data set is valid for every modulus and size."""
    wide = make_scene(young=[1e6, 2e11], size=(1.0, 0.25, 0.25))
    module = OfflineData(wide, folder=str(folder), train=12, **SIZES)
    here, there = offline().samples("train"), module.samples("train")
    assert torch.equal(here.force, there.force)
    assert torch.equal(here.displacement, there.displacement)
    assert (here.young == 4500.0).all()
    assert torch.equal(there.young, wide.loads.sample((0, 0), range(12)).young)
    assert len(there.young.unique()) == 12
    assert torch.equal(next(iter(module.val_dataloader())).young, module.samples("val").young)


# ------------------------------------------------------------------ symmetry


def test_an_epoch_holds_the_images_of_every_sample_once(scene, offline):
    module, group = offline(symmetry=True, batch_size=5), symmetries(scene.problem)
    assert len(group) > 1
    seen = forces(module.train_dataloader())
    samples = module.samples("train")
    images = [forces([samples._replace(force=one.image(samples.force))]) for one in group]
    assert len(seen) == 12 * len(group)
    assert sorted(seen) == sorted(itertools.chain(*images))


def test_images_are_in_equilibrium_to_the_tolerance(scene, offline):
    worst = 0.0
    for batch in offline(symmetry=True).train_dataloader():
        internal, volume = scene.problem.evaluate(batch.displacement)
        assert (volume > 0).all()
        worst = max(worst, float(scene.problem.relative_residual_of(internal, batch.force).max()))
    assert 0 < worst < 1e-8


def test_images_keep_the_modulus_of_their_sample(make_scene, folder, data):
    """The norm of the force identifies the sample of an image."""
    scene = make_scene(young=[1e6, 2e11])
    module = OfflineData(scene, folder=str(folder), train=12, symmetry=True, **SIZES)
    samples = module.samples("train")
    norms = samples.force.flatten(1).norm(dim=1)
    for batch in module.train_dataloader():
        found = (batch.force.flatten(1).norm(dim=1)[:, None] - norms).abs().argmin(dim=1)
        assert torch.equal(batch.young, samples.young[found])


def test_validation_and_test_have_no_images(offline):
    module = offline(symmetry=True)
    assert forces(module.val_dataloader()) == forces([module.samples("val")])
    assert forces(module.test_dataloader()) == forces([module.samples("test")])


def test_the_order_of_images_is_a_function_of_shuffle_and_epoch(offline):
    first = order(offline(symmetry=True, shuffle_seed=3), epoch=2)
    assert order(offline(symmetry=True, shuffle_seed=3), epoch=2) == first
    assert order(offline(symmetry=True, shuffle_seed=3), epoch=3) != first
    assert order(offline(symmetry=True, shuffle_seed=4), epoch=2) != first
    assert sorted(order(offline(symmetry=True, shuffle_seed=4), epoch=0)) == sorted(first)


def test_images_of_a_sample_are_spread_over_the_epoch(offline):
    """Images are shuffled like samples."""
    module = offline(symmetry=True, batch_size=12)
    norms = [batch.force.flatten(1).norm(dim=1) for batch in module.train_dataloader()]
    assert any(len((n / n.max()).mul(1e9).round().unique()) < 12 for n in norms)


def test_the_plan_says_how_many_samples_a_load_makes(scene, offline):
    count = len(symmetries(scene.problem))
    line = f"{count} samples of each load solved, in gradient descent only: symmetries of the body"
    assert line in offline(symmetry=True).skipped_work()
    assert not any("symmetr" in line for line in offline().skipped_work())


def test_a_force_in_every_load_breaks_the_symmetries_that_turn_it(make_scene, tmp_path):
    scene = make_scene()
    down = torch.zeros(scene.problem.shape, dtype=torch.float64)
    down[:, 2] = torch.where(scene.loads.loadable_dofs[:, 2], -1e-7, 0.0)
    weighted = make_scene(constant_force=down)
    free = OfflineData(scene, folder=str(tmp_path), symmetry=True, **SIZES)
    held = OfflineData(weighted, folder=str(tmp_path), symmetry=True, **SIZES)
    assert 1 < len(held.group) < len(free.group)
    assert all(torch.equal(one.image(down), down) for one in held.group)


def test_samples_without_symmetries_have_no_images(batch):
    plain = Samples(batch)
    assert len(plain) == 12
    assert torch.equal(plain.__getitems__([3, 1]).force, batch.force[[3, 1]])


def test_a_stream_yields_images_under_symmetries(online, scene):
    module = online(symmetry=True, batch_size=12, new_per_round=12, batches=4, capacity=1000)
    assert [line for line in module.skipped_work() if "samples of each load" in line]
    batches = list(module.train_dataloader())
    own = set(forces([module._replay._buffer.sample]))
    assert len(set(forces(batches)) - own) > 24, "seven of eight are images"
    for batch in batches:
        ratio = scene.problem.relative_residual(batch.displacement, batch.force)
        assert ratio.max() < scene.solver.tol


# ------------------------------------------------------------------ several training processes


def test_two_processes_see_disjoint_halves_of_the_samples(offline):
    for epoch in (0, 1):
        halves = [order(placed(offline(shuffle_seed=1), k, 2), epoch) for k in (0, 1)]
        assert [len(half) for half in halves] == [6, 6]
        assert not set(halves[0]) & set(halves[1])
        assert sorted(halves[0] + halves[1]) == sorted(forces([offline().samples("train")]))


def test_two_processes_share_the_images(scene, offline):
    count = 12 * len(symmetries(scene.problem))
    halves = [set(order(placed(offline(symmetry=True), k, 2), 0)) for k in (0, 1)]
    assert not halves[0] & halves[1]
    assert len(halves[0] | halves[1]) == count


def test_two_processes_see_disjoint_halves_of_the_stream(scene, online):
    options = {"batches": 2, "new_per_round": 4, "batch_size": 4}
    halves = [set(forces(placed(online(**options), k, 2).train_dataloader())) for k in (0, 1)]
    assert [len(half) for half in halves] == [8, 8]
    assert halves[0] | halves[1] == set(drawn(scene, 16))


def test_resumed_streams_of_two_processes_draw_no_load_twice(scene, online):
    """A checkpoint holds the state of rank 0; the other ranks may be ahead of it."""
    first = [placed(online(), k, 2) for k in (0, 1)]
    seen = set().union(*[forces(module.train_dataloader()) for module in first])
    resumed = [placed(online(), k, 2) for k in (0, 1)]
    for module in resumed:
        module.load_state_dict(first[0].state_dict())
    again = [set(forces(module.train_dataloader())) for module in resumed]
    assert not again[0] & again[1]
    assert not seen & (again[0] | again[1])


# ------------------------------------------------------------------ online


@pytest.mark.parametrize(
    "options",
    [
        {"batches": 0},
        {"new_per_round": 0},
        {"reuse": 0},
        {"capacity": 3},
        {"hard_example_fraction": -0.1},
        {"hard_example_fraction": 1.1},
    ],
    ids=lambda options: next(iter(options)),
)
def test_options_of_the_stream_out_of_range_are_refused_by_name(online, options):
    with pytest.raises(ValueError, match=f"{next(iter(options))} = "):
        online(**options)


def test_a_buffer_whose_uses_make_no_batch_is_refused(online):
    """Loads would be solved without end."""
    with pytest.raises(ValueError, match=r"reuse = 8 .* batch_size = 17") as refusal:
        online(capacity=8, reuse=2, batch_size=17)
    assert "\n" not in str(refusal.value)
    options = {"capacity": 8, "reuse": 2, "batch_size": 16, "new_per_round": 3, "batches": 2}
    assert len(list(online(**options).train_dataloader())) == 2


@pytest.mark.parametrize("option", ["train", "error", "minutes", "max_train"])
def test_options_without_effect_on_a_stream_are_refused(online, option):
    with pytest.raises(TypeError, match=option):
        online(**{option: 1})


def test_batches_of_a_stream_are_a_function_of_shuffle(online):
    options = {"symmetry": True, "reuse": 2}
    first, same, other = (
        forces(online(shuffle_seed=seed, **options).train_dataloader()) for seed in (3, 3, 4)
    )
    assert first == same != other


@pytest.mark.parametrize("name", ["online", "offline"])
def test_the_order_of_the_batches_follows_the_seed_of_the_run(compose, name):
    cfg = compose(f"data={name}", "seed=5", command="train")
    assert (cfg.data.shuffle_seed, cfg.data.seed) == (5, 0)


def test_the_cache_and_hard_examples_exclude_each_other(online):
    with pytest.raises(ValueError, match=r"cache = true .* hard_example_fraction = 0") as refusal:
        online(cache=True, hard_example_fraction=0.1)
    assert "\n" not in str(refusal.value)
    online(cache=True, hard_example_fraction=0.0)
    online(cache=False, hard_example_fraction=1.0)


def test_the_stream_solves_the_loads_that_the_data_set_would_hold(online, offline):
    options = {"batches": 10, "batch_size": 12, "new_per_round": 12, "reuse": 20}
    batches = list(online(**options).train_dataloader())
    assert set(forces(batches)) == set(forces([offline().samples("train")]))


def test_the_stream_validates_on_the_data_set(online, offline):
    assert forces(online().val_dataloader()) == forces(offline().val_dataloader())
    assert forces(online().test_dataloader()) == forces(offline().test_dataloader())


def test_preparing_a_stream_solves_no_training_load(scene, tmp_path, monkeypatch):
    seen = []

    def counted(scene, job):
        seen.append(job.seed)
        return solve_load(scene, job)

    monkeypatch.setattr("dpl.data.solving.worker_pool.solve_load", counted)
    module = OnlineData(scene, folder=str(tmp_path / "d"), val=2, test=3, workers=0)
    module.prepare_data()
    assert sorted(seen) == [(0, 1)] * 2 + [(0, 2)] * 3
    module.train_dataloader()
    assert len(seen) == 5


def test_a_stream_without_hard_examples_computes_no_errors(online, monkeypatch):
    def forbidden(*_, **__):
        raise AssertionError("made")

    monkeypatch.setattr("dpl.data.online.HardExamples", forbidden)
    monkeypatch.setattr(OnlineData, "_errors", forbidden)
    assert len(list(online().train_dataloader())) == 3
    with pytest.raises(AssertionError, match="made"):
        online(hard_example_fraction=0.5).train_dataloader()


def test_loads_are_drawn_near_the_load_with_the_largest_error(scene, online):
    """The first loads are those of the seed, since there are no errors yet."""
    module = online(
        hard_example_fraction=1.0, batch_size=4, new_per_round=4, batches=1, capacity=64
    )
    reported = SimpleNamespace(batch_errors=None)
    module.trainer = SimpleNamespace(
        lightning_module=reported, logger=None, global_rank=0, world_size=1
    )
    stream = module.train_dataloader()
    first = next(iter(stream))
    reported.batch_errors = torch.arange(4.0)
    assert sorted(forces([first])) == sorted(drawn(scene, 4))
    next(iter(stream))
    worst = module._replay.stream.hard_examples
    assert int(worst.count) == 1
    load = scene.loads.loads_at(worst.points[:1])
    assert torch.equal(load.force[0], first.force[3])


# ------------------------------------------------------------------ resumed streams


def test_a_resumed_stream_continues_with_the_next_load(online):
    module = online()
    first = set(forces(module.train_dataloader()))
    state = module.state_dict()
    assert state == {"next_index": 12}
    resumed = online()
    resumed.load_state_dict(state)
    assert resumed.state_dict() == state
    second = set(forces(resumed.train_dataloader()))
    assert not first & second
    assert resumed.state_dict() == {"next_index": 24}


def test_a_resumed_stream_draws_no_load_twice_where_some_are_rejected(online, monkeypatch):
    def choosy(scene, job, **options):
        return solve_load(scene, job, **options)._replace(accepted=job.number % 3 == 1)

    monkeypatch.setattr("dpl.data.stream.solve_load", choosy)
    module = online()
    first = set(forces(module.train_dataloader()))
    resumed = online()
    resumed.load_state_dict(module.state_dict())
    assert not first & set(forces(resumed.train_dataloader()))


def test_a_resumed_stream_of_two_workers_draws_no_load_twice(online):
    module = online(workers=2, batches=3, new_per_round=4, batch_size=64, reuse=32, capacity=64)
    first = set(forces(itertools.islice(module.train_dataloader(), 3)))
    state = module.state_dict()
    module.teardown("fit")
    assert not multiprocessing.active_children()
    resumed = online()
    resumed.load_state_dict(state)
    assert not first & set(forces(resumed.train_dataloader()))


# ------------------------------------------------------------------ what is solved is kept


def names(folder):
    return sorted(path.name for path in folder.glob("train-*.safetensors"))


def test_cached_loads_are_in_whole_shards_and_pending_files(scene, saving, tmp_path):
    module = saving(batches=20)  # 80 loads
    seen = forces(module.train_dataloader())
    folder = tmp_path / "d"
    assert names(folder) == ["train-000000.safetensors"]
    assert sorted(seen) == sorted(drawn(scene, 80))
    assert sorted(forces([module.store.load("train", SHARD_SIZE)])) == sorted(
        drawn(scene, SHARD_SIZE)
    )
    pending = sorted(path.name for path in (folder / "pending").iterdir())
    assert [name[:13] for name in pending] == [f"train-{k:06d}." for k in range(SHARD_SIZE, 80)]
    assert module.store.missing("train", 80) == list(range(SHARD_SIZE, 80))


def test_a_data_set_started_online_and_completed_offline_has_the_same_bytes(
    scene, saving, tmp_path
):
    """Manifest and samples do not depend on the process that solved a load."""
    module = saving(batches=20)
    list(module.train_dataloader())
    module.teardown("fit")
    sizes = {"train": 100, "val": 1, "test": 1, "workers": 0}
    one = DataSet(scene, str(tmp_path / "d"), **sizes)
    solved = []
    for got in one.solve(one.missing().items()):
        solved.append(got.job.number)
    assert solved == list(range(80, 100)), "no load is solved again"
    other = DataSet(scene, str(tmp_path / "offline"), **sizes)
    other.fill()

    def manifest(data):
        lines = (data.store.folder / "manifest.jsonl").read_text().splitlines()
        return sorted(json.loads(line)["file"] + line for line in lines)

    assert manifest(one) == manifest(other)
    assert one.store.digest("train", 100) == other.store.digest("train", 100)
    assert all(not flaw for _, flaw in verify(one.store))
    assert not (tmp_path / "d" / "pending").exists()


def test_loads_of_the_data_set_are_read_and_not_solved(scene, saving, tmp_path, monkeypatch):
    DataSet(scene, str(tmp_path / "d"), train=20, val=1, test=1, workers=0).fill()
    solved = []

    def counted(scene, job, **options):
        solved.append(job.number)
        return solve_load(scene, job, **options)

    monkeypatch.setattr("dpl.data.stream.solve_load", counted)
    module = saving(batches=6)
    assert "20 loads of the stream not solved again: they are there" in module.skipped_work()
    batches = list(module.train_dataloader())
    assert solved == [20, 21, 22, 23]
    assert sorted(forces(batches)) == sorted(drawn(scene, 24))
    truth = module.store.load("train", 20)
    pairs = dict(zip(forces([truth]), truth.displacement, strict=True))
    for batch in batches:
        for force, displacement in zip(batch.force, batch.displacement, strict=True):
            if (key := force.numpy().tobytes()) in pairs:
                assert torch.equal(pairs.pop(key), displacement)
    assert not pairs


def test_read_loads_have_the_moduli_of_this_scene(make_scene, saving, scene, tmp_path):
    DataSet(scene, str(tmp_path / "d"), train=4, val=1, test=1, workers=0).fill()
    wide = make_scene(young=[1e6, 2e11])
    (batch,) = saving(scene=wide, batches=1).train_dataloader()
    assert torch.equal(batch.young.sort()[0], wide.loads.sample((0, 0), range(4)).young.sort()[0])


def test_pending_loads_are_not_solved_again(saving, monkeypatch, tmp_path):
    """A stopped run leaves up to 63 pending loads, and a resumed one starts before them."""
    list(saving(batches=6).train_dataloader())
    pending = sorted((tmp_path / "d" / "pending").iterdir())
    assert len(pending) == 24

    def forbidden(*_, **__):
        raise AssertionError("solved again")

    monkeypatch.setattr("dpl.data.stream.solve_load", forbidden)
    list(saving(batches=6).train_dataloader())
    assert sorted((tmp_path / "d" / "pending").iterdir()) == pending


def test_a_load_solved_twice_leaves_no_pending_file(scene, saving, tmp_path):
    for _ in range(2):
        list(saving(batches=6).train_dataloader())
    DataSet(scene, str(tmp_path / "d"), train=24, val=1, test=1, workers=0).fill()
    assert not (tmp_path / "d" / "pending").exists()


def test_rejected_loads_are_kept_as_rejected(scene, saving, tmp_path, monkeypatch):
    def choosy(scene, job, **options):
        one = solve_load(scene, job, **options)
        return one._replace(accepted=False, reason="a whim") if job.number % 3 == 0 else one

    monkeypatch.setattr("dpl.data.stream.solve_load", choosy)
    monkeypatch.setattr("dpl.data.solving.worker_pool.solve_load", choosy)
    module = saving(batches=12)  # 48 accepted of 71 or 72
    seen = forces(module.train_dataloader())
    loads = drawn(scene, 72)
    assert sorted(seen) == sorted(load for k, load in enumerate(loads) if k % 3)
    (line,) = (line for line in module.store.shards() if line["split"] == "train")
    assert line["tried"] == SHARD_SIZE
    assert [one["index"] for one in line["rejected"]] == list(range(0, SHARD_SIZE, 3))
    assert {one["reason"] for one in line["rejected"]} == {"a whim"}
    again = saving(batches=10)
    solved = []
    monkeypatch.setattr(
        "dpl.data.stream.solve_load", lambda *a, **k: solved.append(1) or choosy(*a, **k)
    )
    first = forces(again.train_dataloader())
    assert not set(first) & {load for k, load in enumerate(loads) if not k % 3}
    assert not solved, "neither what was accepted nor what was rejected"


def test_rejected_loads_with_nan_do_not_reach_training(saving, monkeypatch):
    """Displacements of rejected loads may be NaN."""

    def choosy(scene, job, **options):
        one = solve_load(scene, job, **options)
        bad = one._replace(accepted=False, reason="x", displacement=np.nan * one.displacement)
        return bad if job.number % 2 else one

    monkeypatch.setattr("dpl.data.stream.solve_load", choosy)
    for batch in saving(batches=20).train_dataloader():
        assert all(torch.isfinite(column).all() for column in batch)


def test_a_stream_without_cache_writes_nothing(scene, tmp_path):
    options = {**SIZES, **STREAM, "val": 1, "test": 1}
    module = OnlineData(scene, folder=str(tmp_path / "d"), **options)
    module.prepare_data()
    before = sorted(path.name for path in (tmp_path / "d").rglob("*"))
    list(module.train_dataloader())
    assert sorted(path.name for path in (tmp_path / "d").rglob("*")) == before


def test_only_the_first_of_several_processes_writes_shards(saving, tmp_path):
    modules = [placed(saving(batches=16), k, 2) for k in (1, 0)]
    list(modules[0].train_dataloader())
    assert not names(tmp_path / "d")
    assert len(list((tmp_path / "d" / "pending").iterdir())) == 64
    list(modules[1].train_dataloader())
    assert names(tmp_path / "d") == ["train-000000.safetensors", "train-000064.safetensors"]


def test_another_writer_does_not_end_a_training_run(saving, tmp_path):
    """Shards are written after the next epoch."""
    stream = saving(batches=16).train_dataloader()
    with exclusive_lock(tmp_path / "d"):
        list(stream)
    assert len(list((tmp_path / "d" / "pending").iterdir())) == 64
    list(stream)
    assert len(names(tmp_path / "d")) == 2


@pytest.mark.slow
def test_two_workers_cache_the_loads_that_they_solve(scene, saving, tmp_path):
    module = saving(workers=2, batches=24, new_per_round=4)
    seen = forces(module.train_dataloader())
    module.teardown("fit")
    store = DataSet(scene, str(tmp_path / "d"), train=80, val=1, test=1, workers=0).fill()
    assert all(not flaw for _, flaw in verify(store))
    assert names(tmp_path / "d")[0] == "train-000000.safetensors"
    assert set(seen) <= set(drawn(scene, 128))
    assert module.store.missing("train", SHARD_SIZE) == []


# ------------------------------------------------------------------ within a trainer


@pytest.fixture
def fitted(scene):
    """Return a function that trains on a stream and returns the trainer."""

    def fitted(module, epochs=2):
        torch.manual_seed(0)
        trainer = L.Trainer(
            accelerator="cpu", max_epochs=epochs, logger=False, num_sanity_val_steps=0,
            enable_progress_bar=False, enable_model_summary=False, enable_checkpointing=False,
        )  # fmt: skip
        trainer.fit(Surrogate(FCNN(scene, width=4), MSE(), scene), datamodule=module)
        return trainer

    return fitted


def test_the_rates_of_an_epoch_are_there_at_its_end(online):
    module = online(reuse=2)
    assert module.rates is None
    list(module.train_dataloader())
    assert isinstance(module.rates, StreamRates)
    assert module.rates.uses == pytest.approx(12 / 12)
    assert module.rates.buffer == 12


def test_a_trained_stream_leaves_whole_shards(saving, fitted, tmp_path):
    fitted(saving(batches=16), epochs=2)
    assert names(tmp_path / "d") == ["train-000000.safetensors", "train-000064.safetensors"]


def test_training_takes_no_more_samples_than_it_uses(online, fitted):
    module = online()
    trainer = fitted(module, epochs=2)
    assert trainer.global_step == 6
    assert module.state_dict() == {"next_index": 24}


def test_hard_examples_are_found_during_training(online, fitted):
    module = online(hard_example_fraction=0.5, batches=8, reuse=2, new_per_round=4)
    fitted(module, epochs=2)
    worst = module._replay.stream.hard_examples
    assert int(worst.count) > 0
    assert ((worst.points[: int(worst.count)] >= 0) & (worst.points[: int(worst.count)] < 1)).all()


def test_a_stream_does_not_raise_the_number_of_threads(online):
    """A limit such as OMP_NUM_THREADS=1 is kept."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    online().train_dataloader()
    after = torch.get_num_threads()
    torch.set_num_threads(before)
    assert after == 1


def test_the_stream_has_the_seed_of_the_training_split(online):
    stream = online().train_dataloader().stream
    assert stream.seed == (0, 0)
    truth = solve_load(stream.scene, LoadKey((0, 0), 0))
    one = next(iter(stream))
    assert torch.equal(one.sample.displacement, torch.from_numpy(truth.displacement))
