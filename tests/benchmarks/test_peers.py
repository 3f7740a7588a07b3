"""The benchmark of the mechanics times answers that are right."""

import math
import sys
import textwrap

import pytest

from benchmarks import peers
from benchmarks.study import read
from dpl.fem import Newton, solve


def test_answer_of_a_case_is_the_one_that_the_codes_agree_on():
    """That of the longest case, Saint Venant-Kirchhoff under a large load."""
    case = peers.CASES["S2"]
    problem, load = case.build()
    newtons = load.force.sum(dim=(0, 1)) * 4500.0 * problem.length**2
    assert newtons.tolist() == pytest.approx([0, 0, -20100.0])
    answer = solve(Newton(problem), load)
    assert case.error(problem, answer) < 1e-8


@pytest.fixture
def peer(tmp_path):
    """A program that answers with tips, off by so much, and names its shared libraries."""

    def peer(off=0.0, libraries=("/opt/lib/libmkl_rt.so.2",)):
        tips = {name: [case.tip[0], 0.0, case.tip[1] + off] for name, case in peers.CASES.items()}
        program = tmp_path / "other_beam.py"
        program.write_text(
            textwrap.dedent(f"""
            import json, os, sys
            nan = float("nan")
            tips = {tips}
            cases = json.load(sys.stdin)
            print("noise")
            libraries = {list(libraries)}
            if os.environ.get("LD_LIBRARY_PATH", "").startswith("/opt/openblas-pthread"):
                libraries = ["/opt/openblas-pthread/libblas.so.3"]
            row = {{"iterations": 7, "note": "a note"}}
            rows = {{n: row | {{"seconds": c["force"], "tip": tips[n]}} for n, c in cases.items()}}
            print(json.dumps({{"libraries": libraries, "times": rows}}))
            """)
        )
        return program

    return peer


def test_peer_is_another_program_that_reads_cases_and_writes_times(peer):
    times = peers.time_reference_code(sys.executable, peer(), 1)
    assert set(times) == set(peers.CASES)
    assert times["S1"].seconds == 20100.0
    assert times["S1"].iterations == 7
    assert times["S1"].note == "tip to 0e+00 L, a note, MKL"


REFERENCE = "/usr/lib/x86_64-linux-gnu/blas/libblas.so.3.11.0"


@pytest.mark.parametrize(
    ("libraries", "reported"),
    [
        ([REFERENCE, "/usr/lib/x86_64-linux-gnu/libdmumps-5.5.0.so"], "reference BLAS"),
        (["/usr/lib64/libblas.so.3", "/w/numpy.libs/libscipy_openblas64_.so"], "reference BLAS"),
        (["/usr/lib/x86_64-linux-gnu/openblas-pthread/libblas.so.3"], "OpenBLAS"),
        (["/w/numpy.libs/libscipy_openblas64_-8fb3d286.so"], "OpenBLAS"),
        (["/w/libmkl_rt.so.2", "/w/numpy.libs/libopenblas64_p-r0-15.so"], "MKL and OpenBLAS"),
        (["/usr/lib/x86_64-linux-gnu/blis-openmp/libblas.so.3"], "BLIS"),
        (["/usr/lib/x86_64-linux-gnu/libCombBLAS.so.1.16.0", "/usr/lib/libc.so.6"], None),
    ],
)
def test_a_blas_is_named_after_its_file_and_folder(libraries, reported):
    assert peers.name_of_blas(libraries) == reported


def test_a_peer_with_the_reference_blas_is_given_openblas_which_its_note_names(peer, monkeypatch):
    monkeypatch.setattr(peers, "optimised_blas", lambda: "/opt/openblas-pthread")
    times = peers.time_reference_code(sys.executable, peer(libraries=[REFERENCE]), 1)
    assert times["S1"].note == "tip to 0e+00 L, a note, OpenBLAS"


@pytest.mark.parametrize(
    ("libraries", "flaw"), [([REFERENCE], "the reference BLAS"), ([], "no known BLAS")]
)
def test_a_peer_without_an_optimised_blas_is_not_compared(peer, monkeypatch, libraries, flaw):
    monkeypatch.setattr(peers, "optimised_blas", lambda: None)
    with pytest.raises(OSError, match=f"it uses {flaw}.* libopenblas0") as refused:
        peers.time_reference_code(sys.executable, peer(libraries=libraries), 1)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("off", [1e-5, math.nan])
def test_peer_with_another_answer_is_not_timed(peer, off):
    with pytest.raises(OSError, match="S1: tip"):
        peers.time_reference_code(sys.executable, peer(off), 1)


@pytest.mark.parametrize("end", ["SystemExit('no such library')", "SystemExit(3)"])
def test_peer_that_fails_says_why(tmp_path, end):
    program = tmp_path / "broken_beam.py"
    program.write_text(f"raise {end}\n")
    with pytest.raises(OSError, match=r"no such library|exit status 3"):
        peers.time_reference_code(sys.executable, program, 1)


@pytest.mark.slow
def test_benchmark_script_writes_what_it_prints(script, tmp_path):
    done = script(
        "benchmark", "cases=[scenes,propeller]", "repeats=1", "linear=[auto]", cwd=tmp_path
    )
    assert done.status == 0, done.err
    first = read(peers.Time, tmp_path / "runs/benchmark/scenes.csv")[0]
    assert first.case == "dpl, auto, S1"
    assert math.isfinite(first.seconds)
    assert "dolfinx" in done.out
