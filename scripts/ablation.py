"""Learning curve and ablation of model=unrolled: python scripts/ablation.py."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))  # `benchmarks` is not installed
    from benchmarks.ablation import main

    main()
