"""Text of a page, and three forms in it: ```code```, ``**bold**``, ``[words](https://...)``.

All else is plain: neither a ``<`` nor a ``_`` means anything.
"""

import re
from collections.abc import Iterator
from html import escape

_FORMS = re.compile(
    r"`(?P<code>[^`]+)`|\*\*(?P<bold>[^*]+)\*\*|\[(?P<words>[^\]]+)\]\((?P<link>https?://[^\s()]+)\)"
)
# Whatever means something to Markdown, also what does so at the start of a line only.
_SPECIAL = re.compile(r"[\\`*_\[\]<>|~&$]|^[-+](?=\s)|^#|(?<=^\d)[.)](?=\s)")

_HTML = {
    "plain": "{}",
    "code": "<code>{}</code>",
    "bold": "<strong>{}</strong>",
    "link": '<a href="{1}">{0}</a>',
}
_MARKDOWN = {"plain": "{}", "code": "`{}`", "bold": "**{}**", "link": "[{}]({})"}


def paragraphs(text: str) -> list[str]:
    """Split text at blank lines; each paragraph is one line."""
    return [" ".join(lines.split()) for lines in re.split(r"\n\s*\n", text) if lines.strip()]


def lines(text: str) -> list[str]:
    """Split text at the ends of its lines; empty ones are dropped."""
    return [" ".join(line.split()) for line in text.splitlines() if line.strip()]


def as_html(text: str) -> str:
    """Write prose as HTML, to stand between two tags."""
    return "".join(
        _HTML[kind].format(escape(words), escape(link)) for kind, words, link in _parts(text)
    )


def as_markdown(text: str) -> str:
    """Write prose as Markdown that looks the same."""
    return "".join(
        _MARKDOWN[kind].format(words if kind == "code" else _escaped(words), link)
        for kind, words, link in _parts(" ".join(text.split()))
    )


def literal(text: str) -> str:
    """Write text as Markdown in which nothing stands out; without the ends of its lines."""
    return _escaped(" ".join(text.split()))


def bare(text: str) -> str:
    """Leave the words of prose, for where nothing can stand out."""
    return "".join(words for _, words, _ in _parts(text))


def _escaped(text: str) -> str:
    return _SPECIAL.sub(r"\\\g<0>", text)


def _parts(text: str) -> Iterator[tuple[str, str, str]]:
    """Take prose apart: the kind of each part, its words, and where it leads."""
    end = 0
    for match in _FORMS.finditer(text):
        yield "plain", text[end : match.start()], ""
        kind = str(match.lastgroup)
        yield kind, match["words"] or match[kind], match["link"] or ""
        end = match.end()
    yield "plain", text[end:], ""
