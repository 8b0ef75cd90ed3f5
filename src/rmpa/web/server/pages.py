"""The committed files that the server gives: read once, served by their exact paths; all are in the wheel."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from typing import Final

_TYPES: Final = {".html": "text/html; charset=utf-8", ".css": "text/css; charset=utf-8"}
_PAGES: Final = {"/": "index.html", "/static/style.css": "style.css"}


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
    folder = files("rmpa.web") / "static"
    return {
        path: Page((folder / name).read_bytes(), _TYPES[name[name.rindex(".") :]]) for path, name in _PAGES.items()
    }
