"""What mkdocs.yml cannot say: anchors as GitHub's, links into the published repository, accessible HTML."""

import posixpath
import re
import tomllib
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)\s#]+)")


def slug(heading: str, _separator: str = "-") -> str:
    """The anchor of a heading, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")


def on_config(config: MkDocsConfig) -> None:
    """Set what is made by code."""
    config.mdx_configs["toc"]["slugify"] = slug


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """The page with the links that GitHub follows into the repository made absolute."""
    del files
    url = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["rmpa"]["url"]
    docs = Path(config.docs_dir).name

    def published(link: re.Match[str]) -> str:
        place = posixpath.normpath(posixpath.join(docs, posixpath.dirname(page.file.src_uri), link[1]))
        if place.startswith(f"{docs}/"):
            return link[0]
        return f"{url}/{'tree' if (ROOT / place).is_dir() else 'blob'}/HEAD/{place}"

    return LINK.sub(published, markdown)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """The page with what the theme and Markdown leave out for screen readers and keyboards."""
    del page, config
    for plain, accessible in {
        'data-md-component="search" role="dialog">': 'data-md-component="search" role="dialog" aria-label="Search">',
        '<nav class="md-nav" aria-label="': '<nav class="md-nav" aria-label="Part ',  # a section has that name too
        "<th></th>": "<td></td>",  # of a table without headings
    }.items():
        output = output.replace(plain, accessible)
    return output
