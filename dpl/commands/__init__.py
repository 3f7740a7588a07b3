"""Commands: `scripts/NAME.py` and `dpl-NAME` call `main` of the module NAME."""
