"""Run the tests under other processor features, thread numbers and loads, and compare outcomes.

    python tests/matrix.py                     all configurations that this processor can run
    python tests/matrix.py avx2 "2 threads"    two of them
    python tests/matrix.py --busy 0 4          each alone, and beside four busy processes
    python tests/matrix.py avx2 -- -k pod      further arguments go to pytest

Each configuration leaves a JUnit file below build/matrix. The exit status is 1 if a test failed or
a configuration gave no result.
"""

import argparse
import itertools
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]
LEFT_OUT = "tests/repository"  # reads documents and packages; compares no numbers
CONFIGURATIONS: dict[str, dict[str, str]] = {
    "default": {},
    "2 threads": {"DPL_TEST_THREADS": "2"},
    "avx2": {"ATEN_CPU_CAPABILITY": "avx2"},
    "avx2, 2 threads": {"ATEN_CPU_CAPABILITY": "avx2", "DPL_TEST_THREADS": "2"},
    "avx512": {"ATEN_CPU_CAPABILITY": "avx512"},
    "avx512, 2 threads": {"ATEN_CPU_CAPABILITY": "avx512", "DPL_TEST_THREADS": "2"},
    "mkl compatible": {"MKL_CBWR": "COMPATIBLE"},
    "openblas haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "openblas skylakex": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "numba generic": {"NUMBA_CPU_NAME": "generic"},
}
AVX512 = ("avx512", "avx512, 2 threads", "openblas skylakex")  # need this feature
BUSY = """
import os
parent = os.getppid()
while os.getppid() == parent:
    sum(range(1_000_000))
"""

Outcomes = dict[str, str]


def possible() -> list[str]:
    """Return the names of the configurations that this processor can run."""
    cpu = Path("/proc/cpuinfo")
    has_avx512 = cpu.exists() and "avx512f" in cpu.read_text().split()
    return [name for name in CONFIGURATIONS if has_avx512 or name not in AVX512]


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Keep so many processes busy meanwhile."""
    processes = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def run(result: Path, variables: Mapping[str, str], workers: int, more: Sequence[str]) -> None:
    """Run pytest in one configuration; it writes a JUnit file and a log beside it."""
    result.unlink(missing_ok=True)
    spread = ["-n", str(workers), "--dist", "worksteal"] if workers > 1 else []
    options = ["-m", "not slow and not gpu", "-p", "no:cacheprovider", f"--junitxml={result}"]
    command = [sys.executable, "-m", "pytest", *options, *spread, f"--ignore={ROOT / LEFT_OUT}"]
    with result.with_suffix(".log").open("w") as log:
        subprocess.run(
            [*command, *more], cwd=ROOT, env={**os.environ, **variables}, stdout=log, stderr=log,
            check=False,
        )  # fmt: skip


def outcomes(result: Path) -> Outcomes:
    """Return what became of each test of a JUnit file."""
    found: Outcomes = {}
    for case in ElementTree.parse(result).getroot().iter("testcase"):
        kinds = {child.tag for child in case}
        bad, skipped = kinds & {"failure", "error"}, "skipped" in kinds
        name = f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name')}"
        found[name] = "failed" if bad else "skipped" if skipped else "passed"
    return found


def differences(found: Mapping[str, Outcomes]) -> Iterator[str]:
    """Yield each test that failed or whose outcome differs between configurations, and where."""
    for test in dict.fromkeys(itertools.chain.from_iterable(found.values())):
        kinds = {name: part.get(test, "absent") for name, part in found.items()}
        if len(set(kinds.values())) > 1 or "failed" in kinds.values():
            yield f"{test}: {kinds}"


def main(arguments: Sequence[str]) -> int:
    """Run what is requested, print the counts and the differences, and return the exit status."""
    place = list(arguments).index("--") if "--" in arguments else len(arguments)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", choices=[[], *CONFIGURATIONS], metavar="configuration")
    parser.add_argument("--busy", type=int, nargs="+", default=[0], help="busy processes beside it")
    parser.add_argument("--workers", type=int, default=2, help="processes that share the tests")
    options, more = parser.parse_args(arguments[:place]), arguments[place + 1 :]
    folder = ROOT / "build/matrix"
    folder.mkdir(parents=True, exist_ok=True)
    found: dict[str, Outcomes] = {}
    lost = []
    for name, count in itertools.product(options.names or possible(), options.busy):
        title = f"{name}, beside {count} busy" if count else name
        result = folder / f"{title.replace(', ', '-').replace(' ', '-')}.xml"
        with busy(count):
            run(result, CONFIGURATIONS[name], options.workers, more)
        if not result.exists():
            lost.append(f"{title}: no result; see {result.stem}.log")
            continue
        found[title] = outcomes(result)
        kinds = list(found[title].values())
        counts = [f"{kinds.count(kind)} {kind}" for kind in ("passed", "failed", "skipped")]
        print(f"{title:<32} {', '.join(counts)}", flush=True)
    print(*lost, *(list(differences(found)) or ["no outcome differs"]), sep="\n")
    failed = any("failed" in tests.values() for tests in found.values())
    return int(bool(lost) or failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
