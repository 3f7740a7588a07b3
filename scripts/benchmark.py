"""Measure run times of the mechanics and of public codes: python scripts/benchmark.py."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))  # `benchmarks` is not installed
    from benchmarks.benchmark import main

    main()
