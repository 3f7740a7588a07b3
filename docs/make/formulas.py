"""Formulas as MathML, made with the page: no script draws them, no font is fetched."""

import html
import re

from latex2mathml.converter import convert

MARKED = re.compile(
    r'<(span|div) class="arithmatex">(?:\\\((?P<inline>.*?)\\\)|\\\[(?P<block>.*?)\\\])</\1>', re.S
)
TAG = re.compile(r"\\tag\{(.*?)\}")


def mathml(text: str) -> str:
    """Return a page's HTML with the formulas that arithmatex has marked as MathML."""
    return MARKED.sub(_drawn, text)


def _drawn(match: re.Match) -> str:
    if match["inline"] is not None:
        return convert(html.unescape(match["inline"]))
    source = html.unescape(match["block"]).strip()
    tag = TAG.search(source)
    drawn = convert(TAG.sub("", source), display="block")
    number = f'<span class="tag">{tag[1]}</span>' if tag else ""
    return f'<div class="formula">{drawn}{number}</div>'
