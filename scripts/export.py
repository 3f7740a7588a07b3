"""A trained surrogate for others, and its results for ParaView: python scripts/export.py run=..."""

if __name__ == "__main__":
    from dpl.commands.export import main

    main()
