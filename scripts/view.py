"""A trained run in the browser: python scripts/view.py run=runs/..."""

if __name__ == "__main__":
    from dpl.commands.view import main

    main()
