"""Folders of the repository, and the pages of the site that do not lie in docs/."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
CONF = ROOT / "conf"
RESULTS = ROOT / "benchmarks" / "results"
NOTEBOOKS = ROOT / "notebooks"
PACKAGE = ROOT / "dpl"

INCLUDED = {  # page of the site -> file of the repository
    "design.md": "DESIGN.md",
    "readme.md": "README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
}
GENERATED = ("options.md",)
