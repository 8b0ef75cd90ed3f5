"""Every link, anchor and picture of every page leads somewhere, and so do the pages that texts of the code name."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final
from urllib.parse import unquote

import pytest

from rmpa.cli.main import VERBS
from tests.docs.pages import PAGES, ROOT, USER_PAGES, anchors, links, name_of

if TYPE_CHECKING:
    from pathlib import Path

_TEXTS: Final = {".py", ".js", ".toml", ".yml", ".yaml", ".txt", ".sh", ".html", ""}
_NAMED: Final = re.compile(r"\b(?:docs/[\w/.-]+\.md|README\.md|CONTRIBUTING\.md)(?:#([\w-]+))?")
_VERB: Final = re.compile(r"(?:`|: )rmpa ((?:[a-z][a-z-]* ?)+)")


def wrong(link: str, page: Path) -> str:
    """What is wrong with a link of a page; empty if it leads somewhere."""
    name, _, anchor = unquote(link).partition("#")
    if name.startswith("/"):
        return "leads to a place on the reader's own machine"
    there = (page.parent / name).resolve() if name else page
    if not there.is_relative_to(ROOT) or not there.exists():
        return "is not there"
    if anchor and (there.suffix != ".md" or anchor not in anchors(there)):
        return "has no such heading"
    return ""


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_to_files_and_headings(page: Path) -> None:
    inner = sorted(link for link in links(page) if not re.match(r"[a-z]+:", link))
    assert {link: found for link in inner if (found := wrong(link, page))} == {}


def test_pages_that_the_code_names_are_there() -> None:
    missing = []
    folders = ("src/rmpa", "examples", "packaging", "scripts", "lab", ".github")
    for path in (ROOT / "setup.py", *(path for folder in folders for path in sorted((ROOT / folder).rglob("*")))):
        if path.suffix in _TEXTS and path.is_file() and not {"vendor", "__pycache__"}.intersection(path.parts):
            named = [found[0] for found in _NAMED.finditer(path.read_text(encoding="utf-8", errors="replace"))]
            missing += [f"{name_of(path)}: {name}" for name in named if wrong(name, ROOT / "README.md")]
    assert missing == []


@pytest.mark.parametrize("page", [*USER_PAGES, *sorted((ROOT / ".github").rglob("*.yml"))], ids=name_of)
def test_commands_that_are_named_are_there(page: Path) -> None:
    named = _VERB.findall(page.read_text(encoding="utf-8"))
    assert [words for words in named if words.split()[0] not in {verb.split()[0] for verb in VERBS}] == []
