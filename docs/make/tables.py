"""Tables in pages of docs/: `python docs/make/tables.py` writes their numbers from the results.

The numbers of a table are stored in its page, which can therefore be read without the site. A
comment above the table names them:

    <!-- results: csv=beam_nh_loss; loads=in range
    | rel_L2_median | rel_L2_worst
    method=linear
    method=unrolled
    -->

The first line has what holds for every number: `csv` is the stem of a file of benchmarks/results/,
every other `key=value` selects its row, and a name alone is its column, or
several with commas. The lines that begin with a
bar have the same for the columns of the table, the others for its rows; a row replaces what its
column or the first line states. The numbers are the last cells of a row. An empty column and the
row `-` are left as they are.
"""

import csv
import re
from pathlib import Path

from paths import DOCS, RESULTS

BLOCK = re.compile(
    r"(?P<comment><!-- results: (?P<source>[^>]*?)\n-->\n)\n*"
    r"(?P<head>\|[^\n]*\n\|[-:| ]*\n)(?P<body>(?:\|[^\n]*\n)*)"
)
COLUMN = ""  # key of the column's name in what a part of a comment states


def updated(text: str) -> str:
    """Return the text of a page with the numbers of the results in its tables.

    Raises:
        LookupError: Not exactly one row of a file matches, or a table has not the rows of its
            comment, or a row not the columns of its table.
    """
    return BLOCK.sub(_block, text)


def _block(match: re.Match[str]) -> str:
    first, *lines = match["source"].split("\n")
    cells = [cell for line in lines if line.startswith("|") for cell in line[1:].split("|")]
    columns = [stated(cell) if cell.strip() else None for cell in cells]
    rows = [line for line in lines if not line.startswith("|")]
    body = match["body"].splitlines()
    if len(rows) != len(body):
        raise LookupError(f"results: {first}: {len(rows)} rows for a table of {len(body)}")
    width = match["head"].partition("\n")[0].count("|") - 1
    text = match["comment"] + "\n" + match["head"]
    for row, line in zip(rows, body, strict=True):
        new = line if row == "-" else _line(line, width, columns, stated(first), stated(row))
        text += f"{new}\n"
    return text


def _line(
    line: str,
    width: int,
    columns: list[dict[str, str] | None],
    first: dict[str, str],
    row: dict[str, str],
) -> str:
    cells = [cell.strip() for cell in line.strip().removeprefix("|").removesuffix("|").split("|")]
    if len(cells) != width:
        raise LookupError(f"results: a table of {width} columns has the row {line}")
    for k, column in enumerate(columns, len(cells) - len(columns)):
        if column is not None:
            which = first | column | row
            stem, names = which.pop("csv"), which.pop(COLUMN).split(", ")
            numbers = [shown(value(stem, name, which), name) for name in names]
            cells[k] = ", ".join(numbers) if any(numbers) else ""
    return "|" + "".join(f" {cell} |" if cell else " |" for cell in cells)


def stated(text: str) -> dict[str, str]:
    """Return the keys and values of a part of a comment; a name alone is that of the column."""
    pairs = [part.strip().partition("=") for part in text.split(";")]
    return {key if equals else COLUMN: value if equals else key for key, equals, value in pairs}


def read(stem: str) -> list[dict[str, str]]:
    """Return the rows of a file of benchmarks/results/."""
    with (RESULTS / f"{stem}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def value(stem: str, column: str, which: dict[str, str]) -> str:
    """Return one number of a file; `which` has the values of other columns that select its row.

    Raises:
        LookupError: Not exactly one row matches.
    """
    found = [row for row in read(stem) if all(row[c] == x for c, x in which.items())]
    if len(found) != 1:
        raise LookupError(f"results/{stem}.csv: {len(found)} rows match {which}")
    return found[0][column]


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


def pages() -> list[Path]:
    """Return the pages with tables of results."""
    return [path for path in sorted(DOCS.glob("*.md")) if "<!-- results" in path.read_text("utf-8")]


def main() -> None:
    """Write the numbers of all pages."""
    for path in pages():
        text = path.read_text(encoding="utf-8")
        if (new := updated(text)) != text:
            path.write_text(new, encoding="utf-8")
            print(f"docs/{path.name}")


if __name__ == "__main__":
    main()
