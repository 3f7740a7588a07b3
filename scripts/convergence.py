"""Newton from zero and from predictions: python scripts/convergence.py run=runs/beam_svk."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))  # `benchmarks` is not installed
    from benchmarks.convergence import main

    main()
