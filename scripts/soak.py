"""Run the soak test: python scripts/soak.py minutes=30."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))  # `benchmarks` is not installed
    from benchmarks.soak import main

    main()
