"""Train all runs of the tables of the paper and write the tables: python scripts/paper.py."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))  # `benchmarks` is not installed
    from benchmarks.paper import main

    main()
