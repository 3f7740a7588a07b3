"""Shards: solved loads as columns of a safetensors file; forces are stored at loaded nodes only.

Files of one load and of many have the same columns, so that files are merged by concatenation. The
metadata of a file hold the SHA-256 of its name and its columns.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from dpl.data.solving.solve import SolvedLoad

Columns = dict[str, Tensor]

TRIED = ("tried", "amplitude", "iterations", "load_factor")  # columns with a row for each load
REASON = 64  # bytes of a row of the column `reason`, one for each rejected load
DESCRIPTION = (*TRIED, "index", "reason")  # columns that are read alone
FINITE = {"amplitude", "point", "nodal_force", "displacement", "parameters"}
SOLUTIONS = (  # columns with a row for each accepted load, or for each of its loaded nodes
    *("index", "point", "n_loaded_nodes", "node", "nodal_force"),
    *("displacement", "residual", "volume_ratio", "parameters"),
)
INTEGERS = dict.fromkeys(("tried", "index", "n_loaded_nodes", "iterations"), torch.int64)
INTEGERS |= {"node": torch.int32, "reason": torch.uint8}
MAX_INTEGER = 2**53


def encode_load(solved: SolvedLoad, parameters: Tensor) -> Columns:
    """Return the columns of one load with its parameters (1, P)."""
    number = torch.tensor([solved.job.number])
    solution = {
        "index": number,
        "point": torch.from_numpy(solved.point)[None],
        **to_sparse(torch.from_numpy(solved.force)[None]),
        "displacement": torch.from_numpy(solved.displacement)[None],
        "residual": torch.tensor([solved.residual], dtype=torch.float64),
        "volume_ratio": torch.tensor([solved.volume_ratio], dtype=torch.float64),
        "parameters": parameters.contiguous(),
    }
    reason = list(solved.reason.encode()[:REASON].ljust(REASON))
    return {
        "tried": number,
        "amplitude": torch.tensor([round(solved.amplitude, 6)], dtype=torch.float64),
        "iterations": torch.tensor([solved.iterations]),
        "load_factor": torch.tensor([solved.load_factor], dtype=torch.float64),
        **{name: c if solved.accepted else c[:0] for name, c in solution.items()},
        "reason": torch.tensor([reason], dtype=torch.uint8)[int(solved.accepted) :],
    }


def reasons(columns: Columns) -> list[str]:
    """Return why each rejected load was rejected."""
    return [bytes(row).decode(errors="replace").rstrip() for row in columns["reason"].tolist()]


def single_loads(columns: Columns) -> dict[int, Columns]:
    """Return the columns of each load alone, by the number of the load."""
    tried, nodes = columns["tried"], columns["n_loaded_nodes"]
    accepted = torch.isin(tried, columns["index"])
    loaded = torch.zeros_like(tried).masked_scatter(accepted, nodes)
    rows = dict.fromkeys(SOLUTIONS, accepted.long()) | dict.fromkeys(TRIED, torch.ones_like(tried))
    rows |= {"node": loaded, "nodal_force": loaded, "reason": (~accepted).long()}
    parts = {name: column.split(rows[name].tolist()) for name, column in columns.items()}
    return {
        number: {name: part[k] for name, part in parts.items()}
        for k, number in enumerate(tried.tolist())
    }


def encode_shard(name: str, loads: Iterable[Columns]) -> bytes:
    """Return the content of a file of this name with some loads."""
    loads = list(loads)
    columns = {key: torch.cat([load[key] for load in loads]) for key in loads[0]}
    return save(columns, {"sha256": digest(name, columns)})


def digest(name: str, columns: Columns) -> str:
    """Return the SHA-256 of the name of a shard and of its columns, in hexadecimal."""
    found = hashlib.sha256(name.encode())
    for key, column in sorted(columns.items()):
        found.update(f" {key} {column.dtype} {tuple(column.shape)} ".encode())
        found.update(column.numpy().tobytes())
    return found.hexdigest()


def read_shard(
    path: Path, shape: Sequence[int] | None = None, dimension: int = 0, n_parameters: int = 0
) -> Columns:
    """Return the columns of a shard; without `shape` those of `DESCRIPTION`, digest unchecked.

    `shape` is (N, D). A load is drawn from a point with `dimension` coordinates.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: A column is missing or has a wrong shape, type or value, or the digest is wrong.
            The message continues a sentence that starts with the name of the file.
    """
    names = DESCRIPTION if shape is None else (*TRIED, *SOLUTIONS, "reason")
    try:
        with safe_open(path, "pt") as file:
            # copied, because the memory of the tensors is that of the file
            columns = {name: file.get_tensor(name).clone() for name in names}
            stored = (file.metadata() or {}).get("sha256")
        flaw = _flaw(columns, shape, dimension, n_parameters)
        if shape is not None and not flaw and stored != digest(path.name, columns):
            flaw = "the SHA-256 of its name and its columns is wrong"
    except (SafetensorError, KeyError, TypeError, RuntimeError) as error:
        path.stat()  # raises a FileNotFoundError if it has been removed meanwhile
        flaw = str(error)
    if flaw:
        raise ValueError(f"is damaged: {flaw}")
    return columns


def _flaw(columns: Columns, shape: Sequence[int] | None, dimension: int, n_parameters: int) -> str:
    """Return the first flaw of the columns that `read_shard` reads; empty without one."""
    count, accepted = len(columns["tried"]), len(columns["index"])
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(TRIED, (count,))
    shapes |= {"index": (accepted,), "reason": (count - accepted, REASON)}
    if shape is not None:
        loaded = int(columns["n_loaded_nodes"].long().sum())
        shapes |= dict.fromkeys(("residual", "volume_ratio", "n_loaded_nodes"), (accepted,))
        shapes |= {"point": (accepted, dimension), "parameters": (accepted, n_parameters)}
        shapes |= {"node": (loaded,), "nodal_force": (loaded, shape[1])}
        shapes |= {"displacement": (accepted, *shape)}
    for name, expected in shapes.items():
        column = columns[name]
        if (tuple(column.shape), column.dtype) != (expected, INTEGERS.get(name, torch.float64)):
            return f"{name} has shape and type {tuple(column.shape)}, {column.dtype}"
        if name in FINITE and not column.isfinite().all():
            return f"{name} is not finite"
    tried, index = columns["tried"], columns["index"]
    if not count or (tried.diff() <= 0).any() or not 0 <= tried[0] <= tried[-1] < MAX_INTEGER:
        return "the numbers of its loads are not ascending"
    if (index.diff() <= 0).any() or not torch.isin(index, tried).all():
        return "an accepted load was not tried"
    spans = {"iterations": MAX_INTEGER, "amplitude": math.inf}
    if shape is not None:
        spans |= {"n_loaded_nodes": shape[0] + 1, "node": shape[0]}
    for name, end in spans.items():
        if not ((columns[name] >= 0) & (columns[name] < end)).all():
            return f"{name} is out of range"
    return ""


def to_sparse(force: Tensor) -> Columns:
    """Return forces (B, N, D) as numbers of loaded nodes (B,), their numbers and their forces."""
    loaded = force.ne(0).any(dim=-1)
    return {
        "n_loaded_nodes": loaded.sum(dim=1),
        "node": loaded.nonzero()[:, 1].to(torch.int32),
        "nodal_force": force[loaded],
    }


def to_dense(shard: Mapping[str, Tensor], shape: Sequence[int]) -> Tensor:
    """Return the forces (B, N, D) of the columns that `to_sparse` returns, shape = (N, D)."""
    count = shard["n_loaded_nodes"]
    force = torch.zeros(len(count), *shape, dtype=torch.float64)
    row = torch.repeat_interleave(torch.arange(len(count)), count)
    force[row, shard["node"].long()] = shard["nodal_force"]
    return force
