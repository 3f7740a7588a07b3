"""Change the source one operator at a time, and report which changes no test notices.

    python tests/mutants.py                                  # all modules of [tool.mutants]
    python tests/mutants.py dpl/training/metrics.py --sample 60   # one module, 60 of its mutants
    python tests/mutants.py dpl/training/metrics.py --survivors   # those that survived last time

The mutants are made by the operators of mutmut. mutmut itself replaces each function by a
trampoline, which numba cannot compile, and skips properties and class bodies; here a mutant is the
whole text of its module. Each one is judged in a process forked after torch and the other
libraries are imported, by the tests that `[tool.mutants.modules]` in pyproject.toml names. The
processes that a test starts itself import the unchanged source.

Annotations, decorators, imports, `__all__` and docstrings are not changed. Nor is what a `raise`
statement evaluates, which is the text of a message; the table counts those mutants as "text".
"""

import argparse
import difflib
import gc
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import json
import os
import random
import resource
import signal
import sys
import time
import tomllib
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import accumulate
from pathlib import Path
from typing import Any

import libcst as cst
import pytest
from libcst.metadata import CodePosition, MetadataWrapper, WhitespaceInclusivePositionProvider
from mutmut.mutation.mutators import mutation_operators

ROOT = Path(__file__).parents[1]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["mutants"]
UNCHANGED = (cst.Annotation, cst.Decorator, cst.Import, cst.ImportFrom)
CALLS = {"cast", "isinstance", "len"}  # whose arguments are left alone, as mutmut does
OPTIONS = [  # without plugins that collect garbage after each session
    *("-x", "-q", "-W", "ignore::pytest.PytestAssertRewriteWarning", "-p", "no:cacheprovider"),
    *("-p", "no:unraisableexception", "--durations=3"),
]
MEMORY = 16 * 2**30  # bytes of address space of one judging process


class Changes(cst.CSTVisitor):
    """Collects changes as (start, end, new code), and counts those in `raise` statements."""

    METADATA_DEPENDENCIES = (WhitespaceInclusivePositionProvider,)

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[CodePosition, CodePosition, str]] = []
        self.text = 0
        self._raised = 0

    def on_visit(self, node: cst.CSTNode) -> bool:
        """Collect the changes of a node; return whether to go on to its children."""
        if isinstance(node, UNCHANGED) or _is_left_alone(node):
            return False
        self._raised += isinstance(node, cst.Raise)
        made = [
            cst.Module([]).code_for_node(changed)
            for kind, operator in mutation_operators
            if isinstance(node, kind)
            for changed in operator(node)
        ]
        if self._raised:
            self.text += len(made)
        elif made:
            span = self.get_metadata(WhitespaceInclusivePositionProvider, node)
            self.found += [(span.start, span.end, code) for code in made]
        return True

    def on_leave(self, original_node: cst.CSTNode) -> None:
        """Count the `raise` statements that are open."""
        self._raised -= isinstance(original_node, cst.Raise)


def _is_left_alone(node: cst.CSTNode) -> bool:
    if isinstance(node, cst.Call) and isinstance(node.func, cst.Name):
        return node.func.value in CALLS
    targets = node.targets if isinstance(node, cst.Assign) else ()
    return any(isinstance(t.target, cst.Name) and t.target.value == "__all__" for t in targets)


def mutants_of(source: str) -> tuple[list[str], int]:
    """Return the changed texts of a module, none twice, and the number of mutants in messages."""
    changes = Changes()
    MetadataWrapper(cst.parse_module(source)).visit(changes)
    starts = list(accumulate((len(line) for line in source.splitlines(True)), initial=0))
    texts: dict[str, None] = {}
    for start, end, code in changes.found:
        first, last = (starts[place.line - 1] + place.column for place in (start, end))
        text = source[:first] + code + source[last:]
        with suppress(SyntaxError):
            compile(text, "mutant", "exec")
            texts[text] = None
    texts.pop(source, None)
    return list(texts), changes.text


class Changed(importlib.abc.MetaPathFinder, importlib.machinery.SourceFileLoader):
    """Gives one module of this process another text than its file has."""

    def __init__(self, path: Path, text: str) -> None:
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        super().__init__(name, str(path))
        self.text = text

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> Any:
        """Return the spec of the changed module; None for the others."""
        if fullname != self.name:
            return None
        return importlib.util.spec_from_file_location(fullname, self.path, loader=self)

    def get_code(self, fullname: str) -> Any:
        """Return the changed code."""
        return compile(self.text, self.path, "exec", dont_inherit=True)


def judged(path: Path, text: str, tests: Sequence[str], limit: float | None, show: bool) -> str:
    """Return "survived", "killed" or "timeout" of one text of a module.

    Args:
        path: The module.
        text: What it says instead of its file.
        tests: Arguments of pytest.
        limit: CPU time after which the process is ended, or ten times as long by the clock, for a
            process that waits [s]; None: no limit.
        show: Whether to print what pytest prints.
    """
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        _run(path, text, tests, limit, show)
    end = time.monotonic() + 10 * (limit or float("inf"))
    status = None
    while status is None and time.monotonic() < end:
        ended, waited = os.waitpid(pid, os.WNOHANG)
        status = waited if ended else time.sleep(0.02)
    with suppress(ProcessLookupError):  # processes that the tests have left
        os.killpg(pid, signal.SIGKILL)
    if status is None:
        os.waitpid(pid, 0)
    if status is None or status == signal.SIGXCPU:
        return "timeout"
    return "survived" if status == 0 else "killed"


def _run(path: Path, text: str, tests: Sequence[str], limit: float | None, show: bool) -> None:
    """Run the tests with a changed module and end this process with their status."""
    status = 1
    try:
        os.setsid()
        if not show:
            quiet = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(quiet, stream)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        if limit:
            used = resource.getrusage(resource.RUSAGE_SELF)
            seconds = int(used.ru_utime + used.ru_stime + limit) + 1
            resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))
        sys.meta_path.insert(0, Changed(path, text))
        status = int(pytest.main([*OPTIONS, *tests]))
    finally:
        os._exit(status)


def difference(path: str, source: str, text: str) -> str:
    """Return the changed lines of a module, with the number of the first."""
    lines = difflib.unified_diff(source.splitlines(), text.splitlines(), lineterm="", n=0)
    changed = [line for line in lines if not line.startswith(("---", "+++"))]
    place = changed[0].split()[1].lstrip("-").split(",")[0]
    return "\n".join([f"{path}:{place}", *changed[1:]])


def survey(path: str, options: argparse.Namespace, before: Any) -> Iterator[dict[str, Any]]:
    """Judge the mutants of a module and yield each with its verdict.

    Raises:
        SystemExit: The tests fail on the unchanged module.
    """
    source, tests = (ROOT / path).read_text(), SETTINGS["modules"][path]
    texts, text = mutants_of(source)
    if options.survivors:
        kept = {one["diff"] for one in before if one["verdict"] == "survived"}
        texts = [one for one in texts if difference(path, source, one) in kept]
    elif options.sample and options.sample < len(texts):
        chosen = random.Random(options.seed).sample(range(len(texts)), options.sample)
        texts = [texts[k] for k in sorted(chosen)]
    if judged(ROOT / path, source, tests, None, True) != "survived":
        raise SystemExit(f"error: {path} unchanged must pass {' '.join(tests)}; mend that first")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    limit = options.limit or 20 + 4 * (used.ru_utime + used.ru_stime)
    for one in texts:
        verdict = judged(ROOT / path, one, tests, limit, False)
        yield {"diff": difference(path, source, one), "verdict": verdict, "text": text}
        print({"survived": "S", "timeout": "T"}.get(verdict, "."), end="", flush=True)
    print(f" {path}", flush=True)


def table(results: dict[str, list[dict[str, Any]]]) -> str:
    """Return the counts of each module and the changes that no test noticed."""
    rows = [f"{'module':28} mutants killed timeout survived kill %   text"]
    for path, found in results.items():
        verdicts = Counter(one["verdict"] for one in found)
        part = 100 * (1 - verdicts["survived"] / len(found)) if found else 100.0
        counts = (len(found), *(verdicts[name] for name in ("killed", "timeout", "survived")))
        text = found[0]["text"] if found else 0
        rows.append("{:28} {:7} {:6} {:7} {:8} {:6.1f} {:6}".format(path, *counts, part, text))
    for found in results.values():
        rows += ["\n" + one["diff"] for one in found if one["verdict"] == "survived"]
    return "\n".join(rows)


def main() -> None:
    """Judge the mutants of the requested modules."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", help="files of [tool.mutants.modules]; all")
    parser.add_argument("--sample", type=int, default=0, help="mutants of each module; 0: all")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument(
        "--limit", type=float, help="CPU seconds for a mutant; 20 + 4 x the tests' own"
    )
    parser.add_argument("--survivors", action="store_true", help="those of the last results alone")
    parser.add_argument("--out", type=Path, default=ROOT / "build/mutants.json", help="results")
    options = parser.parse_args()
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT))
    for name in SETTINGS["preload"]:
        with suppress(ImportError):
            importlib.import_module(name)
    for path in options.modules or SETTINGS["modules"]:
        if (pid := os.fork()) == 0:  # each module blocks imports of its own
            _judge_module(path, options)
        if status := os.waitpid(pid, 0)[1]:
            sys.exit(os.waitstatus_to_exitcode(status))
    results = json.loads(options.out.read_text())
    print(table({path: results[path] for path in options.modules or SETTINGS["modules"]}))


def _judge_module(path: str, options: argparse.Namespace) -> None:
    """Judge the mutants of a module, write the results and end this process."""
    status = 1
    try:
        preload(path)
        out = options.out
        results = json.loads(out.read_text()) if out.exists() else {}
        before = results.get(path, [])
        new = {one["diff"]: one for one in survey(path, options, before)}
        kept = [new.get(one["diff"], one) for one in before]
        results[path] = kept if options.survivors else [*new.values()]
        out.parent.mkdir(exist_ok=True)
        out.write_text(json.dumps(results, indent=1))
        status = 0
    except SystemExit as end:
        print(end, file=sys.stderr)
    except Exception:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(status)


def preload(path: str) -> None:
    """Import all modules of the package that do not import a given one."""
    name = ".".join(Path(path).with_suffix("").parts)
    sys.modules[name] = None  # type: ignore[assignment]
    for file in sorted((ROOT / "dpl").rglob("*.py")):
        if "benchmarks/programs" not in str(file) and file.name != "__init__.py":
            with suppress(ImportError):
                importlib.import_module(".".join(file.relative_to(ROOT).with_suffix("").parts))
    del sys.modules[name]
    gc.collect()
    gc.freeze()


if __name__ == "__main__":
    main()
