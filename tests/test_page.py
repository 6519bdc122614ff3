"""The page of results: whole, safe to show anything, and working in a browser."""

import re
from base64 import b64decode
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import probe

from eigengs_dr.bench.charts import new_figure, save_figure
from eigengs_dr.bench.page import Page, Picture, Section, Table, write_html, write_markdown
from eigengs_dr.image.io import save_image

NASTY = """<b>&"'|`_a_ *b* <script>alert(1)</script> $title"""
"""Nothing in it may mean anything."""

XMLNS = "xmlns='http://www.w3.org/2000/svg'"

CELLS = ["46.3 ± 2.1", "-", "1,234.5 (1,000-2,000)", "inf", "-3.5", "9.99", "out of memory"]
ASCENDING = ["-3.5", "9.99", "46.3 ± 2.1", "1,234.5 (1,000-2,000)", "inf", "out of memory", "-"]
DESCENDING = ["inf", "1,234.5 (1,000-2,000)", "46.3 ± 2.1", "9.99", "-3.5", "out of memory", "-"]


class Reader(HTMLParser):
    """All elements with their attributes, and all text outside of style and script."""

    def __init__(self, path):
        super().__init__()
        self.elements, self.text, self._open = [], "", ""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        self._open = tag

    def handle_data(self, data):
        if self._open not in ("style", "script"):
            self.text += data

    def all(self, *tags):
        return [attributes for tag, attributes in self.elements if tag in tags]


def chart(path, title):
    """A chart with lines that are clipped, text, and markers that are used by reference."""
    figure = new_figure(4, 3)
    axes = figure.add_subplot(title=title, xlim=(2, 6))
    axes.plot(np.arange(9), np.arange(9) ** 2, marker="o")
    save_figure(path, figure)
    return path


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    photo = np.random.default_rng(0).random((60, 90, 3), np.float32)
    save_image(folder / "photo.png", photo)
    save_image(folder / "photo.jpg", photo)
    first = chart(folder / "first.svg", "A < B & C")
    (folder / "other").mkdir()
    second = chart(folder / "other" / "first.svg", "another")
    table = Table(
        "Cells, **all** kinds", ("what", "PSNR"), [(f"n{k}", c) for k, c in enumerate(CELLS)]
    )
    nasty = Table(NASTY, (NASTY, "n"), [(NASTY, "1")])
    sections = [
        Section(
            "Speed?", "One `a_b`.\n\nTwo.", [table], [Picture(first, "first")], "now\n`make it`"
        ),
        Section(
            "Speed!",
            "See [the *paper*](https://example.org/?a=1&b=2), not [this](javascript:run).",
            [],
            [Picture(second, "second"), Picture(folder / "photo.png", "`noise`", "by **us**")],
            "then",
        ),
        Section(NASTY, NASTY, [nasty], [Picture(folder / "photo.jpg", NASTY, NASTY)], NASTY),
    ]
    return Page("Results", "An intro.", sections)


@pytest.fixture(scope="module")
def html(page, tmp_path_factory):
    path = tmp_path_factory.mktemp("html") / "page.html"
    write_html(path, page)
    return path


@pytest.fixture(scope="module")
def seen(html):
    return probe(html)


def test_every_picture_is_inside(html, page):
    reader = Reader(html)
    paths = [picture.path for section in page.sections for picture in section.pictures]
    photos = [path for path in paths if path.suffix != ".svg"]
    inside = [image["src"].partition(",") for image in reader.all("img")]
    assert [b64decode(data) for _, _, data in inside] == [path.read_bytes() for path in photos]
    assert [kind for kind, _, _ in inside] == ["data:image/png;base64", "data:image/jpeg;base64"]
    assert [one["aria-label"] for one in reader.all("svg")] == ["first", "second"]
    drawn = sum(path.read_text().count("<path") for path in paths if path not in photos)
    assert len(reader.all("path")) == drawn > 20


def test_ids_are_unique_and_all_that_is_referred_to_is_there(html):
    reader, text = Reader(html), html.read_text(encoding="utf-8")
    ids = [attributes["id"] for _, attributes in reader.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    uses = {use["href"] for use in reader.all("use")}
    clips = set(re.findall(r"url\((#[^)]+)\)", text))
    assert len(uses) > 20 and len(clips) == 2
    contents = {a["href"] for a in reader.all("a") if a["href"].startswith("#")}
    assert len(contents) == 3
    assert {target.removeprefix("#") for target in uses | clips | contents} <= set(ids)
    # None of a chart leads to another chart.
    for k, part in enumerate(text.split("<svg")[1:]):
        prefix = ["speed_0_", "speed-2_0_"][k]
        targets = re.findall(r'(?:href="|url\()#([^")]+)', part.split("</svg>")[0])
        assert targets and all(target.startswith(prefix) for target in targets)


def test_nothing_is_asked_of_the_network(html):
    reader = Reader(html)
    for tag, attributes in reader.elements:
        for name in ("src", "href", "srcset", "data", "poster", "action"):
            assert tag == "a" or attributes.get(name, "#").startswith(("data:", "#"))
    text = html.read_text(encoding="utf-8")
    assert not re.search(r"@import|url\(\s*['\"]?(?!#)", text)
    assert [a["href"] for a in reader.all("a") if not a["href"].startswith("#")] == [
        "https://example.org/?a=1&b=2"
    ]


def test_html_shows_what_was_written(html):
    reader = Reader(html)
    words = " ".join(NASTY.split())
    # Contents, heading, text, caption, heading, cell, caption and credit of a picture, source.
    assert reader.text.count(words) == 9
    assert [image["alt"] for image in reader.all("img")] == ["noise", words]
    assert len(reader.all("script")) == 1
    tags = html.read_text(encoding="utf-8")
    for form in ("<strong>all</strong>", "<code>a_b</code>", "now<br><code>make it</code>"):
        assert form in tags
    assert "<p>One <code>a_b</code>.</p>\n<p>Two.</p>" in tags
    assert '<a href="https://example.org/?a=1&amp;b=2">the *paper*</a>' in tags
    assert "[this](javascript:run)" in reader.text


def test_figures_can_be_sorted_and_stand_right(html):
    cells = Reader(html).all("td")
    keys = [cell.get("data-key") for cell in cells[1 : 2 * len(CELLS) : 2]]
    assert keys == ["46.3", None, "1234.5", "Infinity", "-3.5", "9.99", None]
    right = ["figures" in cell.get("class", "") for cell in cells]
    assert right == [False] * 2 * len(CELLS) + [False, True]  # words among figures, figures


def page_of(*paths):
    pictures = [Picture(path, "seen") for path in paths]
    return Page("Title", "", [Section("One", "", [], pictures, "")])


@pytest.mark.parametrize(
    "content, message",
    [
        ("<svg", "is not an SVG picture (unclosed token"),
        ("<html/>", "is not an SVG picture"),
        (f"<svg {XMLNS}><image href='a.png'/></svg>", "refers to a.png, which is not part of it"),
    ],
)
def test_what_is_no_chart_is_refused(page, tmp_path, content, message):
    (tmp_path / "page.html").write_text("before")
    (tmp_path / "bad.svg").write_text(content)
    good = page.sections[0].pictures[0].path
    with pytest.raises(ValueError, match=re.escape(f"{tmp_path / 'bad.svg'}: {message}")):
        write_html(tmp_path / "page.html", page_of(good, tmp_path / "bad.svg"))
    assert (tmp_path / "page.html").read_text() == "before"


@pytest.mark.parametrize(
    "name, message", [("none.png", "cannot be read (No such"), ("a.gif", "must end in .svg, .png")]
)
def test_a_missing_picture_is_named_before_anything_is_written(page, tmp_path, name, message):
    bad = page_of(page.sections[0].pictures[0].path, tmp_path / name)
    for write, target in ((write_html, "page.html"), (write_markdown, "markdown")):
        with pytest.raises(ValueError, match=f"{re.escape(name)}: .*{re.escape(message)}"):
            write(tmp_path / target, bad)
    assert not list(tmp_path.iterdir())


def test_a_drawing_is_left_with_what_it_shows(tmp_path):
    (tmp_path / "a.svg").write_text(
        f"<?xml version='1.0'?><!DOCTYPE svg><svg {XMLNS} xmlns:x='http://www.w3.org/1999/xlink' "
        "xmlns:o='http://other' onload='run()' o:k='1'><metadata/><script>run()</script><o:g/>"
        "<defs><style>*{clip-path: url('#c')}</style><clipPath id='c'/></defs>"
        "<use x:href='#c' style='fill: url( #c )'/><text>a &lt; b</text></svg>"
    )
    write_html(tmp_path / "page.html", page_of(tmp_path / "a.svg"))
    [drawing] = re.findall("<svg.*</svg>", (tmp_path / "page.html").read_text())
    assert drawing == (
        '<svg id="one_0_" role="img" aria-label="seen">'
        "<defs><style>#one_0_ { *{clip-path: url('#one_0_c')} }</style>"
        '<clipPath id="one_0_c" /></defs>'
        '<use href="#one_0_c" style="fill: url( #one_0_c )" /><text>a &lt; b</text></svg>'
    )


def test_markdown_has_tables_and_pictures(page, tmp_path):
    write_markdown(tmp_path / "new" / "folder", page)
    folder = tmp_path / "new" / "folder"
    text = (folder / "README.md").read_text(encoding="utf-8")
    names = re.findall(r"^!\[.*\]\((.*)\)$", text, re.MULTILINE)
    assert names == [
        "pictures/speed-first.svg",
        "pictures/speed-first-2.svg",
        "pictures/speed-photo.png",
        "pictures/b-a-b-script-alert-1-script-title-photo.jpg",
    ]
    copies = [(folder / name).read_bytes() for name in names]
    pictures = [picture for section in page.sections for picture in section.pictures]
    assert copies == [picture.path.read_bytes() for picture in pictures]
    assert "| what | PSNR |\n| --- | --- |\n| n0 | 46.3 ± 2.1 |\n| n1 | - |\n" in text
    assert "\n\nOne `a_b`.\n\nTwo.\n\n" in text
    assert "[the \\*paper\\*](https://example.org/?a=1&b=2)" in text
    assert "*`noise`* by **us**\n" in text
    assert "\nnow\\\n`make it`\n" in text


def test_markdown_escapes_what_means_something(page, tmp_path):
    write_markdown(tmp_path, page)
    text = (tmp_path / "README.md").read_text(encoding="utf-8")
    body = re.sub(r"<!--.*-->|`[^`]*`", "", text)
    escaped = """\\<b\\>\\&"'\\|\\`\\_a\\_ \\*b\\* \\<script\\>alert(1)\\</script\\> \\$title"""
    assert text.count(escaped) == 9  # not in the contents, but in place of a picture
    assert not re.search(r"(?<!\\)[<&]", body.replace("?a=1&b=2", ""))
    row = next(line for line in text.splitlines() if line.startswith("| \\<b"))
    assert len(re.findall(r"(?<!\\)\|", row)) == 3


def test_an_earlier_page_is_replaced_and_no_other_file(page, tmp_path):
    write_markdown(tmp_path, page)
    (tmp_path / "pictures" / "mine.png").write_text("mine")
    (tmp_path / "notes.md").write_text("mine")
    again = (tmp_path / "README.md").read_bytes()
    write_markdown(tmp_path, page)
    assert (tmp_path / "README.md").read_bytes() == again
    write_markdown(tmp_path, page._replace(sections=page.sections[:1]))
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*")}
    assert left == {"README.md", "notes.md", "pictures/mine.png", "pictures/speed-first.svg"}


@pytest.mark.parametrize("name", ["README.md", "pictures/speed-first.svg"])
def test_a_file_of_somebody_else_is_kept(page, tmp_path, name):
    (tmp_path / "pictures").mkdir()
    (tmp_path / name).write_text("mine")
    with pytest.raises(
        ValueError, match=f"{re.escape(str(tmp_path / name))}: is not of an earlier"
    ):
        write_markdown(tmp_path, page)
    assert [path.read_text() for path in tmp_path.rglob("*.*")] == ["mine"]


def test_an_empty_page_is_a_page(tmp_path):
    empty = Page("Nothing", "", [Section("Yet", "", [Table("None", ("a",), [])], [], "")])
    write_html(tmp_path / "page.html", empty)
    write_markdown(tmp_path, empty)
    assert "Yet" in Reader(tmp_path / "page.html").text
    assert "## Yet" in (tmp_path / "README.md").read_text()


def test_a_browser_draws_all_pictures(seen):
    assert seen["errors"] == seen["blocked"] == []
    assert [image["loaded"] for image in seen["images"]] == [True, True]
    assert [image["size"] for image in seen["images"]] == [[90, 60], [90, 60]]
    assert [one["name"] for one in seen["charts"]] == ["first", "second"]
    for one in seen["charts"]:
        assert min(one["size"]) > 50
        assert one["paths"] > 5
        assert one["drawn_uses"] > 0.8 * one["uses"] > 0


def test_a_click_on_a_heading_sorts(seen):
    (names, figures), _ = seen["tables"]
    # The headings are clicked in turn, and whole rows move.
    assert figures["before"] == [CELLS[int(name[1:])] for name in names["clicks"][1]["cells"]]
    assert names["before"] == [f"n{k}" for k in range(len(CELLS))]
    assert names["clicks"][1]["cells"] == names["before"][::-1]
    assert [click["cells"] for click in figures["clicks"]] == [ASCENDING, DESCENDING]
    assert [click["marked"] for click in figures["clicks"]] == [
        ["PSNR ascending"],
        ["PSNR descending"],
    ]


def test_a_narrow_window_shows_all_of_the_width(page, html, tmp_path):
    wide = Table("Wide", tuple(f"column {k}" for k in range(40)), [("1,000.0 ± 0.1",) * 40])
    first = page.sections[0]
    path = tmp_path / "wide.html"
    write_html(path, page._replace(sections=[first._replace(tables=[wide])]))
    whole, window = probe(path, width=400)["widths"]
    assert whole == window < 600
