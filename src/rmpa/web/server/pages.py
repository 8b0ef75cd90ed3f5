"""The committed files that the server gives: read once, served by their exact paths; all are in the wheel."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator
    from importlib.abc import Traversable

_TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
_FIRST: Final = "index.html"
"""Is served at ``/``, all others below ``/static/``; files of other kinds, as licences, are not served."""


@dataclass(frozen=True, slots=True)
class Page:
    """One file, with its content type."""

    body: bytes
    content_type: str

    @property
    def is_html(self) -> bool:
        """Whether it is a page for people."""
        return self.content_type.startswith("text/html")


def read_pages() -> dict[str, Page]:
    """All files, by path."""
    return dict(_pages(files("rmpa.web") / "static", "/static/"))


def _pages(folder: Traversable, path: str) -> Iterator[tuple[str, Page]]:
    for each in folder.iterdir():
        content_type = _TYPES.get(PurePosixPath(each.name).suffix)
        if each.is_dir():
            yield from _pages(each, f"{path}{each.name}/")
        elif content_type is not None:
            yield "/" if each.name == _FIRST else f"{path}{each.name}", Page(each.read_bytes(), content_type)
