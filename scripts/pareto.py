"""Measure run time and error of all solvers: python scripts/pareto.py run=runs/beam_svk."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))  # `benchmarks` is not installed
    from benchmarks.pareto import main

    main()
