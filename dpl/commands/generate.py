"""Generate, verify or repair a data set: python scripts/generate.py data.train=4000."""

import sys
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from dpl import config
from dpl.commands.cli import command

if TYPE_CHECKING:
    from dpl.data import DataSet
    from dpl.scene import Scene

ACTIONS = ("generate", "verify", "repair")


def parts(cfg: DictConfig) -> tuple["Scene", "DataSet"]:
    """Return the scene and the data set of a configuration without solving or writing.

    Raises:
        ConfigError: One of them cannot be built.
    """
    if cfg.action not in ACTIONS:
        raise config.ConfigError(f"action = {cfg.action!r} must be one of {', '.join(ACTIONS)}")
    scene = config.build_scene(cfg)
    return scene, config.instantiate(cfg, "data", scene=scene)


@command("generate", rehearse=parts)
def main(cfg: DictConfig) -> None:
    """Generate the missing loads of a data set, or verify or repair it."""
    config.check(cfg)
    scene, data = parts(cfg)
    config.show_skipped_work(scene, data)
    if cfg.action == "verify":
        flaws = list(data.verify())
        print(data.store.summary())
        print(*flaws, f"{len(flaws)} flaws found", sep="\n")
        sys.exit(bool(flaws))
    store = data.repair() if cfg.action == "repair" else data.fill()
    print(store.summary())
