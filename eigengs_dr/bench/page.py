"""A page of results, of text, tables and pictures: as one HTML file, and as Markdown."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from html import escape
from itertools import count
from pathlib import Path
from string import Template
from typing import NamedTuple

from ..storage.atomic import atomic_write
from .inline import TYPES, drawing, photo
from .prose import as_html, as_markdown, bare, lines, literal, paragraphs
from .table import MISSING, Table

MARK = "<!-- Written by eigengs_dr.bench.page; do not edit. Pictures:"
"""Begins a README.md of `write_markdown`; the names of its pictures follow."""

_TEMPLATE = Path(__file__).with_name("page.html")
_FIGURE = re.compile(r"-?(inf\b|\d[\d,]*(\.\d+)?(e[-+]?\d+)?)")


class Picture(NamedTuple):
    """A chart or a photo.

    Attributes
    ----------
    path : Path
        Ends in one of `TYPES`.
    caption : str
        What is seen. Prose, see `Section`.
    credit : str
        Where a photo is from and what its licence is. Prose.
    """

    path: Path
    caption: str
    credit: str = ""


class Section(NamedTuple):
    """One question and its answer.

    What is called prose may have the forms of `prose`. Captions of tables are prose, too; titles
    and cells are not.

    Attributes
    ----------
    title : str
    text : str
        Paragraphs of prose with blank lines between them.
    tables : list of Table
    pictures : list of Picture
    source : str
        Date, machine, versions, and the command that makes all of it again. Prose, whose lines
        stay lines.
    """

    title: str
    text: str
    tables: list[Table]
    pictures: list[Picture]
    source: str


class Page(NamedTuple):
    """All of the results.

    Attributes
    ----------
    title : str
    intro : str
        Paragraphs of prose.
    sections : list of Section
    """

    title: str
    intro: str
    sections: list[Section]


def write_html(path: str | os.PathLike[str], page: Page) -> None:
    """Write one file that needs no other and no network: its pictures are inside.

    Tables are sorted by a click on a heading.

    Parameters
    ----------
    path : path-like
    page : Page

    Raises
    ------
    ValueError
        If a picture is missing, of another kind, or no picture; nothing is written then.
    OSError
        If the file cannot be written.
    """
    names = _names(section.title for section in page.sections)
    named = list(zip(names, page.sections, strict=True))
    text = Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        title=escape(page.title),
        intro=_html_paragraphs(page.intro),
        contents="\n".join(f'<li><a href="#{k}">{escape(one.title)}</a></li>' for k, one in named),
        sections="\n".join(_html_section(name, section) for name, section in named),
    )
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_markdown(folder: str | os.PathLike[str], page: Page) -> None:
    """Write README.md, and copies of the pictures into pictures/ beside it.

    Pictures of an earlier page that this one does not show are removed: those that its README.md
    names in its first line, and no other file.

    Parameters
    ----------
    folder : path-like
        Made where it is missing.
    page : Page

    Raises
    ------
    ValueError
        If a picture is missing or of another kind, or a file that this function did not write is
        in the way; nothing is written then.
    OSError
        If a file cannot be written.
    """
    readme, copies = Path(folder) / "README.md", Path(folder) / "pictures"
    shown = [(one.title, picture) for one in page.sections for picture in one.pictures]
    contents = [_read(picture) for _, picture in shown]
    stems = _names(f"{title} {picture.path.stem}" for title, picture in shown)
    files = [stem + one.path.suffix.lower() for stem, (_, one) in zip(stems, shown, strict=True)]
    earlier = _earlier(readme)
    for name in files:
        if name not in earlier and (copies / name).exists():
            raise ValueError(f"{copies / name}: is not of an earlier page; move it away")
    blocks = [" ".join([MARK, *files, "-->"]), f"# {literal(page.title)}"]
    blocks += map(as_markdown, paragraphs(page.intro))
    links = iter(files)
    for section in page.sections:
        blocks += _markdown_section(section, links)

    copies.mkdir(parents=True, exist_ok=True)
    for name, content in zip(files, contents, strict=True):
        with atomic_write(copies / name) as temporary:
            temporary.write_bytes(content)
    with atomic_write(readme) as temporary:
        temporary.write_text("\n\n".join(blocks) + "\n", encoding="utf-8")
    for name in earlier.difference(files):
        (copies / name).unlink(missing_ok=True)


def _names(titles: Iterable[str]) -> list[str]:
    """Names for links and files: small letters, digits and hyphens, no two alike."""
    names: list[str] = []
    for title in titles:
        name = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-") or "part"
        tries = (name if k == 1 else f"{name}-{k}" for k in count(1))
        names.append(next(one for one in tries if one not in names))
    return names


def _read(picture: Picture) -> bytes:
    if picture.path.suffix.lower() not in TYPES:
        raise ValueError(f"{picture.path}: the name must end in {', '.join(TYPES)}")
    try:
        return picture.path.read_bytes()
    except OSError as error:
        raise ValueError(f"{picture.path}: cannot be read ({error.strerror})") from error


def _earlier(readme: Path) -> set[str]:
    """Names of the pictures of an earlier page."""
    if not readme.exists():
        return set()
    first = readme.read_text(encoding="utf-8", errors="replace").split("\n")[0]
    if not first.startswith(MARK):
        raise ValueError(f"{readme}: is not of an earlier page; choose another folder")
    # Names without a slash: none leads to another folder.
    return {name for name in first.split() if re.fullmatch(r"[a-z0-9-]+\.(svg|png|jpg)", name)}


def _are_figures(table: Table) -> list[bool]:
    """For each column whether its cells are figures."""
    return [
        all(row[k].split(" ")[0] == MISSING or _FIGURE.match(row[k]) for row in table.rows)
        for k in range(len(table.columns))
    ]


def _html_section(name: str, section: Section) -> str:
    # No name of a section has an underscore, so ids inside the charts are none of the page's.
    pictures = [_html_picture(one, f"{name}_{k}_") for k, one in enumerate(section.pictures)]
    parts = [
        f'<section id="{name}">',
        f"<h2>{escape(section.title)}</h2>",
        _html_paragraphs(section.text),
        *map(_html_table, section.tables),
        *(['<div class="pictures">', *pictures, "</div>"] if pictures else []),
        f'<p class="source">{"<br>".join(map(as_html, lines(section.source)))}</p>',
        "</section>",
    ]
    return "\n".join(part for part in parts if part)


def _html_paragraphs(text: str) -> str:
    return "\n".join(f"<p>{as_html(paragraph)}</p>" for paragraph in paragraphs(text))


def _html_picture(picture: Picture, prefix: str) -> str:
    content, suffix = _read(picture), picture.path.suffix.lower()
    name = bare(picture.caption)
    try:
        if suffix == ".svg":
            seen = f'<div class="chart">{drawing(content, prefix, name)}</div>'
        else:
            seen = photo(content, suffix, name)
    except ValueError as error:
        raise ValueError(f"{picture.path}: {error}") from error
    credit = f" <small>{as_html(picture.credit)}</small>" if picture.credit else ""
    return f"<figure>{seen}<figcaption>{as_html(picture.caption)}{credit}</figcaption></figure>"


def _html_table(table: Table) -> str:
    sides = [' class="figures"' if figures else "" for figures in _are_figures(table)]
    headings = [
        f'<th scope="col"{side}><button type="button">{escape(heading)}</button></th>'
        for heading, side in zip(table.columns, sides, strict=True)
    ]
    rows = [
        "".join(f"<td{side}{_key(cell)}>{escape(cell)}</td>" for cell, side in pairs)
        for pairs in (zip(row, sides, strict=True) for row in table.rows)
    ]
    return "\n".join(
        [
            f"<figure><figcaption>{as_html(table.caption)}</figcaption>",
            f'<div class="scroll"><table><thead><tr>{"".join(headings)}</tr></thead>',
            *["<tbody>", *(f"<tr>{row}</tr>" for row in rows), "</tbody>"],
            "</table></div></figure>",
        ]
    )


def _key(cell: str) -> str:
    """What a cell is sorted by, where that is a figure."""
    figure = _FIGURE.match(cell)
    if not figure:
        return ""
    return f' data-key="{figure[0].replace(",", "").replace("inf", "Infinity")}"'


def _markdown_section(section: Section, files: Iterator[str]) -> Iterator[str]:
    """Write the blocks of a section; takes one of the files a picture."""
    yield f"## {literal(section.title)}"
    yield from map(as_markdown, paragraphs(section.text))
    for table in section.tables:
        yield as_markdown(table.caption)
        yield _markdown_table(table)
    for picture in section.pictures:
        yield f"![{literal(bare(picture.caption))}](pictures/{next(files)})"
        yield f"*{as_markdown(picture.caption)}* {as_markdown(picture.credit)}".strip()
    yield "\\\n".join(map(as_markdown, lines(section.source)))


def _markdown_table(table: Table) -> str:
    ruler = ["---:" if figures else "---" for figures in _are_figures(table)]
    rows = [map(literal, table.columns), ruler, *(map(literal, row) for row in table.rows)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)
