"""Calibrate the estimated errors of the simulator: python scripts/error_estimates.py."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))  # `benchmarks` is not installed
    from benchmarks.error_estimates import main

    main()
