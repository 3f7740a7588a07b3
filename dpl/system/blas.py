"""Detection of a BLAS library whose kernels are older than the processor."""

import os
from pathlib import Path

from threadpoolctl import threadpool_info

# OpenBLAS kernels by flag of the CPU, best first
KERNELS = {"avx512dq": "SkylakeX", "avx2": "Haswell"}
CPUINFO = Path("/proc/cpuinfo")
# kernels that OpenBLAS selects for CPUs that it does not know
OLD_KERNELS = {"generic", "prescott", "core2", "penryn", "dunnington", "atom", "nehalem"}


def slow_blas() -> str | None:
    """Return a line of advice if OpenBLAS does not recognise this CPU, else None."""
    if "OPENBLAS_CORETYPE" in os.environ or not CPUINFO.exists():
        return None
    lines = CPUINFO.read_text().splitlines()
    flags = next((line.split() for line in lines if line.startswith("flags")), [])
    best = next((kernels for flag, kernels in KERNELS.items() if flag in flags), None)
    for library in threadpool_info():
        kernels = str(library.get("architecture", ""))
        if library["internal_api"] == "openblas" and best and kernels.lower() in OLD_KERNELS:
            return (
                f"OpenBLAS runs its {kernels} kernels on a CPU with newer instructions: "
                f"set OPENBLAS_CORETYPE={best} before Python starts"
            )
    return None
