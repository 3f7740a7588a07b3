"""All methods on one experiment side by side: python scripts/results.py name=beam_svk."""

from pathlib import Path

from omegaconf import DictConfig

from dpl import run
from dpl.commands.entry import command


@command("results")
def main(cfg: DictConfig) -> None:
    """Measure every run of an experiment; write rows, machine and figure."""
    from dpl.benchmarks import results
    from dpl.benchmarks.rows import show
    from dpl.models.pod import PODNet

    run.check(cfg)
    runs = run.load_runs(cfg.run)
    first, surrogate = next(iter(runs.values()))
    scene = surrogate.scene
    data = run.load_data(first, scene)
    train = data.samples("train")

    def made(key: str, *parts: object) -> results.Method:
        try:
            return run.make(cfg, key)(*parts)
        except ValueError as error:
            raise run.ConfigError(f"{key}: {error}; {key}=null leaves it out") from error

    methods = {"linear": results.linear(scene)}
    if cfg.galerkin:
        methods["POD-Galerkin"] = made("galerkin", scene, train)
    for name, (trained, surrogate) in runs.items():
        method = results.network(surrogate, Path(cfg.run) / name, trained.data.train)
        methods[name] = method
        if cfg.corrected and isinstance(surrogate.net, PODNet):
            methods[name + results.CORRECTED] = made("corrected", surrogate, method, train)
    sets = results.load_sets(scene, data.samples("test"), cfg.count)
    rows, errors = results.paper(cfg.name), {}
    a_load = data.store.seconds_a_load()
    minutes = None if a_load is None else a_load * sum(data.wanted.sizes.values()) / 60
    for row, error in results.measure(methods, sets, scene.solver, generation_minutes=minutes):
        rows.append(row)
        errors[row.method, row.loads] = error
    show(rows, f"{cfg.name}, one load at a time, 1 thread")
    results.save(rows, errors, Path(cfg.folder) / cfg.name)
