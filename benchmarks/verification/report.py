"""Sections of the verification page and their tables."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal


@dataclass(frozen=True)
class Row:
    """A measured quantity with its reference."""

    quantity: str  # name of the quantity
    reference: str  # digits as the source prints them; "< 1e-10" or "> 0.94" is a bound
    value: float  # the measured value
    # relative difference allowed; None: one unit of the last digit printed
    within: float | None = None

    @property
    def difference(self) -> float:
        """Relative difference from the reference; NaN for a bound."""
        if self.reference[0] in "<>":
            return math.nan
        known = float(self.reference)
        return (self.value - known) / abs(known) if known else self.value

    @property
    def holds(self) -> bool:
        """True if the value agrees with the reference."""
        if self.reference[0] in "<>":
            bound = float(self.reference[1:])
            return self.value < bound if self.reference[0] == "<" else self.value > bound
        if self.within is not None:
            return abs(self.difference) <= self.within
        exponent = Decimal(self.reference).as_tuple().exponent
        return abs(self.value - float(self.reference)) <= 1.000001 * 10.0 ** int(exponent)

    def cells(self) -> tuple[str, ...]:
        """Return the row of a table: two digits more than the source prints, misses in bold."""
        if self.reference[0] in "<>":
            shown, difference = f"{self.value:.4g}", "holds"
        else:
            digits = len(Decimal(self.reference).as_tuple().digits)
            shown = f"{self.value:.{min(digits + 2, 12)}g}"
            off = self.difference
            difference = (
                f"{100 * off:+.2f} %" if abs(off) >= 1e-3 else f"{off:+.1e}" if off else "0"
            )
        if not self.holds:
            difference = f"**{difference if difference != 'holds' else 'misses'}**"
        printed = self.reference.removeprefix(".")
        printed = printed if printed == self.reference else f"0.{printed}"
        return self.quantity, printed, shown, difference


@dataclass(frozen=True)
class Section:
    """Results of a case."""

    title: str  # title of the section
    source: str  # source of the references
    text: str  # description of the problem and of its tolerances
    rows: list[Row]  # all values
    note: str = ""  # what is surprising
    seconds: float = 0.0  # run time [s]


def summary(
    number: int, name: str, section: Section, shown: Sequence[str]
) -> list[tuple[str, ...]]:
    """Return the rows of a case in the table of the page: values shown, and values that are off."""
    good = sum(row.holds for row in section.rows)
    anchor = f"{number}-" + "".join(
        c if c.isalnum() or c == "-" else "-" if c == " " else "" for c in section.title.lower()
    )
    bold = "" if good == len(section.rows) else "**"
    count = f"{bold}{good}{bold} of {len(section.rows)}"
    found = {row.quantity: row for row in section.rows}
    chosen = [found[quantity] for quantity in shown]
    chosen += [row for row in section.rows if not row.holds and row not in chosen]
    title = f"[{number}. {section.title}](#{anchor})"
    first = f"{title} ({section.source}), [{count}](verification/{name}.json)"
    return [("" if k else first, *row.cells()) for k, row in enumerate(chosen)]


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [header, ["---"] * len(header), *rows]
    return [f"| {' | '.join(cells)} |" for cells in lines]
