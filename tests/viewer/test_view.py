"""Command line of the viewer and its error messages."""

import re
import socket
import sys

import pytest
from omegaconf import OmegaConf
from PIL import Image

import dpl.viewer
from dpl.commands import view
from dpl.viewer.recording import FRAME_RATE

pytest.importorskip("viser", reason="the extra viewer is not installed")

from dpl.viewer.page import Page

ADDRESS = r"the page is at http://127\.0\.0\.1:\d+/[\w-]{32}/  \(Ctrl-C ends it\)\n"


@pytest.fixture
def home(trained_run):
    """Working directory with the trained run runs/first."""
    return trained_run.parents[1]


def test_the_page_prints_its_address_and_ctrl_c_ends_it(
    script, home, tiny_training, tmp_path, monkeypatch
):
    def refresh(page):
        assert page.frame is None or page.frame.answer is not None
        raise KeyboardInterrupt

    monkeypatch.setattr(Page, "refresh", refresh)
    ended = script("view", "run=runs/first", "port=0", cwd=home)
    assert (ended.status, ended.err) == (130, "interrupted\n")
    assert re.fullmatch(ADDRESS, ended.out)
    short = ["trainer.max_epochs=1", "extras.view=true", "run=runs/a"]
    ended = script("train", *tiny_training, *short, cwd=tmp_path)
    assert ended.status == 130, ended.err[-2000:]
    assert re.search(ADDRESS, ended.out)
    assert (tmp_path / "runs/a/evaluation.json").is_file(), "the page is served at the end"


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_only_a_public_host_prints_a_warning(capsys, host):
    policy = view.bind(OmegaConf.create({"host": host, "port": 0, "allowed_hosts": []}))
    with policy.socket:
        assert policy.url.startswith("http://127.0.0.1:")
    warning = "warning: host = 0.0.0.0: everyone who reaches this machine"
    assert capsys.readouterr().err.startswith(warning) == policy.is_public == (host == "0.0.0.0")


def test_a_sweep_serves_no_page(script, tiny_training, tmp_path):
    ended = script("train", "-m", *tiny_training, "seed=0,1", "extras.view=true", cwd=tmp_path)
    assert ended.status == 2
    assert "extras.view = true needs one run" in ended.err
    assert not (tmp_path / "datasets").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run=runs/none"], "run = runs/none has no config.yaml; train it first"),
        ([], "run is missing; set it on the command line"),
        (["run=runs/first", "port=70000"], "port = 70000 must lie between 0 and 65535"),
        (["run=runs/first", "host=no.such.host.invalid"], "host = no.such.host.invalid, port = "),
        (["run=runs/first", "hots=x"], ""),
        (["run=runs/first", "animation=x.avi"], "animation = x.avi must end with .gif or .mp4"),
    ],
    ids=str,
)
def test_invalid_input_prints_one_line(script, home, arguments, words):
    ended = script("view", *arguments, cwd=home)
    assert ended.status != 0
    if words:
        assert ended.status == 2
        assert ended.err.startswith(f"error: {words}")
        assert ended.err.count("\n") == 1


def test_a_port_in_use_is_reported(script, home):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        ended = script("view", "run=runs/first", f"port={port}", cwd=home)
    message = f"error: port = {port} is in use; choose another, or port=0 for any free port\n"
    assert (ended.status, ended.err) == (2, message)


def test_without_viser_the_message_names_the_extra(script, home, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    for name in ("page", "nodes"):
        monkeypatch.delitem(sys.modules, f"dpl.viewer.{name}", raising=False)
    monkeypatch.delitem(vars(dpl.viewer), "Page", raising=False)
    ended = script("view", "run=runs/first", cwd=home)
    assert ended.status == 2
    assert ended.err.endswith("pip install -c constraints.txt -e '.[viewer]'\n")
    assert ended.err.count("\n") == 1


@pytest.mark.slow
def test_an_animation_is_written_without_a_browser(script, home, tmp_path):
    path = tmp_path / "films" / "live.gif"
    ended = script("view", "run=runs/first", f"animation={path}", cwd=home)
    assert ended.status == 0, ended.err
    image = Image.open(path)
    assert (image.n_frames, image.size) == (5 * FRAME_RATE, (720, 405))
