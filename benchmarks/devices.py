"""Measure networks on the GPU or the processor: python scripts/devices.py device=auto.

Writes training steps and predictions per second, latencies, parameters and peak memory of each
network to devices_DEVICE.csv, and the machine to devices_DEVICE.json. Clocks are read after the
device has finished. The inputs of a training step are in the memory of the device. Loads are those
of the scene; targets are artificial, because the speed does not depend on them. A training step of
a network with a linear base has the linear solutions of its samples already.
"""

import gc
import resource
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from lightning.fabric.utilities import move_data_to_device
from omegaconf import DictConfig
from torch import nn

from benchmarks import CONF, methods
from benchmarks.study import record
from dpl import config
from dpl.commands.cli import command
from dpl.evaluation.timing import percentiles
from dpl.fem import Load
from dpl.models import CNN, FCNN, GNN, PODNet, Unrolled
from dpl.models.interface import Base
from dpl.scene import Sample, Scene
from dpl.system.threads import limited_threads
from dpl.training import MSE, Surrogate

FIT = "unrolled"  # has no training step
NETWORKS: dict[str, tuple[Callable[..., nn.Module], Base | None]] = {
    "fcnn": (partial(FCNN, width=512), "linear"),
    "fcnn plain": (partial(FCNN, width=512), None),
    "fcnn full": (partial(FCNN, all_dofs=True), None),  # of the paper, 4 n^2 + 7 n parameters
    "cnn": (CNN, "linear"),
    "gnn": (GNN, "linear"),
    "pod": (PODNet, "linear"),
    FIT: (lambda scene, _: Unrolled(scene), None),
}
TRAINING = "training step"
RESIDENT, COPIED = "prediction", "prediction with copies"  # inputs on the device; on the host
LOADS = 256  # different loads; larger batches repeat them
OUT_OF_MEMORY = (MemoryError, torch.OutOfMemoryError)


@dataclass(frozen=True)
class DeviceTime:
    """Wall time of one call on a device."""

    network: str  # name of the network in `NETWORKS`
    device: str  # "cpu" or "cuda"
    # "training step" (forward pass, loss, backward pass and optimiser), "prediction" (inputs and
    # result on the device) or "prediction with copies" (both on the host)
    task: str
    batch: int  # number of loads of a call
    calls: int  # number of timed calls
    ms: float  # median wall time of a call [ms]
    ms_p99: float  # 99th percentile [ms]
    loads_per_second: float  # number of loads over the median time [1/s]
    parameters: int  # number of trained parameters
    # peak memory of the device during the calls [MB]; on the processor, of the process
    peak_memory_mb: float


@dataclass(frozen=True)
class Clock:
    """Repetition of calls until a number of calls or a time is reached."""

    device: torch.device  # the device that is waited for
    repeats: int  # largest number of timed calls
    seconds: float  # time after which no further call begins [s]
    warm_up: int = 3  # number of calls before, which are not timed

    def times(self, call: Callable[[], object]) -> tuple[list[float], float]:
        """Return the wall times of a call [ms], at least one, and the peak memory [MB]."""
        for _ in range(self.warm_up):
            call()
        self.wait()
        self._reset_peak()
        found: list[float] = []
        end = time.perf_counter() + self.seconds
        while not found or (len(found) < self.repeats and time.perf_counter() < end):
            start = time.perf_counter()
            call()
            self.wait()
            found.append(1e3 * (time.perf_counter() - start))
        return found, self._peak()

    def wait(self) -> None:
        """Wait until the device has finished; the processor always has."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def _reset_peak(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
            return
        try:
            Path("/proc/self/clear_refs").write_text("5")  # resets VmHWM
        except OSError:
            return  # the peak is then that of the process since its start

    def _peak(self) -> float:
        if self.device.type == "cuda":
            return torch.cuda.max_memory_allocated(self.device) / 1e6
        status = Path("/proc/self/status")
        lines = status.read_text().splitlines() if status.is_file() else []
        peaks = [line.split()[1] for line in lines if line.startswith("VmHWM")]
        kilobytes = int(peaks[0]) if peaks else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return kilobytes * 1024 / 1e6


def samples_of(scene: Scene, count: int = LOADS) -> Sample:
    """Return loads with artificial displacements of the size of linear solutions, on the CPU."""
    load = scene.loads.sample((0, 0), range(count))
    field = methods.linear(scene).predict(load)
    bent = field + field * field.norm(dim=-1, keepdim=True)  # `unrolled` fits a nonlinear part
    return Sample(load.force, bent, load.young, load.parameters)


def measure(
    name: str,
    scene: Scene,
    samples: Sample,
    clock: Clock,
    batches: Sequence[int],
    predictions: Sequence[int],
) -> Iterator[DeviceTime]:
    """Yield the times of a network; print a line for each task without enough memory."""
    try:
        surrogate = fitted(name, scene, samples)
        dataset = surrogate.encode(samples)
        surrogate.to(clock.device)
    except OUT_OF_MEMORY as error:
        print(f"left out: {name}: {error!r}", flush=True)
        return
    tasks: list[tuple[str, int, Callable[[], Callable[[], object]]]] = [
        (task, batch, partial(prediction, surrogate, samples, batch, copies=task == COPIED))
        for batch in predictions
        for task in (RESIDENT, COPIED)
    ]
    if name != FIT:
        for batch in batches:
            tasks.append((TRAINING, batch, partial(training_step, surrogate, dataset, batch)))
    parameters = sum(weights.numel() for weights in surrogate.net.parameters())
    for task, batch, build in tasks:
        try:
            times, peak = clock.times(build())
        except OUT_OF_MEMORY as error:
            print(
                f"left out: {name}, {task}, batch {batch}: {error!r}",
                flush=True,
            )
        else:
            ms, last = percentiles(torch.tensor(times, dtype=torch.float64))
            print(f"{name}, {task}, batch {batch}: {ms:.3g} ms, {peak:,.0f} MB", flush=True)
            key = name, clock.device.type, task, batch
            yield DeviceTime(*key, len(times), ms, last, 1e3 * batch / ms, parameters, peak)
        surrogate.zero_grad(set_to_none=True)
        if clock.device.type == "cuda":
            gc.collect()
            torch.cuda.empty_cache()


def fitted(name: str, scene: Scene, samples: Sample) -> Surrogate:
    """Return the surrogate of a network whose bases or maps are fitted to samples."""
    network, base = NETWORKS[name]
    surrogate = Surrogate.from_network(network, MSE(), scene, base=base)
    if name == FIT:
        cast(Unrolled, surrogate.net).fit(samples, samples)
    elif surrogate.predictor.lacks_bases:
        surrogate.predictor.fit_bases(samples)
    return surrogate


def training_step(surrogate: Surrogate, dataset: Any, batch: int) -> Callable[[], float]:
    """Return a call that makes one optimiser step with a batch and returns its loss."""
    indices = [k % len(dataset) for k in range(batch)]
    inputs = move_data_to_device(dataset.__getitems__(indices), surrogate.device)
    surrogate.train()
    optimizer = surrogate.configure_optimizers()

    def step() -> float:
        optimizer.zero_grad(set_to_none=True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # there is no trainer that logs the loss
            loss = surrogate.training_step(inputs, 0)
        assert loss is not None
        loss.backward()
        optimizer.step()
        return float(loss.detach())  # as a progress bar reads it

    return step


def prediction(
    surrogate: Surrogate, samples: Sample, batch: int, *, copies: bool
) -> Callable[[], torch.Tensor]:
    """Return a call that predicts a batch."""
    indices = torch.arange(batch) % len(samples.force)
    host = Load(*(column[indices] for column in samples.load))
    device = surrogate.device
    resident = host if copies else _moved(host, device)
    surrogate.eval()

    @torch.inference_mode()
    def predict() -> torch.Tensor:
        if copies:
            return surrogate.predict(_moved(resident, device)).cpu()
        return surrogate.predict(resident)

    return predict


def _moved(load: Load, device: torch.device) -> Load:
    return Load(*(column.to(device) for column in load))


def select_device(choice: str) -> torch.device:
    """Return the device of "cpu", "cuda" (the first GPU) or "auto" (a GPU if there is one)."""
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


def facts(device: torch.device) -> dict[str, str | int | None]:
    """Return the names of the device and of the software that it runs."""
    found: dict[str, str | int | None] = {"torch": torch.__version__, "device": device.type}
    if device.type == "cuda":
        found |= {
            "gpu": torch.cuda.get_device_name(device),
            "gpu_memory_gb": round(torch.cuda.get_device_properties(device).total_memory / 1e9),
            "cuda": torch.version.cuda,
            "tf32_convolutions": str(torch.backends.cudnn.allow_tf32),
            "tf32_products": str(torch.backends.cuda.matmul.allow_tf32),
        }
    return found


KEYS = (
    (str, "device"),
    (Sequence[int], "batches predictions", 1, 10**6),
    (int, "threads", 1, 10**4),
    (float, "seconds", 1e-3, 1e6),
)


@command("devices", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Measure the chosen networks; rows are written after each network."""
    names = list(NETWORKS) if cfg.networks is None else list(cfg.networks)
    if unknown := [name for name in names if name not in NETWORKS]:
        raise config.ConfigError(f"networks = {unknown[0]!r} must be one of {', '.join(NETWORKS)}")
    with config.error_in("device", ValueError):
        device = select_device(cfg.device)
    scene = config.build_scene(cfg)
    print(*scene.describe()[0], flush=True)
    with limited_threads(cfg.threads):
        clock = Clock(device, cfg.repeats, cfg.seconds)
        samples, calls = samples_of(scene, cfg.samples), (cfg.batches, cfg.predictions)
        times = (row for name in names for row in measure(name, scene, samples, clock, *calls))
        stem = Path(cfg.folder) / f"devices_{device.type}"
        title, known = "training steps and predictions", facts(device)
        rows = record(times, stem, title, threads=cfg.threads, facts=known)
    if not rows:
        raise config.ConfigError("networks: none fits into the memory")
