"""The same page as one HTML file that needs no other."""

from __future__ import annotations

import base64
import html
import re
from typing import TYPE_CHECKING, Final

from markdown_it import MarkdownIt

from lab.experiments.report.words import slug

if TYPE_CHECKING:
    from pathlib import Path

_STYLE: Final = """
:root { color-scheme: light dark; }
body { font: 16px/1.55 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto 6rem; padding: 0 1rem; }
h1, h2 { line-height: 1.25; } h2 { margin-top: 3rem; border-bottom: 1px solid #8885; padding-bottom: .2rem; }
img { max-width: 100%; background: #fff; border-radius: 4px; }
div.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: .9rem; margin: .5rem 0; }
th, td { border-bottom: 1px solid #8884; padding: .3rem .7rem; text-align: left; vertical-align: top; }
td { font-variant-numeric: tabular-nums; }
blockquote { margin: 1rem 0; padding: .1rem 1rem; border-left: 4px solid #d55e00; background: #d55e0018; }
pre { overflow-x: auto; background: #8882; padding: .7rem; border-radius: 4px; } code { font-size: .88em; }
"""
_PAGE: Final = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
{body}
</body>
</html>
"""
_IMAGE: Final = re.compile(r'<a href="(?P<svg>[^"]+\.svg)"><img src="[^"]+\.png" alt="(?P<alt>[^"]*)" ?/?></a>')


def page(markdown: str, title: str, folder: Path) -> str:
    """Make the HTML of a Markdown page; images are taken in as SVG.

    Args:
        markdown: The page; HTML in it is text.
        title: Of the window.
        folder: From where its images are named.
    """
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(markdown)
    for at, token in enumerate(tokens):
        if token.type == "heading_open":
            token.attrSet("id", slug(tokens[at + 1].content))
    body = parser.renderer.render(tokens, parser.options, {})
    body = _IMAGE.sub(lambda found: _embedded(folder / html.unescape(found["svg"]), found["alt"]), body)
    body = body.replace("<table>", '<div class="wide"><table>').replace("</table>", "</table></div>")
    return _PAGE.format(title=html.escape(title), style=_STYLE, body=body)


def _embedded(svg: Path, alt: str) -> str:
    return f'<img src="data:image/svg+xml;base64,{base64.b64encode(svg.read_bytes()).decode()}" alt="{alt}">'
