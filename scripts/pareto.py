"""Run time against error of every solver: python scripts/pareto.py run=runs/beam_svk."""

if __name__ == "__main__":
    from dpl.commands.pareto import main

    main()
