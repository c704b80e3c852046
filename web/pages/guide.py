"""The guide from its Markdown, for an installation where ``make docs`` has not built it."""

from __future__ import annotations

import re
from functools import cache
from itertools import pairwise
from pathlib import Path

from markdown_it import MarkdownIt
from markupsafe import Markup

from spheremark.pipelines.errors import NotFoundError
from spheremark.web import assets
from spheremark.web.glossary import anchor
from spheremark.web.pages.base import Frame
from spheremark.web.templating import render

_OF_CHECKOUT = {"commands": "REFERENCE.md", "conventions": "CONVENTIONS.md"}  # not in a wheel
_LISTED = re.compile(r"^(?:made/)?([\w-]+)$", re.M)
_INCLUDE = re.compile(r'```\{include\} (\S+)\n:start-after: "(.+)"\n:end-before: "(.+)"\n```\n')
_NOT_HERE = re.compile(r"^```\{.*?^```\n|^!\[[^\n]*\n", re.M | re.S)
_LINK = re.compile(r"\]\((?:made/)?([\w-]+)\.md(#[\w-]+)?\)")


def guide_page(frame: Frame, name: str) -> str:
    """Return a page of the guide; NotFoundError where there is none of that name."""
    pages = {page: _title(path) for page, path in _sources().items()}
    if name not in pages:
        raise NotFoundError(f"The guide has no page {name[:200]!r}; /guide/ lists its pages.")
    return render("guide.html", frame=frame, pages=pages, name=name, content=_html(name))


@cache
def _sources() -> dict[str, Path]:
    """Return the pages that are here by name, in the order of the guide's list."""
    folder = assets.guide_folder().parent
    checkout = {name: folder.parents[1] / path for name, path in _OF_CHECKOUT.items()}
    names = ["index", *_LISTED.findall((folder / "index.md").read_text("utf-8"))]
    paths = {name: checkout.get(name, folder / f"{name}.md") for name in names}
    return {name: path for name, path in paths.items() if path.is_file()}


def _title(path: Path) -> str:
    """Return the first heading of a page."""
    with path.open(encoding="utf-8") as file:
        return file.readline().removeprefix("# ").strip()


@cache
def _html(name: str) -> Markup:
    """Return a page as HTML: pictures and parts that only Sphinx makes are left out."""
    path = _sources()[name]
    text = _NOT_HERE.sub(
        "", _INCLUDE.sub(lambda part: _part_of(path, *part.groups()), path.read_text("utf-8"))
    )
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(_LINK.sub(_address, text))
    for head, inline in pairwise(tokens):
        if head.type == "heading_open":
            head.attrSet("id", re.sub("-+", "-", anchor(inline.content)).strip("-"))
    made = parser.renderer.render(tokens, parser.options, {})
    made = made.replace("<table>", '<div class="panel scroll"><table>').replace(
        "</table>", "</table></div>"
    )
    return Markup(made.replace("<pre>", '<pre tabindex="0">'))  # all else was escaped by the parser


def _part_of(path: Path, file: str, begin: str, end: str) -> str:
    """Return the part of another file between two texts; nothing where that is not installed."""
    other = (path.parent / file).resolve()
    return other.read_text("utf-8").partition(begin)[2].partition(end)[0] if other.is_file() else ""


def _address(link: re.Match[str]) -> str:
    """Return a link between files as one between pages."""
    name, place = link[1], link[2] or ""
    return f"](/glossary{place})" if name == "glossary" else f"](/guide/{name}{place})"
