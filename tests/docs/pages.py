"""The Markdown pages of the repository: their headings, links, pictures and blocks of commands."""

from __future__ import annotations

import functools
import itertools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from markdown_it import MarkdownIt

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT: Final = Path(__file__).parents[2]
_MADE: Final = {"dist", "build", "site"}
PAGES: Final = sorted(
    path
    for path in ROOT.rglob("*.md")
    if not (place := path.relative_to(ROOT).parts)[0].startswith(".") and place[0] not in _MADE
)
"""Every page of the repository."""
USER_PAGES: Final = [
    path for path in PAGES if path.relative_to(ROOT).parts[:2] != ("docs", "design") and "docs" in path.parts
] + [ROOT / "README.md"]
"""The pages that users read."""
_OPTIONS: Final = MarkdownIt("commonmark").enable("table")


def name_of(path: Path) -> str:
    """A page by its path in the repository."""
    return str(path.relative_to(ROOT))


def slug(heading: str) -> str:
    """The anchor of a heading, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")


@functools.cache
def anchors(path: Path) -> frozenset[str]:
    """What may follow the ``#`` of a link to a page: its headings, of equal ones the first."""
    tokens = _OPTIONS.parse(path.read_text(encoding="utf-8"))
    headings = [
        "".join(part.content for part in after.children or () if part.type in {"text", "code_inline"})
        for before, after in itertools.pairwise(tokens)
        if before.type == "heading_open"
    ]
    return frozenset(map(slug, headings))


@functools.cache
def links(path: Path) -> frozenset[str]:
    """Where the links and pictures of a page lead."""
    found: set[str] = set()
    for token in _OPTIONS.parse(path.read_text(encoding="utf-8")):
        for part in (token, *(token.children or ())):
            for key in ("href", "src"):
                if key in part.attrs:
                    found.add(str(part.attrs[key]))
            if part.type in {"html_block", "html_inline"}:
                found.update(re.findall(r"""(?:href|src)=["']([^"']+)""", part.content))
    return frozenset(found)


@dataclass(frozen=True)
class Block:
    """A block of code of a page, fenced or indented.

    Attributes:
        page: Where it is.
        line: The number of its first line.
        language: What follows the fence.
        mark: The text of the comment on the line before it; empty without.
        text: What it has.
    """

    page: Path
    line: int
    language: str
    mark: str
    text: str

    def __str__(self) -> str:
        return f"{name_of(self.page)}:{self.line}"


def blocks(path: Path) -> Iterator[Block]:
    """The blocks of code of a page in their order."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    for token in _OPTIONS.parse(text):
        if token.type in {"fence", "code_block"} and token.map:
            before = re.fullmatch(r"\s*<!-- (.*?) -->\s*", lines[token.map[0] - 1]) if token.map[0] else None
            yield Block(path, token.map[0] + 1, token.info.strip(), before[1] if before else "", token.content)
