"""The mechanics against public codes: python scripts/benchmark.py."""

if __name__ == "__main__":
    from dpl.commands.benchmark import main

    main()
