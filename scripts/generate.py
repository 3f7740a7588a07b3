"""The data set alone: python scripts/generate.py data.train=4000 data.workers=8."""

import hydra
from omegaconf import DictConfig

from dpl import run


@hydra.main(version_base="1.3", config_path="../conf", config_name="generate")
@run.command
def main(cfg: DictConfig) -> None:
    """Solve what is missing of a data set."""
    run.check(cfg)
    scene = run.build_scene(cfg)
    run.show_plan(scene)
    store = run.make(cfg, "data", scene=scene)
    print(store.summary())


if __name__ == "__main__":
    main()
