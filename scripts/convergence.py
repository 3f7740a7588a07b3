"""Newton from zero and from predictions: python scripts/convergence.py run=runs/beam_svk."""

if __name__ == "__main__":
    from dpl.commands.convergence import main

    main()
