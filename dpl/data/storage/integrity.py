"""What is wrong with a data set, as far as its scene can tell, and making it sound again."""

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors.torch import save
from torch import Tensor

from dpl.data.storage.manifest import STREAMS, lines_of, torn_lines
from dpl.data.storage.store import MODES, SHARD, Store
from dpl.data.storage.writer import rewrite
from dpl.scene import Scene
from dpl.system.files import (
    DataSetError,
    exclusive_lock,
    read_regular_file,
    sync_folder,
    write_file,
)

MACHINE = ("timed out", "its worker died")  # reasons that lie with the machine: `repair` retries
STRAY = re.compile(rf"({'|'.join(STREAMS)})-(\d{{6,18}})\.safetensors")


class Part(NamedTuple):
    """A part of a data set that is sound or not.

    Attributes:
        file: Name of the file.
        split: Split of its loads; empty if it is not a shard.
        loads: Numbers of the loads that it stands for.
    """

    file: str
    split: str = ""
    loads: Sequence[int] = ()


def verify(store: Store) -> Iterator[tuple[Part, str]]:
    """Yield each part of a data set with what is wrong with it; empty if nothing is.

    The parts are the modes, the shards that a manifest names, the manifests with lines that name no
    shard, and the shards that no manifest names. A shard is sound if its bytes are those that were
    written, its loads those that the scene draws, and each displacement balances its load to the
    tolerance, evaluated again, with nothing inverted.

    Raises:
        DataSetError: There is none.
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
            flaw = check_shard(store.scene, store.stream(line["split"]), store.sound(line))
        except ValueError as error:
            flaw = str(error)
        yield _part(line), flaw
    for manifest in store.manifests():
        if torn := torn_lines(manifest):
            number, why = torn[0]
            told = f"has {len(torn)} lines that describe no shard; the first is line {number}, "
            yield Part(manifest.name), f"{told}which {why}"
    for path in _unnamed(store):
        yield _stray(store, path), "is named by no manifest"


def repair(store: Store) -> list[tuple[Part, str]]:
    """Remove what is damaged from a data set; return each part with what was done to it.

    Shards with loads that the machine lost are removed as well. The loads of a removed shard are
    missing from then on.

    Raises:
        DataSetError: Another process writes there.
    """
    if not (store.folder / "scene.json").exists():
        return []
    with exclusive_lock(store.folder):
        flaws = {part: flaw for part, flaw in verify(store) if flaw}
        for line in store.shards():
            if any(one["reason"].startswith(MACHINE) for one in line["rejected"]):
                flaws.setdefault(_part(line), "holds loads that the machine lost")
        poor = {part.file for part in flaws}
        if MODES in poor:
            write_file(store.folder / MODES, save(dict(store.scene.loads.arrays())))
        for manifest in store.manifests():
            rewrite(manifest, [line for line in lines_of(manifest) if line["file"] not in poor])
        for path in [*_unnamed(store), *store.folder.rglob(".*.part")]:
            if path.is_symlink() or not path.is_dir():
                path.unlink()
            else:
                with contextlib.suppress(OSError):  # it is not empty: somebody's own
                    path.rmdir()
        for path in store.pending.files().values():
            if store.pending.get(path).reason.startswith(MACHINE):
                path.unlink()
        sync_folder(store.folder)
    return [(part, f"{flaw}; {_done(store, part)}") for part, flaw in flaws.items()]


def _done(store: Store, part: Part) -> str:
    """Return what `repair` does to a part that is not sound."""
    if part.file == MODES:
        return "it is written again"
    if part.file in {path.name for path in store.manifests()}:
        return "these lines are removed"
    again = f", and its {len(part.loads)} loads are solved again" if part.loads else ""
    return f"it is removed{again}"


def _part(line: Mapping[str, Any]) -> Part:
    numbers = range(line["first"], line["first"] + line["tried"])
    return Part(line["file"], line["split"], numbers)


def _unnamed(store: Store) -> list[Path]:
    """Return the files of the folder that could be shards and that no manifest names."""
    named = {MODES, *(Path(line["file"]).name for line in store.shards())}
    return [p for p in sorted(store.folder.glob("*.safetensors")) if p.name not in named]


def _stray(store: Store, path: Path) -> Part:
    """Return what a file that no manifest names stands for: the loads that can be read in it."""
    loads: list[int] = []
    if name := STRAY.fullmatch(path.name):
        try:
            shard = store.opened(read_regular_file(path, store.largest(SHARD)))
            numbers = range(int(name[2]), int(name[2]) + SHARD)
            loads = [number for number in shard["index"].tolist() if number in numbers]
        except ValueError:  # it is damaged: nobody knows which loads it held
            pass
    return Part(path.name, name[1] if name else "", tuple(loads))


def check_modes(scene: Scene, stored: Mapping[str, Tensor]) -> str:
    """Return what is wrong with stored modes, their signs and bases included; empty if nothing."""
    near = [
        (stored[name].shape, stored[name].dtype) == (array.shape, array.dtype)
        and torch.allclose(stored[name], array, rtol=0, atol=1e-6 * float(array.abs().max()))
        for name, array in scene.loads.arrays().items()
    ]
    return "" if all(near) else "holds other modes than this scene has"


def check_shard(scene: Scene, stream: tuple[int, int], shard: Mapping[str, Tensor]) -> str:
    """Return what is wrong with a shard; empty if nothing is.

    Args:
        scene: What it was made for.
        stream: Seed of its loads.
        shard: What it holds.
    """
    problem, loads = scene.problem, scene.loads
    if not len(shard["index"]):
        return ""
    points = loads.points(stream, shard["index"].tolist())
    if not torch.allclose(shard["point"], points, rtol=0, atol=1e-12):
        return "holds other loads than its seed draws"
    rounding = 1e-9 * loads.largest_force
    if not torch.allclose(shard["force"], loads.loads_at(points).force, rtol=1e-6, atol=rounding):
        return "holds loads that this scene does not draw"
    poisson = loads.poisson_at(points)
    if not torch.allclose(shard["poisson"], poisson, rtol=0, atol=1e-12):
        return "holds other Poisson's ratios than its seed draws"
    for k, (u, force) in enumerate(zip(shard["displacement"], shard["force"], strict=True)):
        body = problem.at(shard["poisson"][k, None])
        internal, volume = body.evaluate(u[None])
        balanced = body.is_equilibrium(u[None], internal, force[None], scene.solver.tol)
        if not (bool(volume > 0) and bool(balanced)):
            return f"holds an answer out of balance: load {int(shard['index'][k])}"
    return ""
