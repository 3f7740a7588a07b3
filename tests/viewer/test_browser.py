"""The page in Chromium: mouse and controls work, and no request leaves this machine."""

import shutil
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

from dpl.viewer.camera import Camera

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed"),
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
        self.page, self.urls, self.errors = page, [], []
        self.view = browser.new_page(viewport={"width": 1200, "height": 720})
        self.view.set_default_timeout(120_000)
        self.view.on("request", lambda request: self.urls.append(request.url))
        self.view.on("websocket", lambda socket: self.urls.append(socket.url))
        self.view.on("pageerror", lambda error: self.errors.append(str(error)))
        self.view.on("console", self._record_error)
        self.view.goto(page._policy.url + "?fixedDpr=0.5")
        self.until(lambda: page.server.get_clients() and page.frame is not None)
        time.sleep(3)  # time of the first rendering

    def _record_error(self, message):
        if message.type == "error" and KNOWN not in message.text:
            self.errors.append(message.text)

    def until(self, condition, seconds=240):
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "condition not met in time"
            self.view.wait_for_timeout(100)
            self.page.refresh()

    def wait_for_text(self, words):
        """Wait until a text is visible on the page."""
        self.until(lambda: self.view.get_by_text(words).first.is_visible())

    def control(self, name):
        return self.view.locator(f"xpath=//*[text()='{name}']/following::input[1]")

    def body(self):
        """Return the position of the centre of the body on the screen [pixel]."""
        (client,) = self.page.server.get_clients().values()
        camera = Camera(client.camera.position, client.camera.look_at)
        width = self.view.evaluate("document.querySelector('canvas').clientWidth")
        height = self.view.evaluate("document.querySelector('canvas').clientHeight")
        middle = self.page.frame.points.mean(axis=0, keepdims=True)
        return camera.project(middle, width, height)[0, :2]

    def wait_for_change(self, before, path):
        """Wait until the screenshot differs from an earlier one."""
        self.until(
            lambda: (np.abs(self.screenshot_array(path) - before).sum(axis=2) > 60).mean() > 0.02
        )

    def screenshot_array(self, path):
        self.view.screenshot(path=path)
        return np.asarray(Image.open(path).convert("RGB")).astype(int)[:, :800]


@pytest.fixture
def page(make_page, body, tmp_path):
    page = make_page(body, tmp_path / "view")
    page.worker.smoothing_time = 0.06
    yield page
    page.close()


@pytest.fixture
def browser(page):
    """A browser that shows the page."""
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        browser = Browser(chromium, page)
        yield browser
        chromium.close()
    assert browser.errors == []
    remote = [url for url in browser.urls if not url.startswith(("blob:http://127.0.0.1", "data:"))]
    assert {urlsplit(url).hostname for url in remote} == {"127.0.0.1"}


def test_a_mouse_drag_deforms_the_body(browser, page, tmp_path):
    browser.until(lambda: page.frame.request.force.any())  # the load rotates
    browser.view.get_by_text("Reset", exact=True).click()
    browser.until(lambda: page.frame.answer.method == "rest")
    before = browser.screenshot_array(tmp_path / "before.png")
    x, y = browser.body()
    browser.view.mouse.move(x, y)
    time.sleep(1)
    browser.view.mouse.down()
    for k in range(15):
        browser.view.mouse.move(x, y - 8 * k)
        browser.view.wait_for_timeout(80)
    browser.view.mouse.up()
    browser.until(lambda: page.frame.answer.method == "prediction")
    assert page.worker.wait(240)
    moved = page.frame.points - page.body.surface.undeformed
    assert moved[:, 2].max() > 0.03, "the body follows the mouse"
    assert not page.frame.answer.out_of_distribution
    browser.wait_for_change(before, tmp_path / "after.png")


def test_a_grasped_patch_follows_the_mouse_and_rotates(browser, page):
    browser.control("drag").click()
    browser.view.get_by_role("option", name="grasp").click()
    browser.wait_for_text("Click it to grasp another patch.")
    browser.view.get_by_text("Reset", exact=True).click()
    browser.until(lambda: page.frame.answer.method == "rest")
    x, y = browser.body()
    browser.view.mouse.move(x, y)
    time.sleep(1)
    browser.view.mouse.down()
    for k in range(10):
        browser.view.mouse.move(x, y - 3 * k)
        browser.view.wait_for_timeout(80)
    browser.view.mouse.up()
    browser.until(lambda: page.frame.grasp is not None and page.worker.wait(0))
    request = page.frame.request
    assert request.translation[2] > 0.01, "the patch follows the mouse"
    moved = page.frame.displacement[request.nodes] / page.body.scene.length
    assert (moved - request.translation).norm(dim=1).max() < 1e-3
    browser.wait_for_text("force of the gripper")
    visible = "xpath=//*[text()='rotation [°]']/following::input[@type!='hidden']"
    browser.view.locator(visible).first.fill("10")
    browser.until(lambda: page.frame.request.rotation[1] > 0.17 and page.worker.wait(0))
    browser.view.get_by_text("Reset", exact=True).click()
    browser.until(lambda: page.frame.answer.method == "rest")


def test_controls_change_colours_method_and_comparison(browser, page, tmp_path):
    browser.view.get_by_text("Random training load").click()
    browser.until(lambda: page.frame.request.force.any())
    assert page.worker.wait(240)
    before = browser.screenshot_array(tmp_path / "before.png")
    browser.control("colours").click()
    browser.view.get_by_role("option", name="von Mises stress").click()
    browser.until(lambda: page.frame.quantity == "von Mises stress")
    browser.wait_for_change(before, tmp_path / "stress.png")
    browser.wait_for_text("on the surface")
    browser.view.get_by_text("Method and view", exact=True).click()
    browser.control("method").click()
    browser.view.get_by_role("option", name="residual below 1e-06").click()
    browser.until(lambda: page.frame.answer.converged and page.frame.answer.residual < 1e-6)
    browser.control("compare Newton").click()
    browser.until(lambda: page.newton_frame and bool(page.newton_frame.answer.converged))
    browser.wait_for_text("converged")
    browser.view.get_by_text("Reset", exact=True).click()
    browser.until(lambda: page.frame.answer.method == "rest")


def test_a_recording_is_written_and_downloaded(browser, page):
    browser.view.get_by_text("Record", exact=True).click()
    browser.view.get_by_text("Start recording").click()
    browser.until(lambda: page.recording.running)
    browser.view.get_by_text("Random training load").click()
    browser.until(lambda: len(page.recording.frames) > 3 and page.worker.wait(0))
    browser.view.get_by_text("VTU", exact=True).click()
    folder = page.folder
    browser.until(lambda: (folder / "recording-001.pvd").exists())
    assert len(list((folder / "recording-001").glob("*.vtu"))) == len(page.recording.frames)
    browser.view.get_by_text("GIF", exact=True).click()
    browser.until(lambda: (folder / "recording-002.gif").exists())
    browser.wait_for_text("recording-002.gif")
