"""Newton from rest and from predictions: python scripts/convergence.py run=runs/beam_svk."""

from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from rich.progress import Progress

from dpl import run


@hydra.main(version_base="1.3", config_path="../conf", config_name="convergence")
@run.command
def main(cfg: DictConfig) -> None:
    """Measure all solvers on all loads; write rows, machine and figure."""
    from dpl import convergence, peers
    from dpl import rows as table

    run.check(cfg)
    folders = sorted(path.parent for path in Path(cfg.run).glob("*/config.yaml"))
    if cfg.networks is not None:
        folders = [Path(cfg.run) / name for name in cfg.networks]
    if not folders:
        raise run.ConfigError(f"run: {cfg.run} holds no runs; train some with run={cfg.run}/NAME")
    scene, networks = None, {}
    for folder in folders:
        _, surrogate = run.load_run(folder, scene=scene)
        scene, networks[folder.name] = surrogate.scene, surrogate.predict
    assert scene is not None
    sets = convergence.load_sets(scene, cfg.count, cfg.far)
    middle = sorted(cfg.tols)[len(cfg.tols) // 2]
    tasks = [(tol, name) for tol in cfg.tols for name in ("in range", "twice")]
    tasks += [(middle, name) for name in sets if name.endswith("times")]
    rows = convergence.paper()
    times: dict[tuple[float, str, str], torch.Tensor] = {}
    with Progress() as progress:
        bar = progress.add_task("loads", total=sum(len(sets[name].force) for _, name in tasks))
        for tol, name in tasks:
            solvers = convergence.contestants(scene, networks, tol)
            more, taken = convergence.measure(
                solvers, name, sets[name], tol, lambda: progress.advance(bar)
            )
            rows += more
            for (solver, network), each in taken.items() if name in ("in range", "twice") else ():
                before = times.get((tol, solver, network), torch.zeros(0).double())
                times[tol, solver, network] = torch.cat([before, each])
    stem = Path(cfg.folder) / cfg.name
    table.show(rows, f"{cfg.name}, one load at a time, 1 thread")
    table.write(rows, stem.with_suffix(".csv"))
    table.write_machine(peers.machine(), stem.with_suffix(".json"))
    convergence.draw(times, stem.with_suffix(".png"))


if __name__ == "__main__":
    main()
