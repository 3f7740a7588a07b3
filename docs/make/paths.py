"""Where things lie."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
CONF = ROOT / "conf"
RESULTS = ROOT / "benchmarks" / "results"
COMMANDS = {  # folders of commands: folder of their configurations
    ROOT / "dpl" / "commands": CONF,
    ROOT / "benchmarks" / "commands": ROOT / "benchmarks" / "conf",
}
NOTEBOOKS = ROOT / "notebooks"
PACKAGE = ROOT / "dpl"

INCLUDED = {  # page of the site -> file of the repository
    "house.md": "DESIGN.md",
    "readme.md": "README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
}

GENERATED = ("options.md", "commands.md", "results.md")  # pages that are made of what is there
