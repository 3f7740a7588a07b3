"""Commands that measure this repository; `scripts/` calls them in a checkout."""

from pathlib import Path

CONF = Path(__file__).parents[1] / "conf"
