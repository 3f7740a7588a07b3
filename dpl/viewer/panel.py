"""What the panel says, as HTML: numbers and names of this package only."""

import html

from dpl.viewer.frames import QUANTITIES, Frame
from dpl.viewer.rasterizer import BANDS, colours

GOOD, DOUBT, BAD = "#15803d", "#b45309", "#b91c1c"
ROW = (
    '<div style="display:flex;justify-content:space-between;gap:12px;line-height:1.65">'
    '<span style="opacity:.62">{}</span>'
    '<span style="font-variant-numeric:tabular-nums;text-align:right;{}">{}</span></div>'
)
BOX = '<div style="padding:2px 12px 6px;font-size:13.5px">{}</div>'


def readout(frame: Frame, rate: float) -> str:
    """Return what an answer is worth."""
    answer = frame.answer
    assert answer is not None
    good = frame.converged
    tone = GOOD if good else BAD if not frame.volume_ratio > 0 else DOUBT
    away = answer.out_of_distribution
    rows = [
        _row("answered by", str(answer.method), "font-weight:600"),
        _row("in", f"{answer.milliseconds:.1f} ms", "font-weight:600"),
        _row("residual ‖R‖/‖f‖", f"{frame.residual:.1e}", f"color:{tone}"),
        _row("min det F", f"{frame.volume_ratio:.3f}"),
        _row("tangents solved", f"{answer.iterations}"),
        _row(
            "range of the training",
            f"{'outside' if away else 'inside'}, {answer.amplitude:.2f}",
            f"color:{BAD if away else GOOD}",
        ),
        _row("answers a second", f"{rate:.0f}"),
    ]
    words = html.escape(str(answer.summary))
    verdict = (
        f'<div style="margin-top:6px;padding:6px 9px;border-radius:6px;border-left:3px solid '
        f'{tone};background:{tone}14;line-height:1.35">{words}</div>'
    )
    return BOX.format("".join(rows) + verdict)


def newton(frame: Frame | None, iterations: int) -> str:
    """Return how far Newton from rest has come."""
    if frame is None:
        return BOX.format(_row("Newton from rest", "waits for the load to rest"))
    tone = GOOD if frame.converged else DOUBT
    state = "in balance" if frame.converged else "iterating"
    rows = [
        _row("Newton from rest", state, f"color:{tone};font-weight:600"),
        _row("iteration", str(iterations)),
        _row("residual ‖R‖/‖f‖", f"{frame.residual:.1e}", f"color:{tone}"),
    ]
    return BOX.format("".join(rows))


def legend(quantity: str, top: float, low: float, high: float) -> str:
    """Return the colours of a quantity, and what it spans on the surface."""
    unit = QUANTITIES[quantity]
    cells = "".join(
        f'<span style="flex:1;background:rgb({r},{g},{b})"></span>'
        for r, g, b in colours(quantity).tolist()
    )
    ticks = "".join(f"<span>{top * k / 4:.3g}</span>" for k in range(5))
    return BOX.format(
        f'<div style="display:flex;justify-content:space-between;margin-bottom:4px">'
        f"<b>{html.escape(quantity)} [{unit}]</b>"
        f'<span style="opacity:.62">{BANDS} bands</span></div>'
        f'<div style="display:flex;height:14px;border-radius:3px;overflow:hidden">{cells}</div>'
        f'<div style="display:flex;justify-content:space-between;font-size:11.5px;opacity:.75">'
        f"{ticks}</div>" + _row("on the surface", f"{low:.3g} to {high:.3g} {unit}")
    )


def message(words: str, tone: str = DOUBT) -> str:
    """Return a line of words."""
    style = f"padding:2px 12px 6px;font-size:13px;color:{tone};line-height:1.35"
    return f'<div style="{style}">{html.escape(words)}</div>' if words else ""


def _row(name: str, value: str, style: str = "") -> str:
    return ROW.format(html.escape(name), style, html.escape(value))
