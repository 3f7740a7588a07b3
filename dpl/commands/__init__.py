"""The commands: one module each, its `main` what `scripts/NAME.py` and `dpl-NAME` call."""
