"""Test networks on the loads of other families: python scripts/transfer.py run=runs/families."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))  # `benchmarks` is not installed
    from benchmarks.transfer import main

    main()
