"""Size of a package: modules, lines, code lines, lengths of functions, public names by folder.

A code line is no blank line, no comment and no line of a docstring.

python -m benchmarks.code_size          # of dpl
python -m benchmarks.code_size OTHER    # of another folder, such as an earlier checkout's dpl
"""

import ast
import io
import statistics
import sys
import tokenize
from collections import Counter
from pathlib import Path

IGNORED = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}


def code_lines(text: str) -> int:
    """Return the number of lines of a module that hold code."""
    found: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in IGNORED:
            found.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        value = node.value if isinstance(node, ast.Expr) else None
        if isinstance(value, ast.Constant) and isinstance(value.value, str):
            found.difference_update(range(value.lineno, (value.end_lineno or 0) + 1))
    return len(found)


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
    nodes = [node for text in modules.values() for node in ast.walk(ast.parse(text))]
    functions = [n for n in nodes if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef))]
    lengths = [(node.end_lineno or node.lineno) - node.lineno + 1 for node in functions]
    lines = {path: len(text.splitlines()) for path, text in modules.items()}
    quantiles = statistics.quantiles(lengths, n=20)
    print(f"modules            {len(modules):8,}")
    print(f"longest module     {max(lines.values()):8,}")
    print(f"functions          {len(lengths):8,}")
    print(f"median function    {statistics.median(lengths):8.0f} lines")
    print(f"95th percentile    {quantiles[-1]:8.0f} lines")
    of_folder: Counter[str] = Counter()
    of_code: Counter[str] = Counter()
    for path, text in modules.items():
        for folder in (root, *(root / part for part in path.relative_to(root).parents[:-1])):
            name = ".".join((root.name, *folder.relative_to(root).parts))
            of_folder[name] += lines[path]
            of_code[name] += code_lines(text)
    print(f"\n{'folder':28}{'lines':>8}{'code':>8}{'public names':>14}")
    for name in sorted(of_folder):
        package = root.parent / Path(*name.split("."))
        names = public_names(package) if (package / "__init__.py").is_file() else 0
        print(f"{name:28}{of_folder[name]:8,}{of_code[name]:8,}{names:14}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "dpl"))
