"""Laws of files: writes are atomic, and a folder has one writer."""

import errno
import fcntl
import io
import os
import resource
import signal
import socket
import subprocess
import sys
import tracemalloc
import zipfile
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from dpl import DataSetError
from dpl.system import files
from dpl.system.files import append_jsonl, atomic_write, exclusive_lock, read_array, read_jsonl

WRITER = """
import sys, time
from pathlib import Path
from dpl.system.files import exclusive_lock
with exclusive_lock(Path(sys.argv[1])):
    print("writing", flush=True)
    time.sleep(600)
"""


@contextmanager
def largest_file(size):
    """Limit the size of the files of this process, as on a full disk [bytes]."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# ------------------------------------------------------------------ whole files


@pytest.mark.parametrize("sync", [True, False])
def test_a_file_is_written_whole_or_not_at_all(tmp_path, sync):
    path = tmp_path / "file"
    path.write_bytes(b"old")

    def write_and_fail():
        with atomic_write(path, sync=sync) as file:
            file.write(b"new")
            file.flush()
            assert path.read_bytes() == b"old"
            raise OSError("no space left")

    with pytest.raises(OSError, match="no space"):
        write_and_fail()
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["file"]
    with atomic_write(path, sync=sync) as file:
        file.write(b"new")
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == ["file"]


def test_a_file_that_exceeds_the_disk_leaves_nothing(tmp_path):
    def write():
        with atomic_write(tmp_path / "file") as file:
            file.write(bytes(5000))

    with largest_file(1000), pytest.raises(OSError, match="too large") as full:
        write()
    assert full.value.errno == errno.EFBIG
    assert names(tmp_path) == []


# ------------------------------------------------------------------ arrays


def header(*shape):
    """Return the header of a .npy file of an array of this shape."""
    file = io.BytesIO()
    form = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, form)
    return file.getvalue()


def pack(path, content, kind=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", kind) as archive:
        archive.writestr("array.npy", content)


HARMFUL = {  # name of a file -> how it is made, what the message says
    "pipe.npy": (os.mkfifo, "a regular file"),
    "pipe.npz": (os.mkfifo, "a regular file"),
    "zeros.npy": (lambda path: path.symlink_to("/dev/zero"), "a regular file"),
    "folder.npy": (Path.mkdir, "directory"),
    "sparse.npy": (lambda path: path.touch() or os.truncate(path, 10**9), "at most 1,000,000"),
    "empty.npy": (Path.touch, "expected 8 bytes"),
    "claims.npy": (lambda path: path.write_bytes(header(10**9, 4, 2)), "damaged: 0 bytes"),
    "claims.npz": (lambda path: pack(path, header(10**9, 4, 2)), "damaged: 0 bytes"),
    "nested.npy": (
        lambda path: path.write_bytes(b"\x93NUMPY\1\0\xe8\3" + b"(" * 1000),
        "is damaged",
    ),
    "unfolds.npz": (lambda path: pack(path, header(200_000, 4, 2) + bytes(12_800_000)), "at most"),
    "other.npz": (lambda path: pack(path, header(1, 4, 2) + bytes(64), zipfile.ZIP_LZMA), "savez"),
    "none.npz": (lambda path: np.savez(path), "has 0: none"),
    "two.npz": (lambda path: np.savez(path, a=np.ones(1), b=np.ones(1)), "has 2: a, b"),
    "damaged.npz": (lambda path: path.write_bytes(b"PK\x03\x04 damaged"), "zip"),
}


@pytest.fixture
def traced():
    """Traces the memory of a test."""
    tracemalloc.start()
    yield
    tracemalloc.stop()


@pytest.mark.parametrize("name", HARMFUL)
def test_files_that_would_block_or_fill_the_memory_are_refused_before_they_are_read(
    name, tmp_path, monkeypatch, traced
):
    monkeypatch.setattr(files, "MAX_ARRAY_SIZE", 1_000_000)
    path, (make, message) = tmp_path / name, HARMFUL[name]
    make(path)
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    with pytest.raises((OSError, ValueError), match=message):
        read_array(path, (4, 2))
    assert tracemalloc.get_traced_memory()[1] - before < 500_000


@pytest.mark.parametrize("kind", ["whole.npy", "columns.npy", "packed.npz"])
def test_arrays_are_read_as_numpy_writes_them(kind, tmp_path):
    array = np.arange(1, 17).reshape(2, 4, 2)
    given = np.asfortranarray(array, dtype=np.float32) if kind == "columns.npy" else array
    save = np.savez_compressed if kind == "packed.npz" else np.save
    save(tmp_path / kind, given)
    found = read_array(tmp_path / kind, (4, 2))
    assert found.dtype == np.float64
    assert np.array_equal(found, array)


# ------------------------------------------------------------------ lines


@pytest.mark.parametrize("torn", [b'{"k": 1, "l', b"{", b'{"name": "\xc3', b"\x00\x00"])
def test_an_incomplete_line_is_left_out_and_the_next_one_is_read(tmp_path, torn):
    path = tmp_path / "lines"
    assert read_jsonl(path) == []
    append_jsonl(path, {"k": 0})
    assert path.read_bytes() == b'{"k": 0}\n'
    with path.open("ab") as file:
        file.write(torn)
    assert read_jsonl(path) == [{"k": 0}]
    append_jsonl(path, {"k": 2})
    append_jsonl(path, {"k": 3})
    assert read_jsonl(path) == [{"k": 0}, {"k": 2}, {"k": 3}]


def test_lines_that_are_no_objects_or_too_deep_are_left_out(tmp_path):
    path = tmp_path / "lines"
    path.write_text('{"k": 0}\n1\n[]\nnull\n"text"\n' + "[" * 99_999 + '\n{"k": 1}\n')
    assert read_jsonl(path) == [{"k": 0}, {"k": 1}]


def test_a_line_that_exceeds_the_disk_does_not_damage_others(tmp_path):
    path = tmp_path / "lines"
    append_jsonl(path, {"k": 0})
    most = path.stat().st_size + 20
    with largest_file(most), pytest.raises(OSError, match="too large"):
        append_jsonl(path, {"text": 100 * "x"})
    append_jsonl(path, {"k": 1})
    assert read_jsonl(path) == [{"k": 0}, {"k": 1}]


# ------------------------------------------------------------------ one writer


def held(folder, *part):
    """Return True if the lock of a part cannot be obtained."""
    try:
        with exclusive_lock(folder, *part):
            return False
    except DataSetError:
        return True


def test_a_second_writer_is_refused_naming_process_and_machine(tmp_path):
    with exclusive_lock(tmp_path), pytest.raises(DataSetError) as refusal, exclusive_lock(tmp_path):
        pass
    reported = str(refusal.value)
    assert f"process {os.getpid()} on {socket.gethostname()}" in reported
    assert str(tmp_path) in reported
    assert str(DataSetError("a\nb")) == "a b", "one line"


def test_a_lock_is_released_when_its_writer_ends_or_raises(tmp_path):
    with exclusive_lock(tmp_path):
        assert held(tmp_path)
        assert held(tmp_path), "a refused writer does not release it"
    with pytest.raises(RuntimeError), exclusive_lock(tmp_path):
        raise RuntimeError
    assert not held(tmp_path)
    assert not list(tmp_path.glob(".writer-*"))


@pytest.mark.parametrize(
    ("mine", "other", "refused"),
    [
        ((0, 2), (1, 2), False),
        ((0, 2), (0, 2), True),
        ((1, 4), (3, 4), False),
        ((0, 1), (1, 2), True),
        ((1, 2), (0, 1), True),
        ((0, 2), (1, 3), True),
    ],
)
def test_writers_exclude_each_other_unless_they_are_different_parts_of_one_division(
    tmp_path, mine, other, refused
):
    with exclusive_lock(tmp_path, *mine):
        assert held(tmp_path, *other) == refused
    assert not held(tmp_path, *other)


def test_a_killed_writer_holds_no_lock(tmp_path, environment):
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, env=environment()
    )
    try:
        assert writer.stdout.readline() == b"writing\n"
        refused = pytest.raises(DataSetError, match=f"process {writer.pid} on ")
        with refused, exclusive_lock(tmp_path):
            pass
    finally:
        writer.send_signal(signal.SIGKILL)
        writer.communicate()
    assert list(tmp_path.glob(".writer-*")), "a killed process removes nothing"
    assert not held(tmp_path)
    assert not held(tmp_path, 1, 2)


def test_irregular_files_are_neither_read_nor_extended(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "outside").write_text("mine\n")
    (tmp_path / "link").symlink_to("outside")
    for name in ("folder", "link"):
        for use in (read_jsonl, lambda path: append_jsonl(path, {"k": 0})):
            with pytest.raises(DataSetError, match=f"{name} is not a regular file"):
                use(tmp_path / name)
    assert (tmp_path / "outside").read_text() == "mine\n"


def test_a_writer_may_end_while_its_lock_is_read(tmp_path, monkeypatch):
    path = tmp_path / ".writer-0-1"
    real = fcntl.flock

    def flock(file, how):
        try:
            real(file, how)
        except BlockingIOError:
            path.unlink()  # which its holder does first, then it lets go
            raise

    with path.open("w") as holder:
        real(holder, fcntl.LOCK_EX)
        monkeypatch.setattr(files.fcntl, "flock", flock)
        assert held(tmp_path) in (True, False)
