"""Compare the mechanics with known solutions: python scripts/verify.py writes docs/verification.md.

cases=[cook,elastica] solves some of them; the page keeps the results of the others. Cases that
take many minutes are solved only if they are named.
"""

import time
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig

from benchmarks import CONF, verification
from dpl import config
from dpl.commands.cli import command
from dpl.system.threads import one_thread

KEYS = ((Sequence[str] | None, "cases"),)


@command("verify", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Solve the chosen cases and write the page of all cases."""
    few = [name for name in verification.CASES if name not in verification.LONG]
    cases = few if cfg.cases is None else cfg.cases
    if unknown := [name for name in cases if name not in verification.CASES]:
        known = ", ".join(verification.CASES)
        raise config.ConfigError(f"cases = {unknown[0]!r} must be one of {known}")
    folder = Path(cfg.folder)
    begin = time.perf_counter()
    for name in cases:
        print(f"{name} ... ", end="", flush=True)
        with one_thread():
            section = verification.measure(name, folder / "verification")
        missed = [row.quantity for row in section.rows if not row.holds]
        print(f"{section.seconds:.1f} s, {len(section.rows)} values, {len(missed)} off", flush=True)
        for quantity in missed:
            print(f"  off: {quantity}")
    print(f"{time.perf_counter() - begin:.0f} s in all")
    path = folder / "verification.md"
    path.write_text(verification.page(folder / "verification"), encoding="utf-8")
    print(f"written to {path}")
