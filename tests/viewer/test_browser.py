"""The page in a real browser: the mouse moves the body, and nothing leaves this machine."""

import shutil
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium"),
]
FLAGS = [
    *("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--disable-quic"),
    *("--enable-unsafe-swiftshader", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
]
KNOWN = "Unable to preventDefault inside passive event listener"  # of viser's own sliders


class Seen:
    """A browser at a page, and all that it asked for or complained of."""

    def __init__(self, browser, page):
        self.page, self.asked, self.wrong = page, [], []
        self.view = browser.new_page(viewport={"width": 1200, "height": 720})
        self.view.set_default_timeout(120_000)
        self.view.on("request", lambda request: self.asked.append(request.url))
        self.view.on("websocket", lambda socket: self.asked.append(socket.url))
        self.view.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.view.on("console", self._heard)
        self.view.goto(page.address + "?fixedDpr=0.5")
        self.until(lambda: page.server.get_clients() and page._frame is not None)
        time.sleep(3)  # the first picture

    def _heard(self, message):
        if message.type == "error" and KNOWN not in message.text:
            self.wrong.append(message.text)

    def until(self, condition, seconds=240):
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "it did not happen"
            self.view.wait_for_timeout(100)
            self.page.refresh()

    def reads(self, words):
        """Wait until words are on the page."""
        self.until(lambda: self.view.get_by_text(words).first.is_visible())

    def control(self, name):
        return self.view.locator(f"xpath=//*[text()='{name}']/following::input[1]")

    def body(self):
        """Where the middle of the body is on the screen."""
        camera = self.page.camera
        width = self.view.evaluate("document.querySelector('canvas').clientWidth")
        height = self.view.evaluate("document.querySelector('canvas').clientHeight")
        middle = self.page._frame.points.mean(axis=0, keepdims=True)
        return camera.project(middle, width, height)[0, :2]

    def changed(self, before, path):
        """Wait until the picture differs from an earlier one."""
        self.until(lambda: (np.abs(self.picture(path) - before).sum(axis=2) > 60).mean() > 0.02)

    def picture(self, path):
        self.view.screenshot(path=path)
        return np.asarray(Image.open(path).convert("RGB")).astype(int)[:, :800]


@pytest.fixture
def seen(page):
    """A browser that looks at the page."""
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        seen = Seen(browser, page)
        yield seen
        browser.close()
    assert seen.wrong == []
    elsewhere = {
        url for url in seen.asked if not url.startswith(("blob:http://127.0.0.1", "data:"))
    }
    assert {urlsplit(url).hostname for url in elsewhere} == {"127.0.0.1"}


def test_the_mouse_bends_the_body(seen, page, tmp_path):
    before = seen.picture(tmp_path / "before.png")
    assert page._frame.answer.method == "rest"
    x, y = seen.body()
    seen.view.mouse.move(x, y)
    time.sleep(1)
    seen.view.mouse.down()
    for k in range(15):
        seen.view.mouse.move(x, y - 8 * k)
        seen.view.wait_for_timeout(80)
    seen.view.mouse.up()
    seen.until(lambda: page._frame.answer.method == "network")
    assert page.worker.settle(240)
    moved = page._frame.points - page.body.surface.rest
    assert moved[:, 2].max() > 0.03, "it went up with the mouse"
    assert not page._frame.answer.out_of_distribution
    seen.changed(before, tmp_path / "after.png")


def test_controls_change_colours_loads_and_what_stands_beside(seen, page, tmp_path):
    seen.view.get_by_text("Random load of the training").click()
    seen.until(lambda: page._frame.asked.force.any())
    assert page.worker.settle(240)
    before = seen.picture(tmp_path / "before.png")
    seen.control("colours").click()
    seen.view.get_by_role("option", name="von Mises stress").click()
    seen.until(lambda: page._frame.quantity == "von Mises stress")
    seen.changed(before, tmp_path / "stress.png")
    seen.reads("von Mises stress [Pa]")
    seen.control("answer").click()
    seen.view.get_by_role("option", name="corrected to 1e-06").click()
    seen.until(lambda: page._frame.converged and page._frame.residual < 1e-6)
    seen.control("Newton from rest beside it").click()
    seen.until(lambda: page._beside[0] is not None and page._beside[0].converged)
    seen.reads("in balance")
    seen.view.get_by_text("Reset", exact=True).click()
    seen.until(lambda: page._frame.answer.method == "rest")


def test_a_recording_is_written_and_downloaded(seen, page):
    seen.view.get_by_text("Record", exact=True).click()
    seen.view.get_by_text("Start recording").click()
    seen.until(lambda: page.recording.running)
    seen.view.get_by_text("Random load of the training").click()
    seen.until(lambda: len(page.recording) > 3 and page.worker.settle(0))
    seen.view.get_by_text("VTU", exact=True).click()
    folder = page._folder
    seen.until(lambda: (folder / "recording-001.pvd").exists())
    assert len(list((folder / "recording-001").glob("*.vtu"))) == len(page.recording)
    seen.view.get_by_text("GIF", exact=True).click()
    seen.until(lambda: (folder / "recording-002.gif").exists())
    seen.reads("recording-002.gif")
