"""Verification and repair of data sets."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import torch

from dpl.data.storage.shard import Columns, reasons, to_dense
from dpl.data.storage.store import Store
from dpl.scene import Scene
from dpl.system.files import DataSetError, exclusive_lock, sync_folder

# first words of the reasons of loads that failed because of the machine; `repair` retries these
MACHINE_FAILURES = ("timed out", "its worker died")


def verify(store: Store) -> Iterator[tuple[Path, str]]:
    """Yield each file of a data set with its flaw; empty if it has none.

    A shard has no flaw if its digest is right, its loads are those that the scene draws, and each
    displacement is in equilibrium to the tolerance with det F > 0.
    """
    if not store.exists():
        raise DataSetError(f"{store.folder} holds no data set yet; generate it first")
    for path in store.files():
        try:
            stream = store.stream(store.describe(path).split)
            flaw = check_shard(store.scene, stream, store.read(path))
        except FileNotFoundError:  # another writer has merged it
            continue
        except ValueError as error:
            flaw = str(error)
        yield path, flaw


def repair(store: Store) -> list[tuple[Path, str]]:
    """Remove damaged files from a data set; return each with its flaw and the action taken.

    Shards with loads that failed because of the machine are removed as well.
    """
    if not store.exists():
        return []
    with exclusive_lock(store.folder):
        flaws = {path: flaw for path, flaw in verify(store) if flaw}
        for shard in store.shards():
            if any(reason.startswith(MACHINE_FAILURES) for reason in reasons(shard.columns)):
                flaws.setdefault(shard.path, "holds loads that failed because of the machine")
        for path in [*flaws, *store.folder.rglob(".*.part")]:
            if path.is_symlink() or not path.is_dir():
                path.unlink()
            else:
                with contextlib.suppress(OSError):  # a folder of the user that is not empty
                    path.rmdir()
        sync_folder(store.folder)
    return [(path, f"{flaw}; it is removed") for path, flaw in flaws.items()]


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
