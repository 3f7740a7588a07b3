"""A trained run in the browser: python scripts/view.py run=runs/..."""

import errno
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from dpl import config
from dpl.commands.cli import command
from dpl.version import install

if TYPE_CHECKING:
    from dpl.viewer import AccessPolicy, Body, Page


@command("view")
def main(cfg: DictConfig) -> None:
    """Serve the page until Ctrl-C; with `movie` write an animation instead."""
    config.check(cfg)
    if cfg.movie:
        _film(_body(cfg), Path(cfg.movie))
        return
    try:
        from dpl.viewer import Page
    except ImportError as error:
        raise config.ConfigError(
            f"the viewer cannot be used ({error}): {install('viewer')}"
        ) from error
    door = _door(cfg)
    page = Page(_body(cfg), door, title=str(cfg.run), folder=Path(cfg.folder))
    try:
        if cfg.speed:
            _show_speed(page)
            return
        print(f"the page is at {door.address}  (Ctrl-C ends it)", flush=True)
        while True:
            time.sleep(0.1)
            page.refresh()
    finally:
        page.close()


def _body(cfg: DictConfig) -> "Body":
    import torch

    from dpl.inference import Simulator
    from dpl.viewer import Body

    torch.set_num_threads(1)
    return Body(Simulator(config.load_run(cfg.run)[1]))


def _door(cfg: DictConfig) -> "AccessPolicy":
    """Return where the page will be, bound already.

    Raises:
        ConfigError: It cannot be there.
    """
    from dpl.viewer import AccessPolicy

    try:
        door = AccessPolicy.bound(cfg.host, cfg.port, cfg.names)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            describe = f"port = {cfg.port} is taken; name another, or port=0 for any that is free"
        else:
            describe = f"host = {cfg.host}, port = {cfg.port} cannot be served: {error.strerror}"
        raise config.ConfigError(describe) from error
    if door.open_to_all:
        print(
            f"warning: host = {cfg.host}: whoever reaches this machine and has the address can "
            "use the page; it is not encrypted",
            file=sys.stderr,
        )
    return door


def _show_speed(page: "Page") -> None:
    from dpl.evaluation.tables import show
    from dpl.evaluation.timing import describe
    from dpl.viewer.frame_rate import speed

    rows, measured = speed(page)
    show(rows, "a frame: milliseconds on the server, and what arrives a second")
    print(describe(measured))


def _film(body: "Body", path: Path) -> None:
    from dpl.viewer.animation import animate_load
    from dpl.viewer.recording import FORMATS

    if path.suffix not in FORMATS:
        raise config.ConfigError(f"movie = {path} must end with {' or '.join(FORMATS)}")
    try:
        animate_load(body, path)
    except ImportError as error:  # of what writes MP4
        raise config.ConfigError(
            f"movie: {path.suffix} needs {error.name}: {install('viewer')}"
        ) from error
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
