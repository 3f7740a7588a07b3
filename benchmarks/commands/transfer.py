"""Test networks on the loads of other families: python scripts/transfer.py run=runs/families.

The folder has a folder for each family with the runs of its networks, FAMILY/NETWORK. All runs
have the same body. Test loads are those of the data sets of the runs.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command

if TYPE_CHECKING:
    from benchmarks.transfer import Transfer
    from dpl import Sample
    from dpl.training import TrainedSurrogate

KEYS = ((Sequence[str] | None, "families"), (str, "name"), (int, "count", 1, 10**6))


@command("transfer", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Measure all networks of all families on the test loads of all families."""
    from benchmarks import transfer
    from benchmarks.study import record

    runs = _runs(cfg)
    scenes = {name: next(iter(own.values()))[1].scene for name, own in runs.items()}
    if lines := transfer.differences(scenes):
        raise config.ConfigError(f"run = {cfg.run}: the bodies of the families differ; {lines[0]}")
    tests = {name: _test_loads(*next(iter(own.values())), cfg.count) for name, own in runs.items()}
    stem = Path(cfg.folder) / cfg.name
    newton = {name: transfer.newton_iterations(scenes[name], test) for name, test in tests.items()}

    def rows() -> "Iterator[Transfer]":
        for family, own in runs.items():
            for network, (_, surrogate) in own.items():
                print(f"{family}/{network} ...", flush=True)
                predict, scene = surrogate.predict, surrogate.scene
                yield from transfer.measure(network, family, predict, scene, tests, newton)

    record(rows(), stem, "networks on the loads of other families, 1 thread", transfer.draw)


def _runs(cfg: DictConfig) -> "dict[str, dict[str, tuple[DictConfig, TrainedSurrogate]]]":
    """Return configurations and surrogates by family and network."""
    found = {path.parents[1].name for path in Path(cfg.run).glob("*/*/config.yaml")}
    if not found:
        raise config.ConfigError(
            f"run = {cfg.run} contains no runs; train some with run={cfg.run}/FAMILY/NETWORK"
        )
    families = cfg.families or sorted(found, key=lambda name: (name == "mixture", name))
    return {name: config.load_runs(Path(cfg.run) / name, cfg.networks) for name in families}


def _test_loads(cfg: DictConfig, surrogate: "TrainedSurrogate", count: int) -> "Sample":
    """Return the first test loads of the data set of a run, with their solutions."""
    from benchmarks.samples import first

    return first(config.load_data(cfg, surrogate.scene).samples("test"), count)
