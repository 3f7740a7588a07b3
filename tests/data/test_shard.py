"""Laws of shards: decoded loads equal encoded ones, and damaged shards are refused."""

import hashlib

import numpy as np
import pytest
import torch
from safetensors.torch import load, save

from dpl.data.solving.solve import LoadKey, SolvedLoad
from dpl.data.storage import store as store_module
from dpl.data.storage.manifest import entry_of_load, merge_entries
from dpl.data.storage.pending import DIGEST_SIZE, PendingLoads
from dpl.data.storage.shard import concatenate, decode_shard, encode_load, to_dense
from dpl.data.storage.store import runs

SHAPE, DIMENSION = (4, 3), 2


def solved(number, *, nodes=(0, 3), accepted=True):
    """Return a solved load with forces on these nodes."""
    rng = np.random.default_rng(number)
    force = np.zeros(SHAPE)
    force[list(nodes)] = rng.normal(size=(len(nodes), SHAPE[1]))
    return SolvedLoad(
        job=LoadKey((7, 1), number),
        point=rng.random(DIMENSION),
        force=force,
        displacement=rng.normal(size=SHAPE),
        amplitude=0.5 + number,
        accepted=accepted,
        residual=1e-9 * number,
        volume_ratio=0.25 + number,
        load_factor=1.0,
        iterations=3 + number,
        seconds=0.0,
        reason="" if accepted else "diverged",
    )


def content(*loads, n_parameters=0):
    """Return a shard; the parameters are the last coordinates of the points."""
    ratio = lambda one: torch.from_numpy(one.point)[None, DIMENSION - n_parameters :]  # noqa: E731
    return save(concatenate([encode_load(one, ratio(one)) for one in loads]))


def same(columns, one):
    """Return True if the columns are those of a single load, and equal to it."""
    names = ("point", "displacement", "residual", "volume_ratio", "iterations")
    return (
        columns["index"].tolist() == [one.job.number]
        and np.array_equal(to_dense(columns, SHAPE)[0], one.force)
        and all(np.array_equal(columns[name][0], getattr(one, name)) for name in names)
    )


def line(*loads):
    return merge_entries([entry_of_load("val", one) for one in loads])


def test_a_decoded_load_equals_the_encoded_one():
    loads = [solved(5), solved(6, nodes=(0, 1, 2, 3)), solved(7, nodes=())]
    for one in loads:
        assert same(decode_shard(content(one), SHAPE, DIMENSION), one)
    shard = decode_shard(content(*loads), SHAPE, DIMENSION)
    assert np.array_equal(to_dense(shard, SHAPE), np.stack([one.force for one in loads]))
    assert shard["parameters"].shape == (3, 0)
    assert shard["iterations"].tolist() == [8, 9, 10]


def test_a_rejected_load_has_no_rows_and_a_reason_in_the_manifest():
    loads = [solved(5), solved(6, accepted=False), solved(7)]
    shard = decode_shard(content(*loads), SHAPE, DIMENSION)
    assert shard["index"].tolist() == [5, 7]
    assert np.array_equal(to_dense(shard, SHAPE)[1], loads[2].force)
    rejected = {"index": 6, "reason": "diverged", "load_factor": 1.0}
    assert line(*loads)["rejected"] == [rejected]


def test_parameters_are_kept_where_loads_have_their_own():
    loads = [solved(5), solved(6)]
    whole = content(*loads, n_parameters=1)
    points = torch.from_numpy(np.stack([one.point for one in loads]))
    assert torch.equal(decode_shard(whole, SHAPE, DIMENSION, 1)["parameters"], points[:, -1:])
    with pytest.raises(ValueError, match="parameters has shape"):
        decode_shard(whole, SHAPE, DIMENSION, 0)
    with pytest.raises(ValueError, match="parameters has shape"):
        decode_shard(content(*loads), SHAPE, DIMENSION, 1)


def test_a_pending_load_is_a_shard_of_one_load_with_its_line_of_the_manifest(tmp_path):
    pending = PendingLoads(tmp_path / "pending", {"val": (7, 1)}, lambda points: points[:, 2:])
    for one in (solved(3), solved(4, nodes=())):
        entry, columns = pending.read(pending.write(one))
        assert same(columns, one)
        assert entry == line(one)
        assert save(columns) == content(one)
    rejected = solved(5, accepted=False)
    entry, columns = pending.read(pending.write(rejected))
    assert entry == line(rejected)
    assert not any(len(column) for column in columns.values())
    assert list(pending.files()) == [LoadKey((7, 1), k) for k in (3, 4, 5)]


def test_a_pending_load_has_the_split_and_the_number_of_its_file(tmp_path):
    """The line of JSON inside could name a path outside the data set."""
    pending = PendingLoads(tmp_path / "pending", {"val": (7, 1)}, lambda points: points[:, 2:])
    path = pending.write(solved(3))
    content = path.read_bytes()[DIGEST_SIZE:].replace(b'"split": "val"', b'"split": "../val"')
    content = content.replace(b'"first": 3', b'"first": 4')
    path.write_bytes(hashlib.sha256(path.name.encode() + content).digest() + content)
    assert list(pending.files().values()) == [path]
    entry, _ = pending.read(path)
    assert (entry["split"], entry["first"]) == ("val", 3)


def change(name, values):
    columns = load(content(solved(5, nodes=(0, 1, 2, 3)), solved(6)))
    columns[name] = torch.as_tensor(values, dtype=columns[name].dtype)
    return save(columns)


@pytest.mark.parametrize(
    ("name", "values", "sound"),
    [
        *(("node", [0, 1, 2, 3, 0, 3], True), ("node", [0, 1, 2, 3, 0, 4], False)),
        ("node", [0, 1, 2, 3, -1, 3], False),
        *(
            ("n_loaded_nodes", [4, 2], True),
            ("n_loaded_nodes", [2, 4], True),
            ("n_loaded_nodes", [5, 1], False),
        ),
        ("n_loaded_nodes", [7, -1], False),
        *(
            ("n_loaded_nodes", [6, 0], False),
            ("n_loaded_nodes", [3, 2], False),
            ("n_loaded_nodes", [4, 3], False),
        ),
    ],
)
def test_forces_on_nodes_that_do_not_exist_are_refused(name, values, sound):
    if sound:
        shard = decode_shard(change(name, values), SHAPE, DIMENSION)
        assert to_dense(shard, SHAPE).shape == (2, *SHAPE)
        return
    with pytest.raises(ValueError, match="is damaged"):
        decode_shard(change(name, values), SHAPE, DIMENSION)


@pytest.mark.parametrize(
    ("name", "value"),
    [("point", np.nan), ("nodal_force", np.inf), ("displacement", -np.inf)],
)
def test_numbers_of_a_sample_that_are_not_finite_are_refused(name, value):
    columns = load(content(solved(5)))
    columns[name].view(-1)[-1] = value
    with pytest.raises(ValueError, match=f"is damaged: {name} is not finite"):
        decode_shard(save(columns), SHAPE, DIMENSION)


@pytest.mark.parametrize("name", sorted(load(content(solved(5)))))
def test_columns_of_wrong_shape_or_type_are_refused(name):
    genuine = load(content(solved(5), solved(6)))
    column = genuine[name]
    other = torch.int16 if column.dtype != torch.int64 else torch.int32
    for wrong in (column[:-1].clone(), column[None].clone(), column.to(other)):
        with pytest.raises(ValueError, match="is damaged"):
            decode_shard(save(genuine | {name: wrong}), SHAPE, DIMENSION)
    with pytest.raises(ValueError, match="is damaged"):
        decode_shard(
            save({key: value for key, value in genuine.items() if key != name}), SHAPE, DIMENSION
        )


# ------------------------------------------------------------------ shards of a store


@pytest.mark.parametrize(
    ("indices", "expected"),
    [
        ([], []),
        ([0, 1, 2, 3, 4], [[0, 1, 2, 3], [4]]),
        ([2, 3, 5, 8, 9, 10, 11, 12], [[2, 3], [5], [8, 9, 10, 11], [12]]),
    ],
)
def test_a_file_holds_consecutive_loads_of_one_block(monkeypatch, indices, expected):
    monkeypatch.setattr(store_module, "SHARD_SIZE", 4)
    assert list(runs(indices)) == expected


def test_writers_take_blocks_of_loads_in_turn(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(store_module, "SHARD_SIZE", 2)
    store = store_module.Store(tmp_path / "none", scene, 0)
    assert store.missing("train", 9) == list(range(9))
    assert [store.missing("train", 9, k, 3) for k in range(3)] == [[0, 1, 6, 7], [2, 3, 8], [4, 5]]


def test_the_largest_shard_is_one_whose_loads_act_on_every_node(scene):
    store = store_module.Store(None, scene, 0)
    nodes, dim = scene.problem.shape
    every = SolvedLoad(
        *(LoadKey((0, 0), 0), np.zeros(scene.loads.n_random), np.ones((nodes, dim))),
        *(np.ones((nodes, dim)), 1.0, True, 0.0, 1.0, 1.0, 1, 0.0, ""),
    )
    columns = encode_load(every, torch.zeros(1, 0))
    sizes = [len(save(concatenate(count * [columns]))) for count in (1, 2)]
    load_size = store.max_shard_size(2) - store.max_shard_size(1)
    assert sizes[1] - sizes[0] <= load_size <= 2 * (sizes[1] - sizes[0])
    assert store.max_shard_size(0) == store_module.HEADER
