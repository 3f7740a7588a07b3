"""Generate, verify or repair a data set: python scripts/generate.py data.train=4000."""

if __name__ == "__main__":
    from dpl.commands.generate import main

    main()
