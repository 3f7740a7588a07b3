"""Lazy import of the public names of a package."""

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path


def public_names(package: str) -> tuple[list[str], Callable[[str], object], Callable[[], list]]:
    """Return `__all__`, `__getattr__` and `__dir__` of a package, as PEP 562 describes them.

    The names are those that the package's `__init__.py` imports under `if TYPE_CHECKING:`, so that
    type checkers and editors read the same list.
    """
    file = sys.modules[package].__file__
    assert file is not None
    sources: dict[str, str] = {}
    for node in ast.parse(Path(file).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            for line in node.body:
                if isinstance(line, ast.ImportFrom) and line.module is not None:
                    sources |= {alias.name: line.module for alias in line.names}

    def get(name: str) -> object:
        if name not in sources:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found = getattr(importlib.import_module(sources[name]), name)
        setattr(sys.modules[package], name, found)
        return found

    return sorted(sources), get, lambda: sorted({*sources, *vars(sys.modules[package])})
