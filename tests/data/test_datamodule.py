"""Laws of the data modules: batches, their order, and which loads are solved or read."""

import functools
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dpl import Sample
from dpl.data import DataModule, Stream
from dpl.fem import symmetries

SIZES = {"val": 4, "test": 4, "workers": 0, "batch_size": 4}
STREAM = {"batches": 3, "new_per_round": 4, "reuse": 1, "capacity": 64}


@pytest.fixture
def offline(scene, folder, data):
    """Return a function that builds data modules of the tiny data set."""

    def offline(**options):
        return DataModule(scene, folder=str(folder), **{"train": 12, **SIZES, **options})

    return offline


@pytest.fixture
def online(scene, folder, data):
    """Return a function that builds streams; they validate on the tiny data set and are closed."""
    made = []

    def online(*, path=folder, **options):
        source = {name: options.pop(name, value) for name, value in STREAM.items()}
        options = {**SIZES, **options}
        made.append(DataModule(scene, folder=str(path), train=Stream(**source), **options))
        return made[-1]

    yield online
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
    assert all(column.dtype == torch.float64 for column in batches[0])


@pytest.mark.parametrize("symmetry", [False, True])
def test_batches_are_a_function_of_shuffle_and_epoch(offline, symmetry):
    offline = functools.partial(offline, symmetry=symmetry)
    first = order(offline(shuffle_seed=3), epoch=2)
    assert order(offline(shuffle_seed=3), epoch=2) == first
    assert order(offline(shuffle_seed=3), epoch=3) != first
    assert order(offline(shuffle_seed=4), epoch=2) != first
    assert sorted(order(offline(shuffle_seed=4), epoch=0)) == sorted(first)


def test_forces_and_displacements_stay_together(offline):
    module = offline(symmetry=True)
    truth = module.samples("train")
    pairs = dict(zip(forces([truth]), truth.displacement, strict=True))
    for batch in module.train_dataloader():
        for force, displacement in zip(batch.force, batch.displacement, strict=True):
            if (key := force.numpy().tobytes()) in pairs:
                assert torch.equal(pairs.pop(key), displacement)
    assert not pairs


def test_splits_are_disjoint(offline):
    module = offline()
    splits = [set(forces([module.samples(split)])) for split in ("train", "val", "test")]
    assert [len(split) for split in splits] == [12, 4, 4]
    assert len(set.union(*splits)) == 20


def test_a_batch_is_a_copy(offline):
    """A training step may change its batch in place."""
    module = offline(symmetry=True)
    before = module.samples("train").force.clone()
    for batch in module.train_dataloader():
        batch.force.zero_()
    assert torch.equal(module.samples("train").force, before)


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
    module = DataModule(scene, folder=str(folder), train=12, symmetry=True, **SIZES)
    samples = module.samples("train")
    norms = samples.force.flatten(1).norm(dim=1)
    for batch in module.train_dataloader():
        found = (batch.force.flatten(1).norm(dim=1)[:, None] - norms).abs().argmin(dim=1)
        assert torch.equal(batch.young, samples.young[found])


def test_validation_and_test_keep_their_order_and_have_no_images(offline, online):
    for module in (offline(symmetry=True, batch_size=3), offline(), online()):
        assert forces(module.val_dataloader()) == forces([offline().samples("val")])
        assert forces(module.test_dataloader()) == forces([offline().samples("test")])


def test_a_force_in_every_load_breaks_the_symmetries_that_turn_it(make_scene, tmp_path):
    scene = make_scene()
    down = torch.zeros(scene.problem.shape, dtype=torch.float64)
    down[:, 2] = torch.where(scene.loads.loadable_dofs[:, 2], -1e-7, 0.0)
    weighted = make_scene(constant_force=down)
    free = DataModule(scene, folder=str(tmp_path), symmetry=True, **SIZES)
    held = DataModule(weighted, folder=str(tmp_path), symmetry=True, **SIZES)
    assert 1 < len(held.group) < len(free.group)
    assert all(torch.equal(one.image(down), down) for one in held.group)


def test_a_stream_yields_images_under_symmetries(online, scene):
    module = online(symmetry=True, batch_size=12, new_per_round=12, batches=4, capacity=1000)
    assert [line for line in module.skipped_work() if "samples of each load" in line]
    batches = list(module.train_dataloader())
    own = set(drawn(scene, module.source._replay.produced))
    assert len(set(forces(batches)) - own) > 24, "seven of eight are images"
    for batch in batches:
        ratio = scene.problem.relative_residual(batch.displacement, batch.force)
        assert ratio.max() < scene.solver.tol


# ------------------------------------------------------------------ several training processes


@pytest.mark.parametrize("symmetry", [False, True])
def test_two_processes_see_disjoint_halves_of_the_samples(offline, symmetry):
    whole = order(offline(symmetry=symmetry), 0)
    for epoch in (0, 1):
        modules = [placed(offline(shuffle_seed=1, symmetry=symmetry), k, 2) for k in (0, 1)]
        halves = [order(module, epoch) for module in modules]
        assert [len(half) for half in halves] == [len(whole) / 2] * 2
        assert sorted(halves[0] + halves[1]) == sorted(whole)


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


def test_the_stream_solves_the_loads_that_the_data_set_would_hold(online, offline):
    options = {"batches": 10, "batch_size": 12, "new_per_round": 12, "reuse": 20}
    batches = list(online(**options).train_dataloader())
    assert set(forces(batches)) == set(forces([offline().samples("train")]))


def test_a_stream_writes_no_training_load(online, tmp_path, solved):
    module = online(path=tmp_path / "d", val=2, test=3)
    module.prepare_data()
    assert sorted(solved) == [(1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]
    before = sorted((tmp_path / "d").rglob("*"))
    list(module.train_dataloader())
    assert sorted((tmp_path / "d").rglob("*")) == before


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


def test_a_resumed_stream_draws_no_load_twice_where_some_are_rejected(online, solves):
    solves(lambda one: one._replace(accepted=one.job.number % 3 == 1))
    module = online()
    first = set(forces(module.train_dataloader()))
    resumed = online()
    resumed.load_state_dict(module.state_dict())
    assert not first & set(forces(resumed.train_dataloader()))


def test_rejected_loads_with_nan_do_not_reach_training(online, solves):
    def change(one):
        bad = one._replace(accepted=False, reason="x", displacement=np.nan * one.displacement)
        return bad if one.job.number % 2 else one

    solves(change)
    for batch in online().train_dataloader():
        assert all(torch.isfinite(column).all() for column in batch)


def test_a_stream_does_not_raise_the_number_of_threads(online):
    """A limit such as OMP_NUM_THREADS=1 is kept."""
    torch.set_num_threads(1)
    online().train_dataloader()
    assert torch.get_num_threads() == 1
