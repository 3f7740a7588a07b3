"""Tables of all experiments that have finished runs, and figures that are drawn again from rows."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from benchmarks import loss_table, subcommands
from benchmarks.study import Draw, read, record
from dpl import config

EXPERIMENTS = ("beam_svk", "propeller_nh", "beam_nh_loss", "beam_young", "beam_young_wide")
OF_CONVERGENCE = "beam_svk"  # experiment whose networks start Newton's method in experiment 4


def finished_runs(folder: Path) -> list[str]:
    """Return the names of the runs in a folder whose evaluation is complete."""
    return sorted(path.parent.name for path in folder.glob("*/evaluation.json"))


def run(cfg: DictConfig, measure: Callable[[DictConfig], None]) -> list[str]:
    """Write the tables of all experiments; return a line for each part that is left out."""
    root, folder, left_out = Path(cfg.runs), Path(cfg.folder), []
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
    left_out += _losses(root / "losses", folder)
    left_out += _convergence(cfg, root / OF_CONVERGENCE, folder)
    return left_out


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


def figures() -> list[tuple[type, Draw]]:
    """Return the classes of rows of which figures are drawn, each with its figure."""
    from benchmarks import (
        ablation,
        ablation_figures,
        deflections,
        error_estimates,
        grasps,
        learning_curves,
        newton_starts,
        paper_tables,
        pareto,
        single_loads,
        sizes,
        soak,
        transfer,
    )

    return [
        (ablation.Row, ablation_figures.draw),
        (deflections.Deflection, deflections.draw),
        (error_estimates.Estimate, error_estimates.draw),
        (grasps.Amplitude, grasps.draw),
        (learning_curves.Validation, learning_curves.draw),
        (newton_starts.Summary, newton_starts.draw),
        (paper_tables.Result, paper_tables.draw),
        (pareto.Point, pareto.draw),
        (single_loads.SingleLoad, single_loads.draw),
        (sizes.Size, sizes.draw),
        (soak.Usage, soak.draw),
        (transfer.Transfer, transfer.draw),
    ]


def redraw(folder: Path) -> list[Path]:
    """Draw all figures of a folder again from its rows, whose columns tell their class."""
    drawn = []
    for path in sorted(folder.glob("*.csv")):
        for kind, draw in figures():
            try:
                rows: list[Any] = read(kind, path)
            except ValueError:  # the columns are those of another class
                continue
            drawn.append(path.with_suffix(".png"))
            draw(rows, drawn[-1])
    return drawn
