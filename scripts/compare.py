"""Compare the runs below a folder: python scripts/compare.py run=runs/..."""

if __name__ == "__main__":
    from dpl.commands.compare import main

    main()
