"""Numbers out of range are refused in one line that names them, before anything is written."""

import pytest

from dpl.data import DataModule, DataSet, Growing, Stored, Stream

INVALID = [
    *((DataSet, {name: -1}) for name in ("seed", "train", "val", "test", "workers", "shard")),
    *((DataSet, {"timeout": value}) for value in (0, -1.0, float("nan"))),
    *((DataSet, {"shards": count, "shard": 0}) for count in (0, -1)),
    *((DataSet, {"shard": shard, "shards": 2}) for shard in (-1, 2)),
    *((DataModule, {name: 0}) for name in ("val", "test", "batch_size")),
    *((DataModule, {name: -1}) for name in ("workers", "seed", "shuffle_seed", "train")),
    *((DataModule, {"timeout": 0.0}), (DataModule, {"train": Stored(-1)})),
    (DataModule, {"batch_size": 17, "train": Stream(capacity=8, reuse=2)}),
    *((Stream, {name: 0}) for name in ("batches", "new_per_round", "reuse")),
    (Stream, {"capacity": 7}),
    *((Growing, {"error": value}) for value in (0, -1.0, float("nan"), float("inf"))),
    *((Growing, {"minutes": 0.0}), (Growing, {"max_train": 0})),
]


@pytest.mark.parametrize(
    ("kind", "options"), INVALID, ids=lambda one: getattr(one, "__name__", None) or ",".join(one)
)
def test_numbers_out_of_range_are_refused_by_name(scene, tmp_path, kind, options):
    name = next(iter(options))
    place = (scene,) if kind in (DataSet, DataModule) else ()
    more = {"folder": str(tmp_path / "d")} if place else {}
    with pytest.raises(ValueError, match=f"{name} = ") as refusal:
        kind(*place, **more, **options)
    assert "\n" not in str(refusal.value)
    assert not list(tmp_path.iterdir())


def test_the_smallest_buffer_that_makes_a_batch_is_accepted(scene):
    source = Stream(capacity=8, reuse=2, new_per_round=3, batches=2)
    options = {"val": 1, "test": 1, "batch_size": 16, "workers": 0}
    assert len(list(DataModule(scene, train=source, **options).train_dataloader())) == 2
