"""Show a trained surrogate in the browser: python scripts/view.py run=runs/..."""

if __name__ == "__main__":
    from dpl.commands.view import main

    main()
