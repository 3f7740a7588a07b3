"""Command `python scripts/view.py run=runs/...`: interactive viewer in the browser."""

import errno
import sys
import time
from pathlib import Path
from typing import NoReturn

from omegaconf import DictConfig

import dpl
from dpl import config, viewer
from dpl.commands.cli import command, require_viewer
from dpl.version import install


@command("view")
def main(cfg: DictConfig) -> None:
    """Serve the page until Ctrl-C; with `animation` write an animation instead."""
    config.files_of_run(cfg.run)  # refuses a missing run before torch is imported
    if not cfg.animation:
        require_viewer()
        policy = bind(cfg)
    import torch

    torch.set_num_threads(1)
    body = viewer.Body(dpl.load(cfg.run, trust=cfg.trust))
    if cfg.animation:
        write_animation(body, Path(cfg.animation))
    else:
        serve(body, policy, title=str(cfg.run), folder=Path(cfg.folder))


def serve(
    body: "viewer.Body", policy: "viewer.AccessPolicy", *, title: str, folder: Path
) -> NoReturn:
    """Serve the page of a body until Ctrl-C; recordings are written to a folder."""
    import torch

    torch.set_num_threads(1)
    page = viewer.Page(body, policy, title=title, folder=folder)
    try:
        print(f"the page is at {policy.url}  (Ctrl-C ends it)", flush=True)
        while True:
            time.sleep(0.05)
            page.refresh()
    finally:
        page.close()


def bind(cfg: DictConfig) -> "viewer.AccessPolicy":
    """Return the access policy with a bound socket."""
    try:
        policy = viewer.AccessPolicy.bind(cfg.host, cfg.port, cfg.allowed_hosts)
    except OSError as error:
        message = f"host = {cfg.host}, port = {cfg.port} cannot be bound: {error.strerror}"
        if error.errno == errno.EADDRINUSE:
            message = f"port = {cfg.port} is in use; choose another, or port=0 for any free port"
        raise config.ConfigError(message) from error
    if policy.is_public:
        print(
            f"warning: host = {cfg.host}: everyone who reaches this machine and knows the address "
            "can use the page; the connection is not encrypted",
            file=sys.stderr,
        )
    return policy


def write_animation(body: "viewer.Body", path: Path) -> None:
    """Write an animation of a rotating load."""
    from dpl.viewer.recording import FORMATS, animate_load

    if path.suffix not in FORMATS:
        raise config.ConfigError(f"animation = {path} must end with {' or '.join(FORMATS)}")
    with config.error_in("animation"):
        body.scene.problem.material.require_known("a comparison with finite elements")
    try:
        animate_load(body, path)
    except ImportError as error:  # imageio-ffmpeg
        raise config.ConfigError(
            f"animation: {path.suffix} needs {error.name}: {install('viewer')}"
        ) from error
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
