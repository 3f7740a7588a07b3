"""All methods on one experiment side by side: python scripts/results.py name=beam_svk."""

from pathlib import Path

import hydra
from omegaconf import DictConfig

from dpl import run


@hydra.main(version_base="1.3", config_path="../conf", config_name="results")
@run.command
def main(cfg: DictConfig) -> None:
    """Measure every run of an experiment; write rows, machine and figure."""
    from dpl import peers, results
    from dpl.models.pod import PODNet
    from dpl.rows import show

    run.check(cfg)
    folders = sorted(path.parent for path in Path(cfg.run).glob("*/config.yaml"))
    if not folders:
        raise run.ConfigError(f"run: {cfg.run} holds no runs; train some with run={cfg.run}/NAME")
    methods: dict[str, results.Method] = {}
    scene = None

    def made(key: str, *parts: object) -> results.Method:
        try:
            return run.make(cfg, key)(*parts)
        except ValueError as error:
            raise run.ConfigError(f"{key}: {error}; {key}=null leaves it out") from error

    for folder in folders:
        trained, surrogate = run.load_run(folder, scene=scene)
        if scene is None:
            scene = surrogate.scene
            data = run.load_data(trained, scene)
            train = data.samples("train")
            methods["linear"] = results.linear(scene)
            if cfg.galerkin:
                methods["POD-Galerkin"] = made("galerkin", scene, train)
        methods[folder.name] = results.network(surrogate, folder, trained.data.train)
        if cfg.corrected and isinstance(surrogate.net, PODNet):
            tier = made("corrected", surrogate, methods[folder.name], train)
            methods[folder.name + results.CORRECTED] = tier
    sets = results.load_sets(scene, data.samples("test"), cfg.count)
    rows, errors = results.paper(cfg.name), {}
    a_load = data.store.seconds_a_load()
    minutes = None if a_load is None else a_load * sum(data.wanted.sizes.values()) / 60
    for row, error in results.measure(methods, sets, scene.solver, generation_minutes=minutes):
        rows.append(row)
        errors[row.method, row.loads] = error
    show(rows, f"{cfg.name}, one load at a time, 1 thread")
    results.save(rows, errors, peers.machine(), Path(cfg.folder) / cfg.name)


if __name__ == "__main__":
    main()
