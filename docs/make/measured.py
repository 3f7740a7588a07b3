"""The page of benchmarks/results/: every table and figure with the command that makes it."""

import csv
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from paths import RESULTS

Row = dict[str, str]
HEADS = {
    "SNR_min": "SNR min [dB]",
    "e_max": "e_max [-]",
    "e_mean": "e_mean [-]",
    "factorisations": "factors",
    "generation_minutes": "solving [min]",
    "memory": "memory [MB]",
    "min_det_F": "min det F",
    "ms": "ms",
    "ms_p99": "ms, 99 %",
    "newton_iterations": "Newton iterations after",
    "peak": "peak of the process [MB]",
    "rel_L2_median": "rel. L2, median",
    "rel_L2_worst": "rel. L2, worst",
    "residual": "‖R‖/‖f‖",
    "seconds": "s",
    "training_minutes": "training [min]",
    "volume_ratio": "min det F",
}
VALUE = re.compile(r"\{\{ *(?P<stem>\w+):(?P<which>[^{}]*): *(?P<column>\w+) *\}\}")


@dataclass(frozen=True)
class Part:
    """Some files of benchmarks/results/.

    Attributes:
        pattern: Their stem, whole.
        title: Of the section; groups of the pattern may stand in it and in `command`.
        command: Makes them.
        about: What is seen.
        split: Column whose values get a table each.
        opened: So many of these tables are open, the others folded.
        keep: Rows that are shown; the file has all.
    """

    pattern: str
    title: str
    command: str
    about: str
    split: str | None = None
    opened: int = 1
    keep: Callable[[list[Row]], list[Row]] = lambda rows: rows


def _ends(rows: list[Row]) -> list[Row]:
    """Return what each solver ended with, on one thread."""
    return [row for row in rows if row["last"] == "True" and row["threads"] == "1"]


def _extremes(rows: list[Row]) -> list[Row]:
    """Return the load of the smallest and that of the largest deflection of each body."""
    kept = []
    for body in dict.fromkeys(row["body"] for row in rows):
        mine = sorted(
            (row for row in rows if row["body"] == body), key=lambda row: float(row["deflection"])
        )
        kept += [mine[0], mine[-1]]
    return kept


def _moments(rows: list[Row]) -> list[Row]:
    """Return the first, middle and last of the rows of each work."""
    kept = []
    for work in dict.fromkeys(row["what"] for row in rows):
        mine = [row for row in rows if row["what"] == work]
        kept += [mine[0], mine[len(mine) // 2], mine[-1]]
    return kept


PARTS = (
    Part(
        r"(beam_svk|propeller_nh|beam_nh_loss|beam_young)",
        "All methods on `{0}`",
        "python scripts/results.py name={0}",
        "Every run below `runs/{0}` beside the linear answer, POD-Galerkin and the paper: 100 test "
        "loads in range, 50 small ones and 50 of one to two times the range.",
        split="loads",
    ),
    Part(
        "hybrid_newton",
        "Newton from predictions",
        "python scripts/convergence.py run=runs/beam_svk networks=[latent,fcnn] far=0 "
        "folder=benchmarks/results",
        "The paper's experiment 4: 50 loads in range, 50 of one to two times the range, one at a "
        "time on one thread.",
        split="tol",
        opened=2,
    ),
    Part(
        "hybrid_newton_far",
        "Newton from predictions, far out",
        "python scripts/convergence.py name=hybrid_newton_far run=runs/beam_svk networks=[latent] "
        "count=0 far=8 tols=[1e-6] folder=benchmarks/results",
        "Loads of three and of five times the range.",
        split="loads",
    ),
    Part(
        r"pareto_(beam_svk|propeller_nh)",
        "Run time against error on `{0}`",
        "python scripts/pareto.py run=runs/{0} folder=benchmarks/results "
        "discretisation=benchmarks/results/discretisation_{0}.csv",
        "The table has what each solver ends with; the figure and the file have every iterate.",
        keep=_ends,
    ),
    Part(
        r"discretisation_(beam_svk|propeller_nh)",
        "Discretisation error on `{0}`",
        "python scripts/benchmark.py parts=[discretisation] folder=benchmarks/results",
        "One load on ever finer meshes, against the limit by Richardson's extrapolation.",
    ),
    Part(
        "sizes",
        "Cost against degrees of freedom",
        "python scripts/benchmark.py parts=[sizes] repeats=3 folder=benchmarks/results",
        "Beams from 4 to 20 cells across, each in a process of its own, random weights.",
    ),
    Part(
        "deflections",
        "How far test loads move the bodies",
        "python scripts/benchmark.py parts=[deflections] count=100 folder=benchmarks/results",
        "The largest nodal displacement of each test load of `beam_svk` and of `propeller_nh`, "
        "over the longest side of the body. The table has the loads that move each body least and "
        "most.",
        keep=_extremes,
    ),
    Part(
        r"stress_(\w+)",
        "A trained run far beyond its range, `{0}`",
        "python scripts/stress.py cases=[] run=runs/{0}/latent",
        "Loads from 1e-9 to 25 times the range.",
        split="series",
    ),
    Part(
        "soak",
        "Thirty minutes at full speed",
        "python scripts/soak.py minutes=30",
        "Online training, then the simulator. The table has the first, the middle and the last "
        "look at each.",
        keep=_moments,
    ),
)


def read(stem: str) -> list[Row]:
    """Return the rows of a file."""
    with (RESULTS / f"{stem}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def stems() -> list[str]:
    """Return what there is."""
    return sorted({path.stem for path in RESULTS.iterdir() if path.suffix in (".csv", ".png")})


def part_of(stem: str) -> tuple[Part, tuple[str, ...]] | None:
    """Return what a file belongs to, with the groups of its pattern."""
    for part in PARTS:
        found = re.fullmatch(part.pattern, stem)
        if found:
            return part, found.groups()
    return None


def page() -> str:
    """Return the page.

    Raises:
        LookupError: A file belongs to no part.
    """
    there = stems()
    for stem in there:
        if part_of(stem) is None:
            raise LookupError(
                f"results/{stem}: which command makes it? add it to PARTS in {__file__}"
            )
    order = {part: k for k, part in enumerate(PARTS)}
    there.sort(key=lambda stem: (order[part_of(stem)[0]], stem))
    parts = [
        "---\nhide: [navigation]\n---\n",
        "# Results\n",
        "Tables and figures are those of `benchmarks/results/`, read when this page was made. "
        "What they mean is told in [Measurements](measurements.md). Times differ from machine to "
        "machine.\n",
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
    if (RESULTS / f"{stem}.csv").is_file():
        yield from tables(part.keep(read(stem)), part.split, part.opened)


def _machine(stem: str) -> str:
    path = RESULTS / f"{stem}.json"
    if not path.is_file():
        return ""
    told = json.loads(path.read_text(encoding="utf-8"))
    return "Measured on " + ", ".join(_fact(key, value) for key, value in told.items()) + ". "


def _fact(key: str, value: object) -> str:
    return f"{value} thread{'s' * (value != 1)}" if key == "threads" else str(value)


def tables(rows: list[Row], split: str | None, opened: int = 1) -> Iterator[str]:
    """Yield tables: one, or one for each value of a column."""
    if split is None:
        yield from table(rows)
        return
    values = dict.fromkeys(row[split] for row in rows)
    for k, value in enumerate(values):
        mine = [{c: x for c, x in row.items() if c != split} for row in rows if row[split] == value]
        name = f"{split} {value}" if split == "tol" and value else value or "the paper"
        if k < opened:
            yield f"**{name}**\n"
            yield from table(mine)
            continue
        yield f'??? note "{name}"\n'
        yield from (f"    {line}" for line in table(mine))


def table(rows: list[Row]) -> Iterator[str]:
    """Yield one table, columns without any number left out."""
    columns = [c for c in rows[0] if any(row[c] for row in rows)]
    yield "| " + " | ".join(HEADS.get(c, c.replace("_", " ")) for c in columns) + " |"
    yield "|" + " --- |" * len(columns)
    for row in rows:
        yield "| " + " | ".join(shown(row[c]) for c in columns) + " |"
    yield ""


def shown(text: str) -> str:
    """Return a number as it is read: at most three digits, thousands apart."""
    try:
        number = float(text)
    except ValueError:
        return text.replace("|", "\\|")
    if number != number or abs(number) == float("inf"):
        return text
    if number == int(number) and abs(number) < 1e12:
        return f"{int(number):,}"
    if 1e-3 <= abs(number) < 1e4:
        return f"{number:.3g}" if abs(number) < 1000 else f"{number:,.0f}"
    mantissa, exponent = f"{number:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def filled(text: str) -> str:
    """Return a text with `{{ file: column=value, column=value: column }}` as the number itself.

    Raises:
        LookupError: No row, or more than one, is meant.
    """
    return VALUE.sub(lambda match: shown(value(**match.groupdict())), text)


def value(stem: str, which: str, column: str) -> str:
    """Return one number of a file.

    Args:
        stem: Of the file in benchmarks/results/.
        which: `column=value` that its row has, apart by semicolons.
        column: Where it stands.

    Raises:
        LookupError: No row, or more than one, is meant.
    """
    wanted = dict(pair.strip().split("=", 1) for pair in which.split(";"))
    found = [row for row in read(stem) if all(row[c] == x for c, x in wanted.items())]
    if len(found) != 1:
        raise LookupError(f"results/{stem}.csv: {len(found)} rows are {wanted}")
    return found[0][column]


def files() -> list[Path]:
    """Return all files of benchmarks/results/."""
    return sorted(path for path in RESULTS.iterdir() if path.is_file())
