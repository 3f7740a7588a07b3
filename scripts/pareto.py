"""Measure run time and error of all solvers: python scripts/pareto.py run=runs/beam_svk."""

if __name__ == "__main__":
    from dpl.commands.pareto import main

    main()
