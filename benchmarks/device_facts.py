"""The device of a measurement: its choice and its names."""

import os
import subprocess
from typing import Literal

import torch

from dpl.evaluation.tables import machine

Choice = Literal["auto", "cpu", "cuda"]


def select_device(choice: str) -> torch.device:
    """Return the device of an option.

    Args:
        choice: "cpu", "cuda" (the first visible GPU) or "auto" (a GPU if there is one).

    Raises:
        ValueError: There is no GPU, or no such option.
    """
    if choice not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device = {choice} must be auto, cpu or cuda")
    found = torch.cuda.is_available()
    if choice == "cuda" and not found:
        build = torch.version.cuda or "a build without CUDA"
        raise ValueError(
            f"device = cuda needs a GPU that PyTorch {torch.__version__} ({build}) can use; "
            "take device=cpu"
        )
    return torch.device("cuda" if found and choice != "cpu" else "cpu")


def facts(device: torch.device, threads: int) -> dict[str, str | int | None]:
    """Return the names of the machine, of the device and of the software that it runs."""
    found: dict[str, str | int | None] = {
        "machine": machine(),
        "threads": threads,
        "torch": torch.__version__,
        "device": device.type,
    }
    if device.type == "cuda":
        total = torch.cuda.get_device_properties(device).total_memory
        found |= {
            "gpu": torch.cuda.get_device_name(device),
            "gpu_memory_gb": round(total / 1e9),
            "visible_gpus": torch.cuda.device_count(),
            "driver": driver(),
            "cuda": torch.version.cuda,
            "tf32_convolutions": str(torch.backends.cudnn.allow_tf32),
            "tf32_products": str(torch.backends.cuda.matmul.allow_tf32),
        }
    return found


def driver() -> str | None:
    """Return the version of the NVIDIA driver; None if `nvidia-smi` does not say it."""
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(
            query, capture_output=True, text=True, timeout=20, check=True, env=os.environ
        )
    except (OSError, subprocess.SubprocessError):
        return None
    lines = answer.stdout.split()
    return lines[0] if lines else None
