"""Whether a data set is biased: how many loads of each amplitude were accepted."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

BINS = 10
ENOUGH = 0.9  # accepted part of a bin below which the set is biased
FEW = 10  # loads below which a bin says nothing


class AmplitudeBin(NamedTuple):
    """Loads of one range of amplitudes.

    Attributes:
        low, high: ||f|| / ||Phi q_max|| [-].
        tried, accepted: Loads.
    """

    low: float
    high: float
    tried: int
    accepted: int

    @property
    def biased(self) -> bool:
        """Whether too many were rejected to call the data set fair."""
        return self.tried >= FEW and self.accepted < ENOUGH * self.tried


def amplitude_bins(amplitudes: Sequence[float], accepted: Sequence[bool]) -> list[AmplitudeBin]:
    """Return ten equal ranges from 0 to the largest amplitude, those without a load left out."""
    if not len(amplitudes):
        return []
    largest = max(amplitudes) or 1.0
    edges = np.linspace(0.0, largest, BINS + 1)
    place = np.clip(np.digitize(amplitudes, edges) - 1, 0, BINS - 1)
    tried = np.bincount(place, minlength=BINS)
    kept = np.bincount(place, weights=np.asarray(accepted, dtype=float), minlength=BINS)
    return [
        AmplitudeBin(float(edges[k]), float(edges[k + 1]), int(tried[k]), int(kept[k]))
        for k in range(BINS)
        if tried[k]
    ]


def acceptance_table(parts: Sequence[AmplitudeBin]) -> list[str]:
    """Return the acceptance by amplitude, a line for the ranges, one for the parts."""
    if not parts:
        return []
    heads = [f"{part.high:.2f}" for part in parts]
    cells = [f"{part.accepted}/{part.tried}" for part in parts]
    widths = [max(len(a), len(b)) for a, b in zip(heads, cells, strict=True)]
    rows = (("amplitude up to", heads), ("accepted", cells))
    return [
        f"{name:>15}  " + "  ".join(text.rjust(w) for text, w in zip(row, widths, strict=True))
        for name, row in rows
    ]


def bias_warning(parts: Sequence[AmplitudeBin]) -> str:
    """Return what is wrong with a biased data set and what to do; empty if it is fair."""
    if not (poor := [part for part in parts if part.biased]):
        return ""
    worst = min(poor, key=lambda part: part.accepted / part.tried)
    return (
        f"biased: of {worst.tried} loads with amplitudes {worst.low:.2f} to {worst.high:.2f} only "
        f"{worst.accepted} were accepted, so such loads are rare in the set; lower "
        "loads.deflection, or look at the reasons in the manifest"
    )
