"""The page in Chromium: mouse and controls work, and no request leaves this machine."""

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


class Browser:
    """A browser with the page, its requested URLs and its errors."""

    def __init__(self, browser, page):
        self.page, self.urls, self.wrong = page, [], []
        self.view = browser.new_page(viewport={"width": 1200, "height": 720})
        self.view.set_default_timeout(120_000)
        self.view.on("request", lambda request: self.urls.append(request.url))
        self.view.on("websocket", lambda socket: self.urls.append(socket.url))
        self.view.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.view.on("console", self._heard)
        self.view.goto(page.url + "?fixedDpr=0.5")
        self.until(lambda: page.server.get_clients() and page.frame is not None)
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
        middle = self.page.frame.points.mean(axis=0, keepdims=True)
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
        seen = Browser(browser, page)
        yield seen
        browser.close()
    assert seen.wrong == []
    elsewhere = {url for url in seen.urls if not url.startswith(("blob:http://127.0.0.1", "data:"))}
    assert {urlsplit(url).hostname for url in elsewhere} == {"127.0.0.1"}


def test_a_mouse_drag_deforms_the_body(seen, page, tmp_path):
    before = seen.picture(tmp_path / "before.png")
    assert page.frame.answer.method == "rest"
    x, y = seen.body()
    seen.view.mouse.move(x, y)
    time.sleep(1)
    seen.view.mouse.down()
    for k in range(15):
        seen.view.mouse.move(x, y - 8 * k)
        seen.view.wait_for_timeout(80)
    seen.view.mouse.up()
    seen.until(lambda: page.frame.answer.method == "network")
    assert page.worker.wait(240)
    moved = page.frame.points - page.body.surface.undeformed
    assert moved[:, 2].max() > 0.03, "the body follows the mouse"
    assert not page.frame.answer.out_of_distribution
    seen.changed(before, tmp_path / "after.png")


def test_controls_change_colours_method_and_comparison(seen, page, tmp_path):
    seen.view.get_by_text("Random training load").click()
    seen.until(lambda: page.frame.request.force.any())
    assert page.worker.wait(240)
    before = seen.picture(tmp_path / "before.png")
    seen.control("colours").click()
    seen.view.get_by_role("option", name="von Mises stress").click()
    seen.until(lambda: page.frame.quantity == "von Mises stress")
    seen.changed(before, tmp_path / "stress.png")
    seen.reads("von Mises stress [Pa]")
    seen.control("method").click()
    seen.view.get_by_role("option", name="residual below 1e-06").click()
    seen.until(lambda: page.frame.converged and page.frame.residual < 1e-6)
    seen.control("compare with Newton from zero").click()
    seen.until(lambda: page.newton_frame is not None and page.newton_frame.converged)
    seen.reads("converged")
    seen.view.get_by_text("Reset", exact=True).click()
    seen.until(lambda: page.frame.answer.method == "rest")


def test_a_recording_is_written_and_downloaded(seen, page):
    seen.view.get_by_text("Record", exact=True).click()
    seen.view.get_by_text("Start recording").click()
    seen.until(lambda: page.recording.running)
    seen.view.get_by_text("Random training load").click()
    seen.until(lambda: len(page.recording) > 3 and page.worker.wait(0))
    seen.view.get_by_text("VTU", exact=True).click()
    folder = page.folder
    seen.until(lambda: (folder / "recording-001.pvd").exists())
    assert len(list((folder / "recording-001").glob("*.vtu"))) == len(page.recording)
    seen.view.get_by_text("GIF", exact=True).click()
    seen.until(lambda: (folder / "recording-002.gif").exists())
    seen.reads("recording-002.gif")
