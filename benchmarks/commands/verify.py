"""Compare the mechanics with known solutions: python scripts/verify.py writes docs/verification.md.

Some cases alone: parts=[cook,elastica]. The page keeps what the others measured last.
"""

import time
from pathlib import Path

from omegaconf import DictConfig

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command


@command("verify", conf=CONF)
def main(cfg: DictConfig) -> None:
    """Solve the chosen cases and write the page of all cases."""
    from benchmarks import verification
    from dpl.system.threads import one_thread

    config.check(cfg)
    if unknown := [part for part in cfg.parts if part not in verification.CASES]:
        known = ", ".join(verification.CASES)
        raise config.ConfigError(f"parts: {unknown[0]!r} is none of {known}")
    folder = Path(cfg.folder)
    begin = time.perf_counter()
    for name in cfg.parts:
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
