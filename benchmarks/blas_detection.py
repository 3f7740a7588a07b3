"""Detection of the BLAS of another program by its loaded shared libraries."""

import re
from collections.abc import Sequence
from pathlib import Path

REFERENCE = "reference BLAS"
FAMILIES = {"openblas": "OpenBLAS", "mkl": "MKL", "blis": "BLIS", "atlas": "ATLAS"}
FILE = re.compile(r"lib(c?blas|\w*openblas|mkl_|blis|[st]?atlas)")
FOLDERS = "/usr/lib/*/openblas*/libblas.so.3"  # where Debian puts OpenBLAS as a BLAS


def name(libraries: Sequence[str]) -> str | None:
    """Return the name of the BLAS among shared libraries; None if there is none among them.

    Netlib's reference BLAS is named wherever it is loaded, whatever else is. Debian gives every
    BLAS the file name `libblas.so.3`; the folder tells them apart.
    """
    found = set()
    for library in libraries:
        path = Path(library)
        if not FILE.match(path.name):
            continue
        words = f"{path.parent.name} {path.name}".lower()
        found.add(next((title for key, title in FAMILIES.items() if key in words), REFERENCE))
    return REFERENCE if REFERENCE in found else " and ".join(sorted(found)) or None


def optimised(pattern: str = FOLDERS) -> str | None:
    """Return a folder whose `libblas.so.3` is OpenBLAS, for `LD_LIBRARY_PATH`; None without one."""
    found = sorted(Path("/").glob(pattern.lstrip("/")))
    return str(found[0].parent) if found else None
