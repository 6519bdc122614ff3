"""Pictures inside a web page: SVG as elements of it, photos as data."""

from __future__ import annotations

import re
from base64 import b64encode
from html import escape
from xml.etree import ElementTree

TYPES = {".svg": "image/svg+xml", ".png": "image/png", ".jpg": "image/jpeg"}
"""Kinds of pictures, by the suffix of their file."""

_SPACE = "{http://www.w3.org/2000/svg}"
_LINKS = ("href", "{http://www.w3.org/1999/xlink}href")
_DROPPED = ("metadata", "script", "foreignObject")


def photo(content: bytes, suffix: str, name: str) -> str:
    """Make an element of a picture of pixels.

    Parameters
    ----------
    content : bytes
        Of the file.
    suffix : str
        One of `TYPES`.
    name : str
        What is seen, for those who do not see it.
    """
    data = b64encode(content).decode()
    return f'<img src="data:{TYPES[suffix]};base64,{data}" alt="{escape(name)}">'


def drawing(content: bytes, prefix: str, name: str) -> str:
    """Make an element of an SVG picture, to stand in a page beside others.

    Several charts by matplotlib use the same ids, and all that refers to one of them would find
    the first chart's.

    Parameters
    ----------
    content : bytes
        Of the file.
    prefix : str
        Put in front of every id, and of what refers to it; another for each picture of the page.
    name : str
        What is seen, for those who do not see it.

    Raises
    ------
    ValueError
        If it is no SVG, or refers to what is not part of it.
    """
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        raise ValueError(f"is not an SVG picture ({error})") from error
    if root.tag != _SPACE + "svg":
        raise ValueError("is not an SVG picture")
    _clean(root, prefix)
    root.attrib.update({"id": prefix, "role": "img", "aria-label": name})
    return ElementTree.tostring(root, encoding="unicode")


def _clean(element: ElementTree.Element, prefix: str) -> None:
    """Rename ids, and leave only what HTML knows: it has no namespaces."""
    element.tag = element.tag.removeprefix(_SPACE)
    element.attrib = dict(_attributes(element, prefix))
    if element.tag == "style":
        # A style sheet holds for the whole page, wherever in it it stands.
        element.text = f"#{prefix} {{ {_renamed(element.text or '', prefix)} }}"
    for child in list(element):
        name = child.tag.removeprefix(_SPACE)
        if name in _DROPPED or name.startswith("{"):
            element.remove(child)
        else:
            _clean(child, prefix)


def _attributes(element: ElementTree.Element, prefix: str) -> list[tuple[str, str]]:
    changed = []
    for key, value in element.attrib.items():
        if key == "id":
            changed.append((key, prefix + value))
        elif key in _LINKS:
            if not value.startswith(("#", "data:")):
                raise ValueError(f"refers to {value}, which is not part of it")
            changed.append(("href", re.sub("^#", f"#{prefix}", value)))
        elif not key.startswith(("{", "on")):
            changed.append((key, _renamed(value, prefix)))
    return changed


def _renamed(value: str, prefix: str) -> str:
    """Rename what ``url(#name)`` refers to."""
    return re.sub(r"""(url\(\s*['"]?#)""", rf"\1{prefix}", value)
