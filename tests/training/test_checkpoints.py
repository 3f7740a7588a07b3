"""Checkpoints are written atomically, read unchanged, and executed never."""

import contextlib
import io
import json
import os
import pickle
import zipfile
from functools import partial
from math import inf, nan

import lightning as L
import pytest
import torch
from safetensors.torch import save_file

from dpl.training import AtomicCheckpointIO, BestWeights
from dpl.training.checkpoints import epochs, read, write

WEIGHTS = {"net.a": torch.arange(6.0).reshape(2, 3), "scale": torch.tensor(2.0).double()}
CHECKPOINT = {
    "state_dict": WEIGHTS,
    "scene": "0f",
    "identity": {"mesh": {"nodes": 9}},
    "epoch": 3,
    "global_step": 12,
    "random": {"python": (3, (1, 2), None)},
}


class Unwritable:
    """An object whose pickling fails half way, like a write to a full disk."""

    def __reduce__(self):
        raise OSError("no space left on device")


class Harm:
    """An object that executes a command when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("name", ["best.safetensors", "last.ckpt"])
def test_reading_a_checkpoint_returns_what_was_written(tmp_path, name):
    write(CHECKPOINT, tmp_path / "folder" / name)
    found = read(tmp_path / "folder" / name)
    for key, tensor in WEIGHTS.items():
        assert torch.equal(found["state_dict"][key], tensor)
        assert found["state_dict"][key].dtype == tensor.dtype
    kept = CHECKPOINT.keys() - ({"random"} if name.startswith("best") else set())
    assert found.keys() == kept
    assert all(found[key] == CHECKPOINT[key] for key in kept - {"state_dict"})


def test_weights_that_are_views_of_others_are_written(tmp_path):
    state = {"whole": WEIGHTS["net.a"].T, "part": WEIGHTS["net.a"].T[0]}
    write({**CHECKPOINT, "state_dict": state}, tmp_path / "best.safetensors")
    found = read(tmp_path / "best.safetensors")["state_dict"]
    assert all(torch.equal(found[key], state[key]) for key in state)


def test_lightning_writes_and_reads_with_the_plugin(tmp_path):
    files = AtomicCheckpointIO()
    files.save_checkpoint(CHECKPOINT, str(tmp_path / "last.ckpt"))
    assert files.load_checkpoint(str(tmp_path / "last.ckpt"))["epoch"] == 3
    (tmp_path / "last.ckpt").write_bytes(b"hello")
    with pytest.raises(ValueError, match=r"last\.ckpt"):
        files.load_checkpoint(tmp_path / "last.ckpt")


def test_a_checkpoint_that_cannot_be_written_leaves_the_old_one(tmp_path):
    path = tmp_path / "folder" / "last.ckpt"
    write(CHECKPOINT, path)
    with pytest.raises(OSError, match="no space"):
        write({"big": torch.zeros(10_000), "bad": Unwritable()}, path)
    assert read(path)["epoch"] == 3
    assert [p.name for p in path.parent.iterdir()] == ["last.ckpt"]
    write({**CHECKPOINT, "epoch": 4}, path)
    assert read(path)["epoch"] == 4


def test_reading_executes_no_code_of_a_pickle(tmp_path):
    """The error gives no advice to disable `weights_only`."""
    path, harm = tmp_path / "last.ckpt", tmp_path / "harm"
    for save, words in (
        (torch.save, "contains objects other than tensors and plain data"),
        (lambda value, path: path.write_bytes(pickle.dumps(value)), "."),
    ):
        save({**CHECKPOINT, "more": Harm(harm)}, path)
        with pytest.raises(ValueError, match=words) as refusal:
            read(path)
        assert "weights_only" not in str(refusal.value)
        assert "\n" not in str(refusal.value)
    assert not harm.exists()


def test_a_compressed_checkpoint_raises_an_error(tmp_path):
    path, content = tmp_path / "last.ckpt", io.BytesIO()
    torch.save({**CHECKPOINT, "zeros": torch.zeros(1_000_000)}, content)
    with (
        zipfile.ZipFile(content) as source,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for member in source.infolist():
            packed.writestr(member.filename, source.read(member))
    assert path.stat().st_size < 100_000
    with pytest.raises(ValueError, match="unpacks to"):
        read(path)


def truncated(path, end):
    write(CHECKPOINT, path)
    path.write_bytes(path.read_bytes()[:end])


def with_header(path, header):
    save_file(WEIGHTS, path, header)


DAMAGED = "is damaged or not a checkpoint: ."
BROKEN = [  # name, how it is written, part of the message
    *(
        ("last.ckpt", partial(truncated, end=end), DAMAGED)
        for end in (0, 1, 10, 200, 1000, -1, -100)
    ),
    *(
        ("last.ckpt", partial(torch.save, value), "contains no weights")
        for value in ([], {"state_dict": 1}, {"weights": {}})
    ),
    *(
        ("best.safetensors", partial(with_header, header=header), ".")
        for header in (None, {"dpl": "1"}, {"dpl": "{"}, {"other": "{}"})
    ),
    (
        "best.safetensors",
        lambda path: path.write_bytes((2**62).to_bytes(8, "little") + b"{}"),  # beyond its end
        ".",
    ),
]


@pytest.mark.parametrize(("name", "make", "words"), BROKEN)
def test_a_broken_checkpoint_raises_an_error_of_one_line(tmp_path, name, make, words):
    make(tmp_path / name)
    with pytest.raises(ValueError, match=words) as refusal:
        read(tmp_path / name)
    assert "\n" not in str(refusal.value)


def test_epochs_counts_finished_epochs_and_needs_the_optimizer_state():
    whole = {
        **CHECKPOINT,
        "loops": {},
        "callbacks": {},
        "optimizer_states": [],
        "lr_schedulers": [],
    }
    assert epochs(whole) == 4
    with pytest.raises(ValueError, match="contains no loops, optimizer_states; resume"):
        epochs({k: v for k, v in whole.items() if k not in ("loops", "optimizer_states")})
    with pytest.raises(ValueError, match="has epoch = 'three'"):
        epochs({**whole, "epoch": "three"})


def test_an_error_that_is_not_finite_is_never_the_best(tmp_path):
    best = BestWeights(dirpath=tmp_path, filename="best", monitor="val/e_mean")
    trainer = L.Trainer(logger=False, callbacks=[best], accelerator="cpu")
    requested = [best.check_monitor_top_k(trainer, torch.tensor(e)) for e in (nan, inf, -inf, 0.5)]
    assert requested == [False, False, False, True]


@pytest.mark.parametrize("with_files", [True, False])
def test_a_moved_folder_keeps_the_best_error_with_its_files(tmp_path, with_files):
    folders = [tmp_path / "before", tmp_path / "here"]
    before, here = (
        BestWeights(dirpath=folder, filename="best", monitor="val/e_mean") for folder in folders
    )
    path, best = (str(folder / "best.safetensors") for folder in folders)
    error = torch.tensor(0.5)
    before.best_model_path = before.kth_best_model_path = path
    before.best_model_score = before.kth_value = error
    before.best_k_models = {path: error}
    write(CHECKPOINT, folders[with_files] / "best.safetensors")
    with contextlib.nullcontext() if with_files else pytest.warns(UserWarning, match="dirpath"):
        here.load_state_dict(before.state_dict())
    trainer = L.Trainer(logger=False, callbacks=[here], accelerator="cpu")
    assert here.check_monitor_top_k(trainer, torch.tensor(0.6)) is not with_files
    assert here.best_k_models == ({best: error} if with_files else {})


def test_only_known_keys_of_a_header_are_read(tmp_path):
    reported = {"dpl": json.dumps({"scene": "0f", "state_dict": {}, "random": 1})}
    save_file(WEIGHTS, tmp_path / "best.safetensors", reported)
    found = read(tmp_path / "best.safetensors")
    assert found.keys() == {"scene", "state_dict"}
    assert found["state_dict"].keys() == WEIGHTS.keys()
