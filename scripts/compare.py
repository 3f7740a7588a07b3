"""The runs of a sweep side by side: python scripts/compare.py run=runs/..."""

if __name__ == "__main__":
    from dpl.commands.compare import main

    main()
