"""A headless Chromium that draws without a GPU: one for all tests, and one window a device.

New ones take half a second.
"""

import io
import shutil
from base64 import b64decode
from contextlib import contextmanager
from functools import cache

import numpy as np
import pytest
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome")

FLAGS = [
    "--headless",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]

DEVICES = {
    "desktop": {"viewport": {"width": 700, "height": 420}, "color_scheme": "light"},
    "phone": {
        "viewport": {"width": 360, "height": 640},
        "device_scale_factor": 2,
        "is_mobile": True,
        "has_touch": True,
        "color_scheme": "dark",
    },
}


@contextmanager
def chromium():
    """Start a browser, or skip the test with the reason."""
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("no Chromium (Debian: apt install chromium): pages were not looked at")
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=FLAGS)
        yield browser
        browser.close()


class Tab:
    """A page of `eigengs_dr.view` in a browser, and what went wrong in it."""

    def __init__(self, page, path):
        self.page = page
        self.errors, self.requests = [], []
        self.listeners = {
            "pageerror": lambda error: self.errors.append(str(error)),
            "request": lambda request: self.requests.append(request.url),
        }
        for event, listener in self.listeners.items():
            page.on(event, listener)
        page.goto(path.as_uri())
        self.wait("window.viewer?.ready")

    def close(self):
        """Leave the page to the next test."""
        for event, listener in self.listeners.items():
            self.page.remove_listener(event, listener)
        self.page.goto("about:blank")

    def run(self, code):
        """Value of an expression of the page, after all that changed before it was drawn."""
        self.rest()
        value = self.page.evaluate(code)
        self.rest()
        return value

    def rest(self):
        """Wait until everything that changed is drawn."""
        self.wait("!(viewer.waiting || viewer.moving || viewer.stale)")

    def wait(self, condition):
        """Wait until an expression of the page is true."""
        # Playwright's own function for it breaks the page's policy, which forbids `eval`.
        frame = "await new Promise(requestAnimationFrame)"
        self.page.evaluate(f"async () => {{ while (!({condition})) {frame}; }}")

    def fingers(self):
        """Return what sends a touch event with the places of all fingers."""
        session = self.page.context.new_cdp_session(self.page)

        def send(kind, *places):
            points = [{"x": x, "y": y} for x, y in places]
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

        return send

    def pixels(self):
        """The canvas, shape (H, W, 3); black where it is empty."""
        link = self.page.evaluate("() => { viewer.draw(); return viewer.canvas.toDataURL(); }")
        picture = Image.open(io.BytesIO(b64decode(link.partition(",")[2])))
        pixels = np.asarray(picture.convert("RGBA"), float)
        return pixels[..., :3] * (pixels[..., 3:] > 0)

    def image(self):
        """The pixels of the image alone; the page must show one of it for one of the screen."""
        left, top, width, height = self.run("viewer.camera.frame")
        assert (left, top) == (int(left), int(top)), "pixels are not aligned"
        x, y, w, h = map(int, (left, top, width, height))
        return self.pixels()[y : y + h, x : x + w]


@pytest.fixture(scope="package")
def window():
    """Return the window of a device."""
    with chromium() as browser:

        @cache
        def open_window(device):
            found = browser.new_page(**DEVICES[device])
            found.set_default_timeout(200_000)  # milliseconds; others may use the machine
            return found

        yield open_window


@pytest.fixture
def show(window, tmp_path):
    """Show a page in the browser; at the end, check that nothing went wrong in it."""
    tabs = []

    def show(page, device="desktop"):
        path = tmp_path / f"{len(tabs)}.html"
        page.save(path)
        tabs.append(Tab(window(device), path))
        return tabs[-1]

    yield show
    for tab in tabs:
        tab.close()
        assert tab.errors == []
        own = [url for url in tab.requests if not url.startswith(("file:", "data:", "blob:"))]
        assert own == [], "the page used the network"


@pytest.fixture
def actual(show):
    """Open a page at one pixel of the screen for one of the image."""

    def actual(page):
        tab = show(page)
        tab.page.click("#actual-size")
        return tab

    return actual
