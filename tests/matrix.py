"""Run the tests under other processor features, thread numbers and loads, and compare outcomes.

    python tests/matrix.py                     all configurations that this processor can run
    python tests/matrix.py avx2 "2 threads"    two of them
    python tests/matrix.py --busy 0 4          each alone, and beside four busy processes
    python tests/matrix.py avx2 -- -k pod      further arguments go to pytest

Each configuration leaves a JUnit file below build/matrix, in a folder for each set of arguments
of pytest. A configuration whose file is newer than all sources is not run again, so that a matrix
that was interrupted continues where it stopped.
The exit status is 1 if a test failed or a configuration gave no result.
"""

import argparse
import hashlib
import itertools
import os
import platform
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = (
    "dpl/**/*.py",
    "benchmarks/**/*.py",
    "tests/**/*.py",
    "conf/**/*.yaml",
    "scripts/*.py",
    "pyproject.toml",
)
LEFT_OUT = (
    "tests/repository"  # reads documents and packages; compares neither numbers nor processes
)
AVX512 = "avx512f"  # the flag in /proc/cpuinfo
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
NEEDS = {"avx512": AVX512, "avx512, 2 threads": AVX512, "openblas skylakex": AVX512}
BUSY = """
import os
parent = os.getppid()
while os.getppid() == parent:
    sum(range(1_000_000))
"""

Outcomes = dict[str, str]


def possible() -> list[str]:
    """Return the names of the configurations that this processor can run."""
    try:
        flags = Path("/proc/cpuinfo").read_text().split()
    except OSError:
        flags = []
    return [name for name in CONFIGURATIONS if NEEDS.get(name) in (None, *flags)]


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


def newest() -> float:
    """Return when the last source was changed, in seconds since 1970."""
    return max(path.stat().st_mtime for pattern in SOURCES for path in ROOT.glob(pattern))


def run(result: Path, variables: Mapping[str, str], workers: int, more: Sequence[str]) -> int:
    """Run pytest in one configuration, and return its exit status.

    Args:
        result: The JUnit file; its time of modification is that at which the run began.
        variables: Added to the environment.
        workers: Processes that share the tests.
        more: Further arguments of pytest.
    """
    begun, part = time.time(), result.with_suffix(".part")
    chosen = ["-m", "not slow and not gpu", "-p", "no:cacheprovider", f"--junitxml={part}"]
    spread = ["-n", str(workers), "--dist", "worksteal"] if workers > 1 else []
    command = [
        sys.executable,
        "-m",
        "pytest",
        *chosen,
        *spread,
        f"--ignore={ROOT / LEFT_OUT}",
        *more,
    ]
    with result.with_suffix(".log").open("w") as log:
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, **variables},
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    try:
        status = process.wait()
    finally:
        with suppress(ProcessLookupError):  # the processes that share the tests end with it
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if part.exists():
        os.utime(part, (begun, begun))
        part.replace(result)
    return status


def outcomes(result: Path) -> tuple[Outcomes, float]:
    """Return what became of each test of a JUnit file, and the minutes that all took."""
    (suite,) = ElementTree.parse(result).getroot().iter("testsuite")
    found: Outcomes = {}
    for case in suite.iter("testcase"):
        name = f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name')}"
        kinds = {child.tag for child in case}
        bad = kinds & {"failure", "error"}
        found[name] = "failed" if bad else "skipped" if "skipped" in kinds else "passed"
    return found, float(suite.get("time", 0)) / 60


def table(found: Mapping[str, tuple[Outcomes, float]]) -> Iterator[str]:
    """Yield the lines of a table with one row per configuration."""
    yield f"{'configuration':<32}{'passed':>8}{'failed':>8}{'skipped':>9}{'minutes':>9}"
    for name, (tests, minutes) in found.items():
        counts = [list(tests.values()).count(kind) for kind in ("passed", "failed", "skipped")]
        yield f"{name:<32}{counts[0]:>8}{counts[1]:>8}{counts[2]:>9}{minutes:>9.1f}"


def differences(found: Mapping[str, tuple[Outcomes, float]]) -> Iterator[str]:
    """Yield each test that failed or whose outcome differs between configurations, and where."""
    tests = dict.fromkeys(name for part, _ in found.values() for name in part)
    for test in tests:
        kinds = {name: part.get(test, "absent") for name, (part, _) in found.items()}
        if len(set(kinds.values())) > 1 or "failed" in kinds.values():
            yield test
            for kind in dict.fromkeys(kinds.values()):
                yield f"    {kind}: {'; '.join(name for name in kinds if kinds[name] == kind)}"


def requested(arguments: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Return the options of the command line, and what stands behind `--` for pytest."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add, known = parser.add_argument, ", ".join(CONFIGURATIONS)
    add("names", nargs="*", metavar="configuration", help=f"all if left out; one of {known}")
    add("--busy", type=int, nargs="+", default=[0], help="processes that never rest beside it")
    add("--workers", type=int, default=2, help="processes that share the tests")
    add("--again", action="store_true", help="run what has a result as well")
    place = list(arguments).index("--") if "--" in arguments else len(arguments)
    options = parser.parse_args(arguments[:place])
    for name in options.names:
        if name not in CONFIGURATIONS:
            parser.error(f"configuration = {name!r} must be one of {known}")
    return options, list(arguments[place + 1 :])


def main(arguments: Sequence[str]) -> int:
    """Run what is requested, print the table and the differences, and return the exit status."""
    options, more = requested(arguments)
    names = options.names or possible()
    digest = hashlib.sha256("\0".join(more).encode()).hexdigest()[:12]
    folder = ROOT / "build/matrix" / (digest if more else "all")
    folder.mkdir(parents=True, exist_ok=True)
    print(f"{platform.machine()}, {os.cpu_count()} cores")
    for name in sorted(set(CONFIGURATIONS) - set(possible())):
        print(f"{name}: this processor cannot")
    found: dict[str, tuple[Outcomes, float]] = {}
    lost = []
    for name, count in itertools.product(names, options.busy):
        title = f"{name}, beside {count} busy" if count else name
        result = folder / f"{title.replace(', ', '-').replace(' ', '-')}.xml"
        if options.again or not result.exists() or result.stat().st_mtime < newest():
            result.unlink(missing_ok=True)
            with busy(count):
                status = run(result, CONFIGURATIONS[name], options.workers, more)
        if result.exists():
            found[title] = outcomes(result)
            print(list(table({title: found[title]}))[1], flush=True)
        else:
            lost.append(f"{title}: no result, exit status {status}; see {result.stem}.log")
    print("", *table(found), *lost, sep="\n")
    reported = list(differences(found))
    print("", "failed, or not the same:" if reported else "no outcome differs", *reported, sep="\n")
    return int(bool(lost) or any("failed" in tests.values() for tests, _ in found.values()))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # takes pytest along
    sys.exit(main(sys.argv[1:]))
