"""The report as one page: Markdown from ``report.md.j2``, and from that one HTML file that needs no other."""

from __future__ import annotations

import base64
import html
import re
import shlex
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Final

import jinja2
from markdown_it import MarkdownIt

from lab import words
from lab.samples import summary

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lab.experiments.manifest import Manifest
    from lab.experiments.report.sections import Section
    from lab.findings import Claim, Figure

TITLE: Final = "Classic ROS beside RMPA: the paper's evaluation, run again"
_SAID_WITH_THE_CODE: Final = {"rmpa", "commit"}
_IMAGE: Final = re.compile(r'<a href="(?P<svg>[^"]+\.svg)"><img src="[^"]+\.png" alt="(?P<alt>[^"]*)" ?/?></a>')


def markdown(manifest: Manifest, sections: Sequence[Section], folder: Path, missing: str = "") -> str:
    """Write the page.

    Args:
        manifest: Of the run.
        sections: Its experiments.
        folder: Where the page will lie; images are named from there.
        missing: What is left out, and why.
    """
    code, days = manifest.code, sorted(session.began[:10] for session in manifest.sessions)
    commit = f", commit {code.commit}{' with changes' if code.changed else ''}" if code.commit else ""
    reached = [claim.reached for section in sections for claim in section.findings.claims]
    text = (
        _templates()
        .get_template("report.md.j2")
        .render(
            title=TITLE,
            manifest=manifest,
            plan=manifest.plan,
            machine=manifest.machine,
            sections=sections,
            folder=folder,
            missing=missing,
            days=" and ".join(dict.fromkeys((days[0], days[-1]))) if days else "an unknown day",
            commit=code.version + commit,
            nodes=" and ".join(manifest.plan.clients),
            incomplete=_amounts(
                "; ",
                (words.count(sum(len(one.failures) for one in sections), "cell"), "could not be measured"),
                (words.count(sum(one.waiting for one in sections), "cell"), "not measured yet"),
            ),
            outcome=_amounts(
                ", ",
                (str(reached.count(True)), "reached"),
                (str(reached.count(False)), "not reached"),
                (str(reached.count(None)), "with too few samples to say"),
            ),
            claims=_claims(sections),
            noise=_noise(sections),
            facts=_facts(manifest),
        )
    )
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


def page(text: str, title: str, folder: Path) -> str:
    """Make the HTML of a Markdown page; images are taken in as SVG.

    Args:
        text: The page; HTML in it is text.
        title: Of the window.
        folder: From where its images are named.
    """
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(text)
    for at, token in enumerate(tokens):
        if token.type == "heading_open":
            token.attrSet("id", words.slug(tokens[at + 1].content))
    body = parser.renderer.render(tokens, parser.options, {})
    body = _IMAGE.sub(lambda found: _embedded(folder / html.unescape(found["svg"]), found["alt"]), body)
    body = body.replace("<table>", '<div class="wide"><table>').replace("</table>", "</table></div>")
    return _templates(escape=True).get_template("page.html.j2").render(title=title, body=body)


def _templates(*, escape: bool = False) -> jinja2.Environment:
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        autoescape=escape,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.globals["table"] = words.table
    made.filters |= {
        "boxed": _boxed,
        "command": shlex.join,
        "count": words.count,
        "footnote": lambda note: re.sub(r"^[*+-] ", r"\\\g<0>", note),  # a footnote is no list
        "link": words.link,
        "loads": lambda load: ", ".join(f"{one:.2f}" for one in load),
        "plain": words.plain,
        "row": _row,
        "settings": lambda settings: ", ".join(f"{name} {value}" for name, value in settings.items()),
        "within": lambda path, folder: path.relative_to(folder).as_posix(),
    }
    return made


def _embedded(svg: Path, alt: str) -> str:
    return f'<img src="data:image/svg+xml;base64,{base64.b64encode(svg.read_bytes()).decode()}" alt="{alt}">'


def _boxed(figure: Figure) -> bool:
    return any(series.style == "box" for panel in figure.panels for series in panel.series)


def _amounts(mark: str, *parts: tuple[str, str]) -> str:
    """The amounts that are not 0, with what they are of."""
    return mark.join(f"{amount} {what}" for amount, what in parts if not amount.startswith("0"))


def _claims(sections: Sequence[Section]) -> list[list[str]]:
    """The rows of all claims; the name of the experiment stands in its first one."""
    claims = [(section, claim) for section in sections for claim in section.findings.claims]
    rows: list[list[str]] = []
    for section, group in groupby(claims, lambda pair: pair[0]):
        link = f"[{section.name}](#{words.slug(section.title)})"
        rows += [["" if at else link, *_row(claim)] for at, (_, claim) in enumerate(group)]
    return rows


def _row(claim: Claim) -> list[str]:
    paper = words.quantity(claim.paper, claim.unit) if claim.paper is not None else ""
    return [claim.text, words.wanted(claim), words.measured(claim), paper, words.verdict(claim)]


def _noise(sections: Sequence[Section]) -> list[list[str]]:
    rows = []
    for section in sections:
        if section.lateness:
            whole = summary(section.lateness)
            figures = [words.number(value) for value in (whole.p50, whole.p95, whole.p99, whole.largest)]
            rows.append([section.name, f"{whole.count:,}", *figures])
    return rows


def _facts(manifest: Manifest) -> list[list[str]]:
    """What the run was asked for, what measured, and what it was measured on."""
    plan, code, cells = manifest.plan, manifest.code, manifest.cells.values()
    rows = [
        ["size", plan.size],
        ["nodes of", ", ".join(plan.clients)],
        ["cables", words.link(plan.link)],
        ["seed", str(plan.seed)],
        ["code", f"rmpa {code.version}, digest {code.digest}" + (f", commit {code.commit}" if code.commit else "")],
        ["files changed since that commit", "yes" if code.changed else "no"],
        ["cells measured", f"{sum(one.state == 'done' for one in cells):,} of {len(cells):,}"],
        ["cells tried more than once", f"{sum(one.attempts > 1 for one in cells):,}"],
        ["time spent measuring", f"{sum(one.seconds for one in cells) / 60:.1f} min"],
        *(
            [name.replace("_", " "), words.value(value)]
            for name, value in manifest.machine.items()
            if value != "" and name not in _SAID_WITH_THE_CODE
        ),
    ]
    return [[words.plain(name), words.plain(value)] for name, value in rows]
