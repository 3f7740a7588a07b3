"""Evaluate a trained surrogate: python scripts/evaluate.py run=runs/..."""

if __name__ == "__main__":
    from dpl.commands.evaluate import main

    main()
