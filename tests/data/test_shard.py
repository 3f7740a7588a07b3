"""Laws of shards: decoded loads equal encoded ones, and damaged shards are refused."""

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save
from set_files import falsify

from dpl.data.solving.solve import LoadKey, SolvedLoad
from dpl.data.storage import store as store_module
from dpl.data.storage.shard import (
    DESCRIPTION,
    encode_load,
    encode_shard,
    read_shard,
    reasons,
    single_loads,
    to_dense,
    to_sparse,
)

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
        load_factor=1.0 if accepted else 0.25,
        iterations=3 + number,
        seconds=0.0,
        reason="" if accepted else "diverged",
    )


def encoded(*loads, n_parameters=0):
    """Return the columns of loads; the parameters are the last coordinates of the points."""
    ratio = lambda one: torch.from_numpy(one.point)[None, DIMENSION - n_parameters :]  # noqa: E731
    return [encode_load(one, ratio(one)) for one in loads]


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a shard of some loads and returns its path."""

    def write(*loads, **options):
        path = tmp_path / "val-000005.safetensors"
        path.write_bytes(encode_shard(path.name, encoded(*loads, **options)))
        return path

    return write


def test_a_shard_holds_its_loads(write):
    loads = [solved(5), solved(6, nodes=()), solved(7, accepted=False), solved(9, nodes=(1,))]
    shard = read_shard(write(*loads), SHAPE, DIMENSION)
    kept = [one for one in loads if one.accepted]
    assert shard["tried"].tolist() == [5, 6, 7, 9]
    assert shard["index"].tolist() == [5, 6, 9]
    assert shard["amplitude"].tolist() == [one.amplitude for one in loads]
    assert shard["iterations"].tolist() == [one.iterations for one in loads]
    assert shard["load_factor"].tolist() == [1.0, 1.0, 0.25, 1.0]
    assert reasons(shard) == ["diverged"]
    for name in ("displacement", "point", "residual", "volume_ratio"):
        assert np.array_equal(shard[name], np.stack([getattr(one, name) for one in kept]))
    assert np.array_equal(to_dense(shard, SHAPE), np.stack([one.force for one in kept]))
    assert shard["parameters"].shape == (3, 0)


def test_the_description_is_a_part_of_the_columns(write):
    path = write(solved(5), solved(6, accepted=False))
    whole, part = read_shard(path, SHAPE, DIMENSION), read_shard(path)
    assert set(part) == set(DESCRIPTION)
    assert all(torch.equal(part[name], whole[name]) for name in part)


def test_loads_that_are_taken_apart_and_merged_give_the_same_bytes(write):
    path = write(solved(5), solved(6, nodes=()), solved(7, accepted=False), solved(8))
    loads = single_loads(read_shard(path, SHAPE, DIMENSION))
    assert list(loads) == [5, 6, 7, 8]
    assert encode_shard(path.name, loads.values()) == path.read_bytes()
    alone = encode_shard(path.name, encoded(solved(8)))
    assert encode_shard(path.name, [loads[8]]) == alone


def test_parameters_are_kept_where_loads_have_their_own(write):
    loads = [solved(5), solved(6)]
    points = torch.from_numpy(np.stack([one.point for one in loads]))
    path = write(*loads, n_parameters=1)
    assert torch.equal(read_shard(path, SHAPE, DIMENSION, 1)["parameters"], points[:, -1:])
    with pytest.raises(ValueError, match="parameters has shape"):
        read_shard(path, SHAPE, DIMENSION, 0)


@pytest.mark.parametrize("shape", [(7, 3), (5, 2)])
def test_forces_are_restored_from_their_sparse_form(shape):
    generator = torch.Generator().manual_seed(0)
    force = torch.randn(6, *shape, generator=generator, dtype=torch.float64)
    force[torch.rand(6, shape[0], generator=generator) < 0.6] = 0.0
    force[0, 2], force[0, 2, 1] = 0.0, 1e-300  # one component of a node is a node that carries
    force[3] = 0.0
    packed = to_sparse(force)
    assert torch.equal(to_dense(packed, shape), force)
    assert len(packed["nodal_force"]) == len(packed["node"]) == packed["n_loaded_nodes"].sum()
    assert packed["n_loaded_nodes"][3] == 0
    assert packed["node"].dtype == torch.int32
    assert packed["nodal_force"].abs().amax(dim=1).min() > 0, "nothing is stored of idle nodes"


POSSIBLE = [
    *(("node", [0, 1, 2, 3, 0, 3]), ("n_loaded_nodes", [4, 2]), ("n_loaded_nodes", [2, 4])),
    *(("iterations", [0, 2**53 - 1]), ("amplitude", [0.0, 1e300]), ("tried", [5, 6])),
]
IMPOSSIBLE = [
    *(("node", values, "node is out of range") for values in ([0, 1, 2, 3, 0, 4], [0, 1, 2, -1])),
    *(("n_loaded_nodes", values, "out of range") for values in ([5, 1], [7, -1], [6, 0])),
    *(("n_loaded_nodes", values, "node has shape") for values in ([3, 2], [4, 3])),
    *(("tried", values, "not ascending") for values in ([6, 5], [5, 5], [-1, 6], [5, 2**53])),
    *(("tried", values, "was not tried") for values in ([5, 7], [4, 6])),
    *(("index", values, "was not tried") for values in ([6, 5], [5, 5], [5, 7])),
    *(("iterations", values, "out of range") for values in ([-1, 0], [0, 2**53])),
    ("amplitude", [-1e-9, 1.0], "amplitude is out of range"),
    *((name, np.nan, "not finite") for name in ("amplitude", "point", "displacement")),
    *((name, np.inf, "not finite") for name in ("nodal_force", "amplitude")),
]


def change(columns, name, values):
    column = columns[name]
    if isinstance(values, float):
        column.view(-1)[-1] = values
    else:
        columns[name] = torch.as_tensor(values, dtype=column.dtype)


def test_possible_numbers_are_read(write):
    for name, values in POSSIBLE:
        path = write(solved(5, nodes=(0, 1, 2, 3)), solved(6))
        falsify(path, lambda columns, pair=(name, values): change(columns, *pair))
        assert to_dense(read_shard(path, SHAPE, DIMENSION), SHAPE).shape == (2, *SHAPE)


@pytest.mark.parametrize(("name", "values", "why"), IMPOSSIBLE)
def test_impossible_numbers_are_refused(write, name, values, why):
    path = write(solved(5, nodes=(0, 1, 2, 3)), solved(6))
    if name == "node" and len(values) == 4:
        values = [*values, 0, 3]
    falsify(path, lambda columns: change(columns, name, values))
    with pytest.raises(ValueError, match=f"is damaged: .*{why}"):
        read_shard(path, SHAPE, DIMENSION)
    if name in DESCRIPTION:
        with pytest.raises(ValueError, match=f"is damaged: .*{why}"):
            read_shard(path)


@pytest.mark.parametrize("name", sorted(encoded(solved(5))[0]))
def test_columns_of_wrong_shape_or_type_are_refused(write, name):
    path = write(solved(5), solved(6), solved(7, accepted=False))
    column = load_file(path)[name]
    other = torch.int16 if column.dtype != torch.int64 else torch.int32
    for wrong in (column[:-1].clone(), column[None].clone(), column.to(other), None):
        columns = load_file(write(solved(5), solved(6), solved(7, accepted=False)))
        columns |= {name: wrong}
        path.write_bytes(save({key: one for key, one in columns.items() if one is not None}))
        falsify(path, lambda columns: None)  # the digest is right
        with pytest.raises(ValueError, match="is damaged"):
            read_shard(path, SHAPE, DIMENSION)


def test_a_shard_under_the_name_of_another_is_refused(write, tmp_path):
    other = write(solved(5)).rename(tmp_path / "val-000006.safetensors")
    with pytest.raises(ValueError, match="SHA-256 of its name and its columns is wrong"):
        read_shard(other, SHAPE, DIMENSION)


# ------------------------------------------------------------------ shards of a store


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
    sizes = [len(encode_shard("name", count * [columns])) for count in (1, 2)]
    load_size = store.max_shard_size(2) - store.max_shard_size(1)
    assert sizes[1] - sizes[0] <= load_size <= 2 * (sizes[1] - sizes[0])
    assert store.max_shard_size(0) == store_module.HEADER
