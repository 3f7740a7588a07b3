"""The version, the folder of the configurations, and how more of the package is installed.

Kept apart from the package's front, so that files that record the version can read it.
"""

from pathlib import Path

__version__ = "0.1.0"

ROOT = Path(__file__).parents[1]
# in a wheel inside the package, in a checkout beside it
CONF = next(filter(Path.is_dir, [ROOT / "dpl" / "conf"]), ROOT / "conf")


def install(extra: str) -> str:
    """Return the command that installs an extra, in a checkout or beside an installed wheel."""
    checkout = all((ROOT / name).is_file() for name in ("pyproject.toml", "constraints.txt"))
    where = f"-c constraints.txt -e '.[{extra}]'" if checkout else f"'deepphysics[{extra}]'"
    return f"pip install {where}"
