"""Size of a package: modules, lines, lengths of functions and public names per folder.

python -m benchmarks.code_size          # of dpl
python -m benchmarks.code_size OTHER    # of another folder, such as an earlier checkout's dpl
"""

import ast
import statistics
import sys
from pathlib import Path


def function_lengths(tree: ast.AST) -> list[int]:
    """Return the numbers of lines of all functions of a module, docstrings included."""
    functions = (ast.FunctionDef, ast.AsyncFunctionDef)
    return [
        (node.end_lineno or node.lineno) - node.lineno + 1
        for node in ast.walk(tree)
        if isinstance(node, functions)
    ]


def public_names(package: Path) -> int:
    """Return the number of names in `__all__` or below `if TYPE_CHECKING` of an `__init__.py`."""
    tree = ast.parse((package / "__init__.py").read_text())
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("dpl"):
            names |= {alias.asname or alias.name for alias in node.names}
    return len({name for name in names if not name.startswith("_")} - {"public_names"})


def main(root: Path) -> None:
    """Print the numbers of a package."""
    modules = {path: path.read_text() for path in sorted(root.rglob("*.py"))}
    lengths = [n for text in modules.values() for n in function_lengths(ast.parse(text))]
    lines = {path: len(text.splitlines()) for path, text in modules.items()}
    quantiles = statistics.quantiles(lengths, n=20)
    print(f"modules            {len(modules):8,}")
    print(f"lines              {sum(lines.values()):8,}")
    print(f"longest module     {max(lines.values()):8,}")
    print(f"functions          {len(lengths):8,}")
    print(f"median function    {statistics.median(lengths):8.0f} lines")
    print(f"95th percentile    {quantiles[-1]:8.0f} lines")
    print("\npublic names per folder")
    for package in sorted({path.parent for path in modules if path.name == "__init__.py"}):
        name = ".".join((root.name, *package.relative_to(root).parts))
        print(f"  {name:28}{public_names(package):4}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "dpl"))
