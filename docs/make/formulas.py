"""Formulas as MathML with a font, so that pages need no script to show them."""

import html
import io
import re
from importlib import resources

from fontTools import subset
from latex2mathml.converter import convert

MARKED = re.compile(
    r'<(span|div) class="arithmatex">(?:\\\((?P<inline>.*?)\\\)|\\\[(?P<block>.*?)\\\])</\1>', re.S
)
TAG = re.compile(r"\\tag\{(.*?)\}")
BAR = re.compile(r"<mo[^>]*>(&#x0?2016;|&#x0*7C;)</mo>")  # norms: do not stretch
NAME = re.compile(
    r"<m[io]>(ln|log|exp|sin|cos|tan|det|min|max)</m[io]>"
)  # function names: with space around them
ITALIC = [
    0x210E,
    *range(0x1D434, 0x1D468),
    *range(0x1D6E2, 0x1D71C),
]  # code points of italic letters


def mathml(text: str) -> str:
    """Return HTML in which the formulas that arithmatex marked are MathML."""
    return MARKED.sub(_drawn, text)


def _drawn(match: re.Match) -> str:
    if match["inline"] is not None:
        return _converted(match["inline"])
    tag = TAG.search(match["block"])
    drawn = _converted(TAG.sub("", match["block"]), display="block")
    number = f'<span class="tag">({tag[1]})</span>' if tag else ""
    return f'<div class="formula">{drawn}{number}</div>'


def _converted(source: str, **options: str) -> str:
    drawn = convert(html.unescape(source).strip(), **options)
    drawn = BAR.sub(r'<mo stretchy="false" lspace="0" rspace="0">\1</mo>', drawn)
    return NAME.sub(r'<mo lspace="0.17em" rspace="0.17em">\1</mo>', drawn)


def font(pages: str) -> bytes:
    """Return STIX Two Math (SIL Open Font License) as WOFF, with the characters of the formulas.

    Browsers need a font with an OpenType MATH table, which many machines lack.

    Args:
        pages: HTML of all pages.
    """
    used = {ord(sign) for drawn in re.findall(r"<math.*?</math>", pages, re.S) for sign in drawn}
    used |= {ord(html.unescape(code)) for code in set(re.findall(r"&#x\w+;", pages))}
    options = subset.Options(flavor="woff", layout_features=["*"], name_IDs=["*"])
    with resources.files("ziamath.fonts").joinpath("STIXTwoMath-Regular.ttf").open("rb") as file:
        whole = subset.load_font(io.BytesIO(file.read()), options)
    cut = subset.Subsetter(options)
    cut.populate(unicodes=[*used, *ITALIC])
    cut.subset(whole)
    made = io.BytesIO()
    subset.save_font(whole, made, options)
    return made.getvalue()
