"""The folder of the configurations."""

from pathlib import Path

PACKAGE = Path(__file__).parents[1]
CONF = next(  # in a wheel inside the package, in a checkout beside it
    path for path in (PACKAGE / "conf", PACKAGE.parent / "conf") if path.is_dir()
)
