"""The built site in Chromium, read from disk: for a phone, a screen reader, on paper, and without a network."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from typing import TYPE_CHECKING, Any, Final

import pytest

from lab.bed.chromium import BINARY, Chromium
from tests.docs.pages import ROOT

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

AXE: Final = ROOT / "tests/web/browser/vendor/axe.min.js"
PAGES: Final = (
    "index",
    "start/two-robots",
    "guides/smart-resources",
    "reference/commands",
    "reference/settings",
    "design/protocol",
)
PHONE: Final = 390
pytestmark = [
    pytest.mark.long,  # CI builds the site by `make docs`, which refuses broken links
    pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="MkDocs is not installed (the extra docs)"),
    pytest.mark.timeout(120),
]
browser = pytest.mark.skipif(BINARY is None, reason="Chromium is not installed: apt install chromium")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the site, which is built without a warning."""
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-W", "ignore", "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
async def page() -> AsyncIterator[Chromium]:
    """A browser."""
    async with Chromium() as one:
        yield one


async def opened(page: Chromium, site: Path, name: str) -> None:
    """Open a page of the site from disk."""
    await page.goto(f"{(site / name).as_uri()}.html")
    await page.wait(f"location.pathname.endsWith('{name}.html') && document.readyState === 'complete'")
    await page.wait("document.querySelector('h1')")


async def violations(page: Chromium) -> list[str]:
    """What axe-core finds: the rule, and the first element."""
    await page.run(AXE.read_text(encoding="utf-8") + "; true")
    found: list[Any] = await page.run(
        "axe.run(document, {preload: false}).then((done) => done.violations.map((rule) =>"
        " `${rule.id}: ${rule.nodes[0].html.slice(0, 160)} ${rule.nodes[0].failureSummary.slice(0, 200)}`))"
    )
    return [str(each) for each in found]


def test_the_pages_load_nothing_from_elsewhere(site: Path) -> None:
    loaded = re.compile(
        r"""<(?:script|img|iframe|source)\b[^>]*\bsrc=["']?(?:https?:)?//[^"'>\s]+"""
        r"""|<link\b(?![^>]*rel=["']?canonical)[^>]*\bhref=["']?(?:https?:)?//[^"'>\s]+|url\(["']?(?:https?:)?//[^)]+"""
    )
    pages = [path for path in site.rglob("*") if path.suffix in {".html", ".css"}]
    assert len(pages) > 30
    assert {path.name: found for path in pages if (found := loaded.findall(path.read_text(encoding="utf-8")))} == {}


@browser
@pytest.mark.parametrize("name", PAGES)
async def test_a_page_fits_a_phone_and_is_accessible_in_both_colours(site: Path, page: Chromium, name: str) -> None:
    for width, dark in ((PHONE, False), (1280, True)):
        await page.look(width, 800, dark=dark)
        await opened(page, site, name)
        assert await page.run("document.documentElement.scrollWidth") == width
        assert await page.run("document.body.dataset.mdColorScheme") == ("slate" if dark else "default")
        assert await violations(page) == []
    assert page.errors == []


@browser
async def test_a_page_on_paper_has_the_text_alone_and_whole(site: Path, page: Chromium) -> None:
    await page.look(720, 1000, dark=False)
    await opened(page, site, "reference/commands")
    await page.send("Emulation.setEmulatedMedia", media="print")
    shown = "[...document.querySelectorAll('.md-header, .md-sidebar, .md-tabs')].filter((each) => each.offsetHeight)"
    assert await page.run(f"{shown}.map((each) => each.className)") == []
    cut = "[...document.querySelectorAll('pre > code')].filter((each) => each.scrollWidth > each.clientWidth + 1)"
    assert await page.run(f"{cut}.map((each) => each.textContent)") == []


@browser
async def test_the_search_answers_from_disk(site: Path, page: Chromium) -> None:
    await page.look(1280, 900)
    await opened(page, site, "index")
    await page.run("document.querySelector('.md-search__input').focus()")
    for key in "multicast":
        await page.press(key)
    await page.wait("document.querySelectorAll('.md-search-result__item').length > 3")
    assert page.errors == []
