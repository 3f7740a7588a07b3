"""Generate, verify or repair a data set: python scripts/generate.py data.train=4000."""

import sys

from omegaconf import DictConfig

import dpl
from dpl import config
from dpl.commands.cli import command, extra


def parts(cfg: DictConfig) -> tuple["dpl.Scene", "dpl.DataSet"]:
    """Return the scene and the data set of a configuration without solving or writing."""
    scene = config.build_scene(cfg)
    with config.error_in("material"):
        scene.problem.material.require_known("the generation of a data set")
    return scene, config.instantiate(cfg, "data", scene=scene)


@command("generate", rehearse=parts, preload=["dpl.data.solving.worker_pool"])
def main(cfg: DictConfig) -> None:
    """Generate the missing loads of a data set, or verify or repair it."""
    scene, data = parts(cfg)
    config.show_plan(scene, data, verbose=extra(cfg, "verbose"))
    if cfg.action == "verify":
        flaws = list(data.verify())
        print(data.store.summary())
        print(*flaws, f"{len(flaws)} flaws found", sep="\n")
        sys.exit(bool(flaws))
    store = data.repair() if cfg.action == "repair" else data.fill()
    print(store.summary())
