"""One browser for all tests of pages, and one window a device: new ones take half a second."""

import pytest

from _helpers.browser import DESKTOP, Tab, chromium


@pytest.fixture(scope="package")
def window():
    """Return the window of a device."""
    windows = {}
    with chromium() as browser:

        def window(device):
            key = repr(device)
            if key not in windows:
                windows[key] = browser.new_page(**device)
                windows[key].set_default_timeout(
                    200_000
                )  # milliseconds; others may use the machine
            return windows[key]

        yield window


@pytest.fixture
def show(window, tmp_path):
    """Show a page in the browser; at the end, check that nothing went wrong in it."""
    tabs = []

    def show(page, device=DESKTOP):
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
