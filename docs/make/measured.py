"""The page of benchmarks/results/: tables and figures with the commands that make them."""

import csv
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from paths import RESULTS

Row = dict[str, str]


@dataclass(frozen=True)
class Part:
    """Files of benchmarks/results/ that one command makes.

    Attributes:
        pattern: Regular expression of their stem; `title` and `command` may use its groups.
        title: Title of the section.
        command: The command.
        about: What the files contain.
        split: Column whose values get a table each; the first is open, the others are folded.
        tabulated: Whether the page shows the table, and not its figure and file alone.
    """

    pattern: str
    title: str
    command: str
    about: str
    split: str | None = None
    tabulated: bool = True


PARTS = (
    Part(
        "paper",
        "All methods beside the paper",
        "python scripts/paper.py",
        "The loads in range of all experiments; `ratio` is e_mean over that of the paper. The "
        "command trains all runs and writes all tables of the paper.",
        split="experiment",
    ),
    Part(
        "losses",
        "Losses",
        "python scripts/results.py name=all",
        "Medians over the seeds of all runs below `runs/losses`.",
    ),
    Part(
        r"(beam_svk|propeller_nh|beam_nh_loss|beam_young|beam_young_wide)",
        "All methods on `{0}`",
        "python scripts/results.py name={0}",
        "All runs below `runs/{0}`, the linear solution, POD-Galerkin and the paper: 100 test "
        "loads in range, 50 small ones and 50 of one to two times the range.",
        split="loads",
    ),
    Part(
        r"(beam_svk|propeller_nh|beam_nh_loss|beam_young|beam_young_wide)_curves",
        "Learning curves on `{0}`",
        "python scripts/results.py name={0}",
        "Median relative L2 error of the validation loads, of all runs below `runs/{0}` that were "
        "validated more than once.",
        tabulated=False,
    ),
    Part(
        r"(inclusion|fibre_beam)",
        "Parameters of several materials: `{0}`",
        "python scripts/results.py name={0} galerkin=null corrected=null",
        "Networks with parameters of the material as inputs, see "
        "[heterogeneous bodies](materials.md).",
        split="loads",
    ),
    Part(
        "grasps",
        "Grasps",
        "python scripts/grasps.py run=runs/beam_nh_loss/unrolled",
        "Random grasps of the paper's beam: largest error of the motion over L, relative errors of "
        "displacement, force and moment of the gripper; `silent` counts errors above 1 % that the "
        "estimated error does not report.",
    ),
    Part(
        "grasps_amplitude",
        "Grasps of decreasing amplitude",
        "python scripts/grasps.py run=runs/beam_nh_loss/unrolled",
        "Median errors of the displacement, over its norm at the amplitude 1.",
    ),
    Part(
        "transfer",
        "All load families on the beam",
        "python scripts/transfer.py networks=[unrolled] count=50 families=[cable,gravity,modal,"
        "modal_small,patch,point,pressure,traction,file,mixture]",
        "The network of each family on the test loads of all families: errors of the prediction, "
        "and Newton from the prediction and from rest.",
        split="trained_on",
    ),
    Part(
        "transfer_bracket",
        "All load families on a bracket from a mesh file",
        "python scripts/transfer.py run=runs/families_bracket name=transfer_bracket count=50",
        "The same for quadratic tetrahedra.",
        split="trained_on",
    ),
    Part(
        "local_networks",
        "Networks on loads of small areas",
        "python scripts/transfer.py families=[modal,modal_small,point] name=local_networks "
        "count=50",
        "All networks of three families on the test loads of these families.",
        split="network",
    ),
    Part(
        "hybrid_newton",
        "Newton from predictions",
        "python scripts/convergence.py run=runs/beam_svk networks=[fcnn] n_far_loads=0 "
        "folder=benchmarks/results",
        "The paper's experiment 4: 50 loads in range and 50 of one to two times the range, one at "
        "a time on one thread.",
        split="tol",
    ),
    Part(
        "hybrid_newton_hard",
        "Newton from predictions, larger loads",
        "python scripts/convergence.py run=runs/hybrid_newton_hard "
        "networks=[unrolled,fcnn] name=hybrid_newton_hard tols=[1e-6] count=100 twice=false "
        "n_far_loads=0 max_plain_iterations=6 "
        "\"solvers=[plain Newton,'hybrid, paper\\'s rule','hybrid, natural monotonicity']\" "
        "folder=benchmarks/results",
        "100 loads of `experiment=hybrid_newton_hard`, one at a time on one thread.",
    ),
    Part(
        r"(beam_svk|propeller_nh|beam_nh_loss|beam_young|hybrid_newton_hard)_single",
        "One large load on `{0}`",
        "python scripts/results.py name={0} single=true",
        "The test load whose largest nodal displacement is nearest to 0.4 L, as in tables 2, 4 and "
        "6 and figures 5 to 7 of the paper. Shapes are coloured by the nodal error.",
    ),
    Part(
        r"pareto_(beam_nh_loss|propeller_nh)",
        "Run time against error on `{0}`",
        "python scripts/pareto.py run=runs/{0} folder=benchmarks/results",
        "Figure and file contain every iterate of every solver.",
        tabulated=False,
    ),
    Part(
        r"discretisation_(beam_svk|propeller_nh)",
        "Discretisation error on `{0}`",
        "python scripts/benchmark.py cases=[discretisation] folder=benchmarks/results",
        "One load on refined meshes, compared with the limit by Richardson extrapolation.",
    ),
    Part(
        r"devices_(cpu|cuda)",
        "Networks on the device `{0}`",
        "python scripts/devices.py device={0} folder=benchmarks/results",
        "Training steps and predictions of each network on the paper's beam.",
        split="task",
    ),
    Part(
        r"local_loads_(\w+)",
        "Loads on small areas, run `{0}`",
        "python scripts/benchmark.py cases=[local] run=runs/{0} folder=benchmarks/results",
        "Loads of each kind, their number by `count`: relative errors of linear solution and "
        "prediction, latencies of prediction and ONNX graph.",
    ),
    Part(
        "unrolled",
        "Learning curve and ablation of `unrolled`",
        "python scripts/ablation.py experiment=beam_nh_loss data.train=1024",
        "Fits to 64 to 1,024 loads, variants fitted to 512 loads, and the errors of the fit to 512 "
        "loads on other loads.",
        split="part",
    ),
    Part(
        "unrolled_method",
        "Steps of a prediction of `unrolled`",
        "python scripts/ablation.py experiment=beam_nh_loss data.train=1024",
        "The test load with the largest displacement.",
    ),
    Part(
        "error_estimates",
        "Estimated over true errors",
        "python scripts/error_estimates.py folder=benchmarks/results",
        "Quantiles of the ratio, for answers of models of 96 loads, on four bodies.",
        tabulated=False,
    ),
    Part(
        "error_estimates_loads",
        "Estimated and true errors",
        "python scripts/error_estimates.py folder=benchmarks/results",
        "One row for each answer of the file before.",
        tabulated=False,
    ),
    Part(
        "sizes",
        "Cost against degrees of freedom",
        "python scripts/benchmark.py cases=[sizes] repeats=3 folder=benchmarks/results",
        "Beams of 4 to 20 elements across, each in its own process, with random weights.",
    ),
    Part(
        "modes",
        "Time of the eigenmodes",
        "python scripts/benchmark.py cases=[modes] folder=benchmarks/results",
        "Clamped beams, one thread, medians. CPU times exclude the time in which other programs "
        "used the core. The first row is the paper's.",
    ),
    Part(
        "law_costs",
        "Time of bodies of several laws",
        "python scripts/benchmark.py cases=[laws] folder=benchmarks/results",
        "Tangent and residual of the paper's beam by compiled loops, one thread, medians of 40; "
        "the ratios are medians over pairs that were timed alternately.",
    ),
    Part(
        "deflections",
        "Displacements of the test loads",
        "python scripts/benchmark.py cases=[deflections] count=100 folder=benchmarks/results",
        "The largest nodal displacement of each test load of `beam_svk` and of `propeller_nh`, "
        "over the longest side of the body.",
        tabulated=False,
    ),
    Part(
        "soak",
        "Thirty minutes at full load",
        "python scripts/soak.py minutes=30",
        "Online training, then the simulator.",
        tabulated=False,
    ),
)


def read(stem: str) -> list[Row]:
    """Return the rows of a file."""
    with (RESULTS / f"{stem}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def stems() -> list[str]:
    """Return the stems of all tables and figures."""
    return sorted({path.stem for path in RESULTS.iterdir() if path.suffix in (".csv", ".png")})


def part_of(stem: str) -> tuple[Part, tuple[str, ...]] | None:
    """Return the part of a file and the groups of its pattern; None if no part matches."""
    for part in PARTS:
        found = re.fullmatch(part.pattern, stem)
        if found:
            return part, found.groups()
    return None


def page() -> str:
    """Return the page.

    Raises:
        LookupError: No part matches a file.
    """
    there = stems()
    for stem in there:
        if part_of(stem) is None:
            raise LookupError(
                f"results/{stem} has no part; add the command that makes it to PARTS in {__file__}"
            )
    order = {part: k for k, part in enumerate(PARTS)}
    there.sort(key=lambda stem: (order[part_of(stem)[0]], stem))
    parts = [
        "---\nhide: [navigation]\n---\n",
        "# Results\n",
        "Tables and figures of `benchmarks/results/`. [Measurements](measurements.md) explains "
        "them. Times differ from machine to machine.\n",
    ]
    for stem in there:
        parts += section(stem)
    return "\n".join(parts) + "\n"


def section(stem: str) -> Iterator[str]:
    """Yield the lines of one file."""
    part, groups = part_of(stem)
    yield f"\n## {part.title.format(*groups)} {{ #{stem.replace('_', '-')} }}\n"
    yield f"```\n{part.command.format(*groups)}\n```\n"
    files = [path for path in sorted(RESULTS.glob(f"{stem}.*")) if path.suffix != ".png"]
    links = ", ".join(f"[{path.name}](results/{path.name})" for path in files)
    yield f"{part.about.format(*groups)} {_machine(stem)}Files: {links}.\n"
    if (RESULTS / f"{stem}.png").is_file():
        yield f"![{part.title.format(*groups)}](results/{stem}.png)\n"
    if part.tabulated and (RESULTS / f"{stem}.csv").is_file():
        yield from tables(read(stem), part.split)


def _machine(stem: str) -> str:
    path = RESULTS / f"{stem}.json"
    if not path.is_file():
        return ""
    facts = json.loads(path.read_text(encoding="utf-8"))
    return f"Measured with {', '.join(f'{key}: {value}' for key, value in facts.items())}. "


def tables(rows: list[Row], split: str | None) -> Iterator[str]:
    """Yield one table, or one for each value of a column."""
    if split is None:
        yield from table(rows)
        return
    for k, value in enumerate(dict.fromkeys(row[split] for row in rows)):
        mine = [{c: x for c, x in row.items() if c != split} for row in rows if row[split] == value]
        yield f'???{"+" if k == 0 else ""} note "{split}: {value or "the paper"}"\n'
        yield from (f"    {line}" for line in table(mine))


def table(rows: list[Row]) -> Iterator[str]:
    """Yield one table without its empty columns."""
    columns = [c for c in rows[0] if any(row[c] for row in rows)]
    yield "| " + " | ".join(column.replace("_", " ") for column in columns) + " |"
    yield "|" + " --- |" * len(columns)
    for row in rows:
        yield "| " + " | ".join(shown(row[c], c) for c in columns) + " |"
    yield ""


def shown(text: str, column: str = "") -> str:
    """Return a number with at most three digits and separated thousands; other text as it is.

    Signal-to-noise ratios [dB] have one decimal.
    """
    try:
        number = float(text)
    except ValueError:
        return text.replace("|", "\\|")
    if number != number or abs(number) == float("inf"):
        return text
    if column.startswith("SNR"):
        return f"{round(number, 1) + 0.0:.1f}"  # no minus sign before zero
    if number == int(number) and abs(number) < 1e12:
        return f"{int(number):,}"
    if 1e-3 <= abs(number) < 1e4:
        return f"{number:.3g}" if abs(number) < 1000 else f"{number:,.0f}"
    mantissa, exponent = f"{number:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def value(csv: str, column: str, which: dict[str, str]) -> str:
    """Return one number of a file.

    Args:
        csv: Stem of the file in benchmarks/results/.
        column: Column of the number.
        which: Values of other columns that select its row.

    Raises:
        LookupError: Not exactly one row matches.
    """
    found = [row for row in read(csv) if all(row[c] == x for c, x in which.items())]
    if len(found) != 1:
        raise LookupError(f"results/{csv}.csv: {len(found)} rows match {which}")
    return found[0][column]


def files() -> list[Path]:
    """Return all files of benchmarks/results/."""
    return sorted(path for path in RESULTS.iterdir() if path.is_file())
