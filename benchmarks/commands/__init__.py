"""Commands that judge this repository: what `scripts/` call in a checkout."""

from pathlib import Path

CONF = Path(__file__).parents[1] / "conf"
