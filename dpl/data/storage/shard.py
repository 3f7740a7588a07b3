"""Solved loads as columns of a safetensors file; forces are stored at loaded nodes only.

A pending load and a shard have the same columns, so that a shard is the concatenation of the
columns of its loads.
"""

from collections.abc import Mapping, Sequence

import torch
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from dpl.data.solving.solve import SolvedLoad

Columns = dict[str, Tensor]

INTEGERS = dict.fromkeys(("index", "n_loaded_nodes", "iterations"), torch.int64)
INTEGERS["node"] = torch.int32
FINITE = {"point", "nodal_force", "displacement", "parameters"}  # columns of a sample


def encode_load(solved: SolvedLoad, parameters: Tensor) -> Columns:
    """Return the columns of a shard of one load; they have no rows if the load is rejected.

    Args:
        solved: The load.
        parameters: Its parameters, (1, P), see `LoadFamily.parameter_ranges`.
    """
    columns = {
        "index": torch.tensor([solved.job.number]),
        "point": torch.from_numpy(solved.point)[None],
        **to_sparse(torch.from_numpy(solved.force)[None]),
        "displacement": torch.from_numpy(solved.displacement)[None],
        "residual": torch.tensor([solved.residual], dtype=torch.float64),
        "volume_ratio": torch.tensor([solved.volume_ratio], dtype=torch.float64),
        "iterations": torch.tensor([solved.iterations]),
        "parameters": parameters.contiguous(),
    }
    return columns if solved.accepted else {name: c[:0] for name, c in columns.items()}


def concatenate(parts: Sequence[Columns]) -> Columns:
    """Return the columns of several shards as those of one."""
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def decode_shard(
    content: bytes, shape: tuple[int, ...], dimension: int, n_parameters: int = 0
) -> Columns:
    """Return the columns of a shard.

    Args:
        content: Content of the file.
        shape: (N, D).
        dimension: d, number of coordinates of the point that a load is drawn from.
        n_parameters: P, number of parameters of a load.

    Raises:
        ValueError: A column is missing or has a wrong shape, type or value. The message continues
            a sentence that starts with the name of the file.
    """
    try:
        shard = load(content)
        flaw = _flaw_of_columns(shard, shape, dimension, n_parameters)
    except (SafetensorError, KeyError, TypeError, RuntimeError) as error:
        flaw = str(error)
    if flaw:
        raise ValueError(f"is damaged: {flaw}")
    return shard


def _flaw_of_columns(
    shard: Columns, shape: tuple[int, ...], dimension: int, n_parameters: int
) -> str:
    count, n_loaded_nodes = len(shard["index"]), int(shard["n_loaded_nodes"].sum())
    shapes = {
        "index": (count,),
        "point": (count, dimension),
        "n_loaded_nodes": (count,),
        "node": (n_loaded_nodes,),
        "nodal_force": (n_loaded_nodes, shape[1]),
        "displacement": (count, *shape),
        "residual": (count,),
        "volume_ratio": (count,),
        "iterations": (count,),
        "parameters": (count, n_parameters),
    }
    for name, expected in shapes.items():
        column = shard[name]
        if (tuple(column.shape), column.dtype) != (expected, INTEGERS.get(name, torch.float64)):
            return f"{name} has shape and type {tuple(column.shape)}, {column.dtype}"
        if name in FINITE and not column.isfinite().all():
            return f"{name} is not finite"
    if not ((shard["n_loaded_nodes"] >= 0) & (shard["n_loaded_nodes"] <= shape[0])).all():
        return "a number of loaded nodes is negative or exceeds N"
    if not ((shard["node"] >= 0) & (shard["node"] < shape[0])).all():
        return "a loaded node does not exist"
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
