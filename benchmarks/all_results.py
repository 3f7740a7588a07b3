"""Tables of all experiments that have finished runs, beside the numbers of the paper."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from benchmarks import loss_table, paper_tables, subcommands
from benchmarks.paper_tables import Result
from benchmarks.study import record
from benchmarks.tables import read
from dpl import config

EXPERIMENTS = ("beam_svk", "propeller_nh", "beam_nh_loss", "beam_young", "beam_young_wide")
OF_CONVERGENCE = "beam_svk"  # experiment whose networks start Newton's method in experiment 4
PAPER_ROWS = {  # rows of the paper by the method with which they are compared
    "beam_young_wide": ("beam_young", "paper, 3b"),  # 3b has no table of its own
}


@dataclass(frozen=True)
class Comparison:
    """A method on the loads in range of an experiment, beside the paper's network.

    Attributes:
        experiment: Name of the experiment.
        method: Name of the method.
        samples: Number of training loads.
        parameters: Number of trained parameters.
        training_minutes: Wall time of the training [min].
        e_mean, e_max, SNR_min: Metrics of the method, see `dpl.training.metrics`.
        paper_e_mean, paper_e_max, paper_SNR_min: Metrics that the paper reports.
        ratio: e_mean over that of the paper [-].
    """

    experiment: str
    method: str
    samples: int | None
    parameters: int | None
    training_minutes: float | None
    e_mean: float | None
    e_max: float | None
    SNR_min: float | None
    paper_e_mean: float | None
    paper_e_max: float | None
    paper_SNR_min: float | None
    ratio: float | None


def finished_runs(folder: Path) -> list[str]:
    """Return the names of the runs in a folder whose evaluation is complete."""
    return sorted(path.parent.name for path in folder.glob("*/evaluation.json"))


def run(cfg: DictConfig, measure: Callable[[DictConfig], None]) -> list[str]:
    """Write the tables of all experiments; return a line for each part that is left out.

    Args:
        cfg: Configuration of the command with `name=all`.
        measure: Writes the tables of one experiment, given its configuration.
    """
    root, folder, left_out = Path(cfg.runs), Path(cfg.folder), []
    done = []
    for name in EXPERIMENTS:
        names = finished_runs(root / name)
        if not names:
            left_out.append(f"{name}: no finished run below {root / name}")
            continue
        print(f"\n{name}: {', '.join(names)}", flush=True)
        own = {"name": name, "run": str(root / name), "networks": names}
        try:
            measure(OmegaConf.merge(cfg, own))
        except (config.ConfigError, ValueError) as error:
            left_out.append(f"{name}: {error}")
        else:
            done.append(name)
    left_out += _losses(root / "losses", folder)
    left_out += _convergence(cfg, root / OF_CONVERGENCE, folder)
    rows = [row for name in done for row in beside_the_paper(name, _read(folder, name))]
    if rows:
        record(rows, folder / "paper", "loads in range, beside the paper")
    return left_out


def _read(folder: Path, name: str) -> list[Result]:
    return read(Result, folder / f"{name}.csv")


def beside_the_paper(experiment: str, rows: Sequence[Result]) -> list[Comparison]:
    """Return the methods of an experiment on the loads in range beside the paper's network.

    Args:
        experiment: Name of the experiment.
        rows: All rows of its table.
    """
    source, title = PAPER_ROWS.get(experiment, (experiment, "paper"))
    paper = {row.method: row for row in paper_tables.paper(source)}
    theirs = paper.get(title, Result(title, "in range", 0))
    return [
        Comparison(
            experiment,
            row.method,
            row.samples,
            row.parameters,
            row.training_minutes,
            row.e_mean,
            row.e_max,
            row.SNR_min,
            theirs.e_mean,
            theirs.e_max,
            theirs.SNR_min,
            row.e_mean / theirs.e_mean if row.e_mean and theirs.e_mean else None,
        )
        for row in rows
        if row.loads == "in range" and not row.method.startswith("paper")
    ]


def _losses(runs: Path, folder: Path) -> list[str]:
    """Write the table of losses; return why it is left out."""
    names = finished_runs(runs)
    if not names:
        return [f"losses: no finished run below {runs}"]
    rows = loss_table.summaries({name: loss_table.numbers(runs / name) for name in names})
    record(rows, folder / "losses", "losses: medians over seeds")
    return []


def _convergence(cfg: DictConfig, runs: Path, folder: Path) -> list[str]:
    """Run the command of experiment 4; return why it is left out."""
    names = finished_runs(runs)
    if not names:
        return [f"convergence (experiment 4): no finished run below {runs}"]
    options = [f"run={runs}", f"networks=[{','.join(names)}]", f"folder={folder}"]
    print(f"\nconvergence: {', '.join(names)}", flush=True)
    status = subcommands.run_script("convergence", [*options, *cfg.convergence])
    return [f"convergence: ended with status {status}"] if status else []
