"""The data set alone: python scripts/generate.py data.train=4000 data.workers=8."""

if __name__ == "__main__":
    from dpl.commands.generate import main

    main()
