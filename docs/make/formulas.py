"""Formulas as MathML, made with the page: no script draws them, and their font lies beside them."""

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
BAR = re.compile(r"<mo[^>]*>(&#x0?2016;|&#x0*7C;)</mo>")  # of norms: as high as letters
NAME = re.compile(r"<m[io]>(ln|log|exp|sin|cos|tan|det|min|max)</m[io]>")  # with space around
ITALIC = [0x210E, *range(0x1D434, 0x1D468), *range(0x1D6E2, 0x1D71C)]  # what single letters become


def mathml(text: str) -> str:
    """Return a page's HTML with the formulas that arithmatex has marked as MathML."""
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
    """Return STIX Two Math (SIL Open Font License) as WOFF, cut down to what formulas hold.

    Browsers need a font with a table of mathematics, and not every machine has one.

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
