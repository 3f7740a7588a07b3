"""Pictures as small PNG files."""

import io
from typing import Any

COLOURS = 256  # colours of the palette of a picture


def small_png(image: Any, **notes: str) -> bytes:
    """Return a picture as PNG with a palette, and texts with their names.

    Args:
        image: Picture of Pillow, of any mode; transparent pixels become white.
        notes: Texts that the file contains.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    opaque = Image.new("RGBA", image.size, "white")
    opaque.alpha_composite(image.convert("RGBA"))
    info = PngInfo()
    for name, text in notes.items():
        info.add_text(name, text)
    method = Image.Quantize.MAXCOVERAGE  # keeps colours of small areas, such as ends of a scale
    drawn = opaque.convert("RGB").quantize(COLOURS, method, 2, dither=Image.Dither.NONE)
    made = io.BytesIO()
    drawn.save(made, "PNG", optimize=True, pnginfo=info)
    return made.getvalue()
