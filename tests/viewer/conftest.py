"""One browser for all tests of pages, and one window a device: new ones take half a second."""

from functools import cache

import pytest

from _helpers.browser import DEVICES, Tab, chromium


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
