"""The output of a command as a picture of a terminal.

make train 2>&1 | tee first.txt
python docs/make/terminal.py docs/train.svg "make train" < first.txt

The picture has 100 columns, and the colours of escape sequences. It uses a font of the reader's
machine and requests nothing from another host. Lines that a progress bar has overwritten are left
out.
"""

import io
import re
import sys
from pathlib import Path

COLUMNS = 100
FACES = re.compile(r"@font-face \{.*?\}\s*", re.S)  # of rich, on another host
FONT = "ui-monospace, SFMono-Regular, Menlo, Consolas, 'DejaVu Sans Mono', monospace"


def svg(text: str, title: str) -> str:
    """Return the picture of a text with escape sequences, under a title."""
    from rich.console import Console
    from rich.terminal_theme import MONOKAI
    from rich.text import Text

    console = Console(record=True, width=COLUMNS, file=io.StringIO(), force_terminal=True)
    last = (line.rstrip("\r").rpartition("\r")[2] for line in text.rstrip().split("\n"))
    console.print(Text.from_ansi("\n".join(last)), soft_wrap=False)
    drawn = console.export_svg(title=title, theme=MONOKAI, unique_id="terminal")
    return FACES.sub("", drawn).replace("Fira Code, monospace", FONT)


def main() -> None:
    """Read a text from standard input and write its picture."""
    path, title = sys.argv[1:]
    Path(path).write_text(svg(sys.stdin.read(), title), encoding="utf-8")


if __name__ == "__main__":
    main()
