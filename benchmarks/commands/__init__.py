"""Commands of this repository: what `scripts/` calls to judge the package; not in the wheel."""
