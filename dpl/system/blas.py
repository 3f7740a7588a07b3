"""Find a BLAS whose kernels are older than the processor."""

import os
from pathlib import Path

from threadpoolctl import threadpool_info

# flag of the CPU -> its OpenBLAS kernels, best first; those that OpenBLAS takes for unknown CPUs
KERNELS = {"avx512dq": "SkylakeX", "avx2": "Haswell"}
CPUINFO = Path("/proc/cpuinfo")
OLD_KERNELS = {"generic", "prescott", "core2", "penryn", "dunnington", "atom", "nehalem"}


def slow_blas() -> str | None:
    """Return one line of advice if OpenBLAS has not recognised this CPU, else None."""
    if "OPENBLAS_CORETYPE" in os.environ or not CPUINFO.exists():
        return None
    lines = CPUINFO.read_text().splitlines()
    flags = next((line.split() for line in lines if line.startswith("flags")), [])
    best = next((kernels for flag, kernels in KERNELS.items() if flag in flags), None)
    for library in threadpool_info():
        kernels = str(library.get("architecture", ""))
        if library["internal_api"] == "openblas" and best and kernels.lower() in OLD_KERNELS:
            return (
                f"OpenBLAS runs its {kernels} kernels on a CPU that can do more: "
                f"set OPENBLAS_CORETYPE={best} before Python starts"
            )
    return None
