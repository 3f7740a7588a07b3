"""Loads as tensors of a file, forces kept where they act, and back again."""

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from dpl.data.solving.solve import LoadKey, SolvedLoad

WHOLE = dict.fromkeys(("index", "carried", "iterations"), torch.int64)  # columns of whole numbers
WHOLE["node"] = torch.int32
NUMBERS = {"point", "nodal_force", "displacement", "poisson"}  # what a sample is made of


def encode_shard(
    kept: Sequence[SolvedLoad],
    shape: tuple[int, ...],
    dimension: int,
    poisson: Callable[[Tensor], Tensor] | None = None,
) -> bytes:
    """Return accepted loads as a file.

    Args:
        kept: The loads.
        shape: N, D.
        dimension: d, numbers that a load is made of.
        poisson: From points (B, d) to Poisson's ratios (B, 1), where each load has its own; no such
            column if left out.
    """

    def column(name: str, *empty: int) -> Tensor:
        values = [getattr(one, name) for one in kept]
        return torch.from_numpy(np.stack(values) if values else np.zeros((0, *empty)))

    point = column("point", dimension)
    return save(
        {
            "index": torch.tensor([one.job.number for one in kept], dtype=torch.int64),
            "point": point,
            **to_sparse(column("force", *shape)),
            "displacement": column("displacement", *shape),
            "residual": torch.tensor([one.residual for one in kept], dtype=torch.float64),
            "volume_ratio": torch.tensor([one.volume_ratio for one in kept], dtype=torch.float64),
            "iterations": torch.tensor([one.iterations for one in kept], dtype=torch.int64),
            **({} if poisson is None else {"poisson": poisson(point).contiguous()}),
        }
    )


def decode_shard(
    content: bytes, shape: tuple[int, ...], dimension: int, own: int = 0
) -> dict[str, Tensor]:
    """Return the columns of such a file, and `force` (B, N, D) [-] and `poisson` (B, P) [-].

    Args:
        content: The file's.
        shape: N, D.
        dimension: d, numbers that a load is made of.
        own: P, 1 where each load has a Poisson's ratio of its own.

    Raises:
        ValueError: It is none, or one of other bodies; the message goes on after the file's name.
    """
    try:
        shard = load(content)
        count, n_loaded_nodes = len(shard["index"]), int(shard["carried"].sum())
        shapes = {
            "index": (count,),
            "point": (count, dimension),
            "carried": (count,),
            "node": (n_loaded_nodes,),
            "nodal_force": (n_loaded_nodes, shape[1]),
            "displacement": (count, *shape),
            "residual": (count,),
            "volume_ratio": (count,),
            "iterations": (count,),
        }
        if own:
            shapes["poisson"] = (count, own)
        elif "poisson" in shard:
            raise ValueError("holds Poisson's ratios, and this scene has one for all loads")
        for name, expected in shapes.items():
            column = shard[name]
            kind = WHOLE.get(name, torch.float64)
            if tuple(column.shape) != expected or column.dtype != kind:
                found = f"{tuple(column.shape)}, {column.dtype}"
                raise ValueError(f"is damaged: {name} has shape {found}")
            if name in NUMBERS and not column.isfinite().all():
                raise ValueError(f"is damaged: {name} is not finite")
        if not ((shard["carried"] >= 0) & (shard["carried"] <= shape[0])).all():
            raise ValueError("is damaged: forces act on more or on fewer nodes than there are")
        if (
            n_loaded_nodes
            and not 0 <= int(shard["node"].min()) <= int(shard["node"].max()) < shape[0]
        ):
            raise ValueError("is damaged: there are no such nodes")
    except (SafetensorError, KeyError, TypeError, RuntimeError) as error:
        raise ValueError(f"is damaged: {error}") from None
    shard["force"] = to_dense(shard, shape)
    shard.setdefault("poisson", torch.zeros(count, 0, dtype=torch.float64))
    return shard


def select(shard: Mapping[str, Tensor], job: LoadKey, line: Mapping[str, Any]) -> SolvedLoad:
    """Return a load from a shard that has tried it."""
    amplitude = line["amplitudes"][job.number - line["first"]]
    found = (shard["index"] == job.number).nonzero()
    if not len(found):
        (why,) = (one for one in line["rejected"] if one["index"] == job.number)
        none = np.zeros(0)
        return SolvedLoad(
            job, none, none, none, amplitude, False, np.nan, np.nan, why["load_factor"], 0, 0.0,
            why["reason"],
        )  # fmt: skip
    k = int(found[0])
    return SolvedLoad(
        job=job,
        point=shard["point"][k].numpy(),
        force=shard["force"][k].numpy(),
        displacement=shard["displacement"][k].numpy(),
        amplitude=amplitude,
        accepted=True,
        residual=float(shard["residual"][k]),
        volume_ratio=float(shard["volume_ratio"][k]),
        load_factor=1.0,
        iterations=int(shard["iterations"][k]),
        seconds=0.0,
        reason="",
    )


def to_sparse(force: Tensor) -> dict[str, Tensor]:
    """Return forces (B, N, D) as those of the nodes that carry any: they live on small areas."""
    carries = force.ne(0).any(dim=-1)
    return {
        "carried": carries.sum(dim=1),
        "node": carries.nonzero()[:, 1].to(torch.int32),
        "nodal_force": force[carries],
    }


def to_dense(to_sparse: Mapping[str, Tensor], shape: tuple[int, ...]) -> Tensor:
    """Return forces (B, N, D) from their compact form."""
    count = to_sparse["carried"]
    force = torch.zeros(len(count), *shape, dtype=torch.float64)
    sample = torch.repeat_interleave(torch.arange(len(count)), count)
    force[sample, to_sparse["node"].long()] = to_sparse["nodal_force"]
    return force


def serialize(one: SolvedLoad) -> bytes:
    """Return a load as a file of the spool."""
    fields = one._asdict()
    plain = {k: v for k, v in fields.items() if not isinstance(v, np.ndarray)}
    arrays = {k: v for k, v in fields.items() if isinstance(v, np.ndarray)}
    text = json.dumps(plain).encode()
    tensors = to_sparse(torch.from_numpy(arrays.pop("force"))[None])
    tensors |= {name: torch.from_numpy(array).contiguous() for name, array in arrays.items()}
    return save({**tensors, "plain": torch.frombuffer(bytearray(text), dtype=torch.uint8)})


def deserialize(content: bytes) -> SolvedLoad:
    """Return a load from the spool."""
    tensors = load(content)
    plain = json.loads(tensors["plain"].numpy().tobytes())
    displacement = tensors["displacement"]
    seed, number = plain.pop("job")
    return SolvedLoad(
        job=LoadKey((seed[0], seed[1]), number),
        point=tensors["point"].numpy(),
        force=to_dense(tensors, tuple(displacement.shape))[0].numpy(),
        displacement=displacement.numpy(),
        **plain,
    )
