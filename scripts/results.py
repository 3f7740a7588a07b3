"""Compare all methods on one experiment: python scripts/results.py name=beam_svk."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))  # `benchmarks` is not installed
    from benchmarks.results import main

    main()
