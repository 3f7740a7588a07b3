"""The pictures of docs/gallery.md, each made by the code below it.

`python docs/make/gallery.py`, a part of `make pictures`, runs the page and writes docs/gallery/. A
picture contains the digest of its code; a test finds pictures of other code by it.
"""

import hashlib
import io
import os
import re
import tempfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from paths import DOCS

PAGE = DOCS / "gallery.md"
FOLDER = DOCS / "gallery"
BLOCK = re.compile(
    r"(?:^!\[(?P<title>[^\]]+)\]\(gallery/(?P<name>[\w-]+)\.webp\)\n\n)?"
    r"^```python\n(?P<code>.*?)^```$",
    re.M | re.S,
)
DPI = 150  # dots per inch of a picture
SCREEN = 100  # dots per inch at which the site shows it
MARGIN = 12  # white pixels around it
QUALITY = 88  # of WebP, from 0 to 100
DIGEST = 0x010E  # tag of Exif that contains the digest: a description


@dataclass(frozen=True)
class Entry:
    """A picture and its code.

    Attributes:
        title: Title of its section.
        name: Stem of the picture's file, and anchor of the section.
        code: The lines below the picture, which assign `figure`.
        before: The lines of all blocks above without a picture.
    """

    title: str
    name: str
    code: str
    before: str

    @property
    def digest(self) -> str:
        """SHA-256 of all its code, in hexadecimal."""
        return hashlib.sha256((self.before + self.code).encode()).hexdigest()

    @property
    def script(self) -> str:
        """The code as a file that shows the picture."""
        return f'"""{self.title}"""\n\n{self.before}\n{self.code}plt.show()\n'

    @property
    def path(self) -> Path:
        """Path of the picture."""
        return FOLDER / f"{self.name}.webp"


def entries() -> list[Entry]:
    """Return the entries of the page."""
    found, before = [], ""
    for match in BLOCK.finditer(PAGE.read_text(encoding="utf-8")):
        if match["name"]:
            found.append(Entry(match["title"], match["name"], match["code"], before))
        else:
            before += match["code"]
    return found


def figures(names: Collection[str] | None = None) -> Iterator[tuple[Entry, Any]]:
    """Yield entries with their figures; the code writes into the working directory.

    Args:
        names: Names of the entries; None: all.
    """
    import torch
    from matplotlib import pyplot as plt
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(1)
    threadpool_limits(1)  # small problems: threads would cost more than they save
    done, common = "", {}
    for entry in entries():
        if names is not None and entry.name not in names:
            continue
        exec(compile(entry.before.removeprefix(done), str(PAGE), "exec"), common)
        done = entry.before
        own = dict(common)
        exec(compile(entry.code, f"{PAGE}: {entry.title}", "exec"), own)
        yield entry, own["figure"]
        plt.close("all")


def picture(figure: Any, digest: str) -> bytes:
    """Return a figure as WebP without empty margins; it contains the digest of its code."""
    from PIL import Image, ImageChops

    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI, facecolor="white")
    image = Image.open(drawn).convert("RGB")
    box = ImageChops.difference(image, Image.new("RGB", image.size, "white")).getbbox()
    inside = image.crop(box)
    cut = Image.new("RGB", [side + 2 * MARGIN for side in inside.size], "white")
    cut.paste(inside, (MARGIN, MARGIN))
    made, notes = io.BytesIO(), Image.Exif()
    notes[DIGEST] = digest
    cut.save(made, format="webp", quality=QUALITY, exif=notes)
    return made.getvalue()


def stored_digest(entry: Entry) -> str | None:
    """Return the digest of the code that made the picture of an entry; None without a picture."""
    from PIL import Image

    if not entry.path.is_file():
        return None
    with Image.open(entry.path) as image:
        return image.getexif().get(DIGEST)


def shown(text: str) -> str:
    """Return the page with a grid of links to its pictures, and with the widths of the pictures."""
    from PIL import Image

    tiles = []
    for entry in entries():
        tile = f"[![](gallery/{entry.name}.webp)<br>{entry.title}](#{entry.name})"
        tile += f' <a href="gallery/{entry.name}.py" download>code</a>'
        tiles.append(f'<div markdown="span">{tile}</div>')
        with Image.open(entry.path) as image:
            width = image.width * SCREEN // DPI
        link = f"![{entry.title}](gallery/{entry.name}.webp)"
        text = text.replace(link, f"{link}{{ width={width} }}")
    grid = '<div class="tiles" markdown>\n\n' + "\n".join(tiles) + "\n\n</div>\n\n"
    head, first, rest = text.partition("# Gallery\n\n")
    return head + first + grid + rest


def main() -> None:
    """Make all pictures and remove those of no entry."""
    import matplotlib

    matplotlib.use("Agg")
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        Path("cad").symlink_to(DOCS / "cad")
        for entry, figure in figures():
            entry.path.write_bytes(picture(figure, entry.digest))
            print(f"{entry.path.name}: {entry.path.stat().st_size / 1e3:.0f} kB")
    for path in {*FOLDER.glob("*.webp")} - {entry.path for entry in entries()}:
        path.unlink()


if __name__ == "__main__":
    main()
