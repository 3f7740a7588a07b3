"""Measure random grasps of a trained run: python scripts/grasps.py run=runs/beam."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))  # `benchmarks` is not installed
    from benchmarks.grasps import main

    main()
