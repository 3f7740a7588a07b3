"""Verification and repair of data sets."""

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors.torch import save
from torch import Tensor

from dpl.data.storage.manifest import (
    STREAMS,
    invalid_lines,
    read_manifest,
    rewrite,
    tried_loads,
)
from dpl.data.storage.shard import Columns, to_dense
from dpl.data.storage.store import MODES, SHARD_SIZE, Store
from dpl.scene import Scene
from dpl.system.files import (
    DataSetError,
    exclusive_lock,
    read_regular_file,
    sync_folder,
    write_file,
)

# first words of the reasons of loads that failed because of the machine; `repair` retries these
MACHINE_FAILURES = ("timed out", "its worker died")
SHARD_NAME = re.compile(rf"({'|'.join(STREAMS)})-(\d{{6,18}})\.safetensors")


class Part(NamedTuple):
    """A file of a data set.

    Attributes:
        file: Name of the file.
        split: Split of its loads; empty if it is not a shard.
        loads: Numbers of its loads.
    """

    file: str
    split: str = ""
    loads: Sequence[int] = ()


def verify(store: Store) -> Iterator[tuple[Part, str]]:
    """Yield each file of a data set with its flaw; empty if it has none.

    A shard has no flaw if its bytes have the digest of the manifest, its loads are those that the
    scene draws, and each displacement is in equilibrium to the tolerance with det F > 0.

    Raises:
        DataSetError: There is no data set.
    """
    if not (store.folder / "scene.json").exists():
        raise DataSetError(f"{store.folder} holds no data set yet; generate it first")
    try:
        flaw = check_modes(store.scene, store.modes())
    except DataSetError as error:
        flaw = f"is damaged: {error}"
    yield Part(MODES), flaw
    for line in store.shards():
        try:
            flaw = check_shard(store.scene, store.stream(line["split"]), store.read_shard(line))
        except ValueError as error:
            flaw = str(error)
        yield _part(line), flaw
    for manifest in store.manifests():
        if invalid := invalid_lines(manifest):
            flaw = f"has {len(invalid)} lines that describe no shard; the first is line "
            yield Part(manifest.name), flaw + "{}, which {}".format(*invalid[0])
    for path in _unnamed_shards(store):
        yield _unnamed_part(store, path), "is named by no manifest"


def repair(store: Store) -> list[tuple[Part, str]]:
    """Remove damaged files from a data set; return each with its flaw and the action taken.

    Shards with loads that failed because of the machine are removed as well.

    Raises:
        DataSetError: Another process writes there.
    """
    if not (store.folder / "scene.json").exists():
        return []
    with exclusive_lock(store.folder):
        flaws = {part: flaw for part, flaw in verify(store) if flaw}
        for line in filter(_failed_by_machine, store.shards()):
            flaws.setdefault(_part(line), "holds loads that failed because of the machine")
        damaged = {part.file for part in flaws}
        if MODES in damaged:
            write_file(store.folder / MODES, save(dict(store.scene.loads.arrays())))
        for manifest in store.manifests():
            lines = [line for line in read_manifest(manifest) if line["file"] not in damaged]
            rewrite(manifest, lines)
        for path in [*_unnamed_shards(store), *store.folder.rglob(".*.part")]:
            if path.is_symlink() or not path.is_dir():
                path.unlink()
            else:
                with contextlib.suppress(OSError):  # a folder of the user that is not empty
                    path.rmdir()
        for path in store.pending.files().values():
            if _failed_by_machine(store.pending.read(path)[0]):
                path.unlink()
        sync_folder(store.folder)
    return [(part, f"{flaw}; {_action(part)}") for part, flaw in flaws.items()]


def _failed_by_machine(line: Mapping[str, Any]) -> bool:
    return any(one["reason"].startswith(MACHINE_FAILURES) for one in line["rejected"])


def _action(part: Part) -> str:
    """Return the action of `repair` for a damaged file."""
    if part.file == MODES:
        return "it is written again"
    if part.file.endswith(".jsonl") and not part.split:
        return "these lines are removed"
    again = f", and its {len(part.loads)} loads are solved again" if part.loads else ""
    return f"it is removed{again}"


def _part(line: Mapping[str, Any]) -> Part:
    return Part(line["file"], line["split"], tried_loads(line))


def _unnamed_shards(store: Store) -> list[Path]:
    """Return the files that could be shards and that no manifest names."""
    named = {MODES, *(Path(line["file"]).name for line in store.shards())}
    return [p for p in sorted(store.folder.glob("*.safetensors")) if p.name not in named]


def _unnamed_part(store: Store, path: Path) -> Part:
    """Return a shard that no manifest names, with the loads that can be read from it."""
    loads: list[int] = []
    if name := SHARD_NAME.fullmatch(path.name):
        with contextlib.suppress(ValueError):  # it is damaged: its loads are unknown
            shard = store.decode(read_regular_file(path, store.max_shard_size(SHARD_SIZE)))
            numbers = range(int(name[2]), int(name[2]) + SHARD_SIZE)
            loads = [number for number in shard["index"].tolist() if number in numbers]
    return Part(path.name, name[1] if name else "", tuple(loads))


def check_modes(scene: Scene, stored: Mapping[str, Tensor]) -> str:
    """Return the flaw of stored modes, whose signs and bases count; empty if there is none."""
    equal = [
        (stored[name].shape, stored[name].dtype) == (array.shape, array.dtype)
        and torch.allclose(stored[name], array, rtol=0, atol=1e-6 * float(array.abs().max()))
        for name, array in scene.loads.arrays().items()
    ]
    return "" if all(equal) else "holds other modes than this scene has"


def check_shard(scene: Scene, stream: tuple[int, int], shard: Columns) -> str:
    """Return the first flaw of a shard of loads with the seed `stream`; empty if there is none."""
    problem, loads = scene.problem, scene.loads
    if not len(shard["index"]):
        return ""
    points = loads.points(stream, shard["index"].tolist())
    if not torch.allclose(shard["point"], points, rtol=0, atol=1e-12):
        return "holds other loads than its seed draws"
    forces, roundoff = to_dense(shard, problem.shape), 1e-9 * loads.largest_force
    if not torch.allclose(forces, loads.loads_at(points).force, rtol=1e-6, atol=roundoff):
        return "holds loads that this scene does not draw"
    parameters = loads.parameters_at(points)
    if not torch.allclose(shard["parameters"], parameters, rtol=0, atol=1e-12):
        return "holds other parameters than its seed draws"
    for k, (u, force) in enumerate(zip(shard["displacement"], forces, strict=True)):
        body = problem.with_parameters(shard["parameters"][k, None])
        internal, volume = body.evaluate(u[None])
        balanced = body.is_equilibrium(u[None], internal, force[None], scene.solver.tol)
        if not (bool(volume > 0) and bool(balanced)):
            return f"holds a displacement that is not in equilibrium: load {int(shard['index'][k])}"
    return ""
