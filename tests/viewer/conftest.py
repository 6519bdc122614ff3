"""One browser for all tests of pages."""

import pytest

from _helpers.browser import DESKTOP, Tab, chromium


@pytest.fixture(scope="package")
def browser():
    with chromium() as found:
        yield found


@pytest.fixture
def show(browser, tmp_path):
    """Open a page in the browser; at the end, check that nothing went wrong in it."""
    tabs = []

    def show(page, device=DESKTOP):
        path = tmp_path / f"{len(tabs)}.html"
        page.save(path)
        tabs.append(Tab(browser, path, device))
        return tabs[-1]

    yield show
    for tab in tabs:
        tab.page.close()
        assert tab.errors == []
        own = [url for url in tab.requests if not url.startswith(("file:", "data:", "blob:"))]
        assert own == [], "the page used the network"
