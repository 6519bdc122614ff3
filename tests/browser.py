"""A page as a browser shows it: opened without a screen, and asked what is there."""

import html
import json
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")

OPTIONS = [
    "--headless",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--virtual-time-budget=5000",
    "--dump-dom",
]

SECONDS = 60

# Runs before all else, so that no error is missed.
LISTEN = """
<script>
window.probed = { errors: [], blocked: [] };
window.addEventListener("error", (event) => {
  window.probed.errors.push(event.message || `${event.target.tagName} does not load`);
}, true);
document.addEventListener("securitypolicyviolation", (event) => {
  window.probed.blocked.push(event.blockedURI);
});
</script>
"""

ASK = """
<script>
window.addEventListener("load", () => setTimeout(ask, 500));  // requests are blocked later
function ask() {
  const all = (selector, root = document) => Array.from(root.querySelectorAll(selector));
  const size = (element) => {
    const box = element.getBoundingClientRect();
    return [box.width, box.height];
  };
  const drawn = (element) => !element.closest("defs") && Math.max(...size(element)) > 0;
  const column = (table, k) => Array.from(table.tBodies[0].rows, (row) => row.cells[k].textContent);
  const clicked = (table, heading) => {
    all("button", heading)[0].click();
    const marked = all("[aria-sort]", table).map((one) => one.textContent + " " + one.ariaSort);
    return { cells: column(table, heading.cellIndex), marked };
  };
  const probed = window.probed;
  probed.images = all("img").map((image) => ({
    alt: image.alt, loaded: image.complete && image.naturalWidth > 0, size: size(image),
  }));
  probed.charts = all("svg").map((chart) => ({
    name: chart.getAttribute("aria-label"),
    size: size(chart),
    paths: all("path", chart).filter(drawn).length,
    uses: all("use", chart).filter((one) => !one.closest("defs")).length,
    drawn_uses: all("use", chart).filter(drawn).length,
  }));
  probed.tables = all("table").map((table) => all("thead th", table).map((heading, k) => ({
    heading: heading.textContent,
    before: column(table, k),
    clicks: [clicked(table, heading), clicked(table, heading)],
  })));
  probed.widths = [document.documentElement.scrollWidth, document.documentElement.clientWidth];
  const result = document.createElement("pre");
  result.id = "probe_result";
  result.textContent = JSON.stringify(probed);
  document.body.append(result);
}
</script>
"""


def probe(path, width=1200):
    """What a browser makes of a page; skips the test where there is no browser.

    Returns a dictionary: "errors" and "blocked" requests, "images", "charts" (inline SVG), "tables"
    as a list of columns, each with its cells before and after two clicks on its heading, and
    "widths": of all of the page, and of the window, which has a least width of its own.
    """
    browser = next(filter(None, map(shutil.which, NAMES)), None)
    if browser is None:
        pytest.skip(f"needs a browser: {', '.join(NAMES)}")
    page = Path(path).read_text(encoding="utf-8")
    assert "<head>" in page and "</body>" in page
    page = page.replace("<head>", "<head>" + LISTEN, 1)
    before, end, after = page.rpartition("</body>")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        copy = Path(folder) / "page.html"
        copy.write_text(before + ASK + end + after, encoding="utf-8")
        command = [browser, *OPTIONS, f"--user-data-dir={folder}/profile"]
        # Its sandbox refuses to work for root.
        command += ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
        command += [f"--window-size={width},900", copy.as_uri()]
        process = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS)
    found = re.search(r'<pre id="probe_result">(.*?)</pre>', process.stdout, re.DOTALL)
    assert found, f"the page did not load: {process.stderr[-1000:]}"
    return json.loads(html.unescape(found[1]))
