"""All methods on one experiment side by side: python scripts/results.py name=beam_svk."""

if __name__ == "__main__":
    from dpl.commands.results import main

    main()
