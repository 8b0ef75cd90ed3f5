"""The report as one page of Markdown: what was claimed and came out, each experiment, and how it was run."""

from __future__ import annotations

import re
import shlex
from itertools import groupby
from typing import TYPE_CHECKING, Final

from lab.experiments.report import words
from lab.samples import summary

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from lab.experiments.manifest import Manifest
    from lab.experiments.model import Claim, Figure, Grid, Plan
    from lab.experiments.report.sections import Section

TITLE: Final = "Classic ROS beside RMPA: the paper's evaluation, run again"
_BOXES: Final = (
    "Boxes: quartiles and median; whiskers: p5 to p95; short bar: p99, each where the samples are enough for it."
)
_SHORT: Final = (
    "**A short run**: it shows that everything works. Its samples are too few for figures that could be quoted."
)
_LOOPBACK: Final = (
    "**On loopback**: without root or ROS 1, all ran on this machine's loopback with our own nodes and core "
    "in place of rospy, roscpp and roscore. No cable was shaped or cut. Figures of real ROS 1 may differ."
)
_LIBRARIES: Final = {"rospy": "rospy", "roscpp": "roscpp", "own": "our own library"}
_SAID_WITH_THE_CODE: Final = {"rmpa", "commit"}
_READING: Final = (
    "Classic ROS and RMPA took turns in one run on one machine; read ratios rather than absolute figures. Latency "
    "counts from the moment at which a message was due, not from when its sender got round to it. Beside each figure "
    "stands how late the host let sleeping processes wake meanwhile: what is not larger than that may be its doing."
)


def markdown(manifest: Manifest, sections: Sequence[Section], folder: Path, missing: str = "") -> str:
    """Write the page.

    Args:
        manifest: Of the run.
        sections: Its experiments.
        folder: Where the page will lie; images are named from there.
        missing: What is left out, and what would bring it.
    """
    blocks = [f"# {TITLE}", *_warnings(manifest, sections, missing), _lead(manifest)]
    blocks += _claims(sections)
    for section in sections:
        blocks += _section(section, folder)
    blocks += [*_noise(sections), *_manifest(manifest)]
    return "\n\n".join(blocks) + "\n"


def _warnings(manifest: Manifest, sections: Sequence[Section], missing: str) -> Iterator[str]:
    if manifest.plan.short:
        yield f"> {_SHORT}"
    if manifest.plan.bed == "loopback":
        yield f"> {_LOOPBACK}"
    if missing:
        yield f"> **Left out**: {missing}"
    failed = sum(len(section.failures) for section in sections)
    waiting = sum(section.waiting for section in sections)
    if failed or waiting:
        parts = [(failed, "could not be measured"), (waiting, "not measured yet")]
        said = "; ".join(f"{words.count(amount, 'cell')} {what}" for amount, what in parts if amount)
        yield f"> **Incomplete**: {said}."


def _lead(manifest: Manifest) -> str:
    machine, code = manifest.machine, manifest.code
    when = sorted(session.began[:10] for session in manifest.sessions)
    days = " and ".join(dict.fromkeys((when[0], when[-1]))) if when else "an unknown day"
    commit = f", commit {code.commit}{' with changes' if code.changed else ''}" if code.commit else ""
    cpu, cores, kernel = (words.plain(machine.get(name, "unknown")) for name in ("cpu", "cores", "kernel"))
    return (
        f"Measured on {days} by rmpa {words.plain(code.version + commit)}, on {cpu} with {cores} cores, "
        f"Linux {kernel}. {_bed(manifest.plan)} {_READING}"
    )


def _bed(plan: Plan) -> str:
    if plan.bed == "loopback":
        return "Every host of the bed is a process on loopback."
    link = f"cables of {words.link(plan.link)}" if plan.link else "cables that are not shaped"
    nodes = " and ".join(_LIBRARIES[client] for client in plan.clients)
    return f"Hosts are network namespaces on one bridge with {link}; both systems run the same nodes, of {nodes}."


# --- claims ---------------------------------------------------------------------------------------------------------


def _claims(sections: Sequence[Section]) -> Iterator[str]:
    claims = [(section, claim) for section in sections for claim in section.findings.claims]
    if not claims:
        return
    yield "## What came of it"
    outcome = [claim.reached for _, claim in claims]
    parts = [(True, "reached"), (False, "not reached"), (None, "with too few samples to say")]
    said = ", ".join(f"{outcome.count(value)} {what}" for value, what in parts if outcome.count(value))
    yield f"Of {words.count(len(claims), 'claim')}: {said}."
    rows: list[list[str]] = []
    for section, group in groupby(claims, lambda pair: pair[0]):
        for at, (_, claim) in enumerate(group):
            link = f"[{section.name}](#{words.slug(section.title)})"
            rows.append(["" if at else link, claim.text, *_figures(claim)])
    yield words.table(["", "what", "wanted", "measured", "the paper's", "verdict"], rows)


def _figures(claim: Claim) -> list[str]:
    paper = words.quantity(claim.paper, claim.unit) if claim.paper is not None else ""
    return [words.wanted(claim), words.measured(claim), paper, words.verdict(claim)]


# --- experiments ----------------------------------------------------------------------------------------------------


def _section(section: Section, folder: Path) -> Iterator[str]:
    yield f"## {section.title}"
    if section.about:
        yield section.about.strip()
    if section.problem:
        yield f"> **No findings**: {words.plain(section.problem)}"
    elif not section.cells:
        yield "Nothing of it was measured."
    claims = section.findings.claims
    if claims:
        yield words.table(
            ["what", "wanted", "measured", "the paper's", "verdict"],
            [[claim.text, *_figures(claim)] for claim in claims],
        )
    for figure in section.findings.figures:
        if figure.name in section.images:
            yield from _image(figure, *section.images[figure.name], folder)
    for grid in section.findings.grids:
        yield from _grid(grid)
    if section.findings.notes:
        yield "\n".join(f"- {note}" for note in section.findings.notes)
    if section.failures:
        lines = [
            f"- {words.plain(_settings(failure.settings))}: {words.plain(failure.error)}"
            for failure in section.failures
        ]
        yield "\n".join(["Could not be measured:", "", *lines])
    if section.waiting:
        yield f"Not measured yet: {words.count(section.waiting, 'cell')}."


def _image(figure: Figure, png: Path, svg: Path, folder: Path) -> Iterator[str]:
    boxed = any(series.style == "box" for panel in figure.panels for series in panel.series)
    caption = " ".join(filter(None, (figure.caption.strip(), _BOXES if boxed else "")))
    alt = words.plain(figure.title)
    yield f"[![{alt}]({png.relative_to(folder).as_posix()})]({svg.relative_to(folder).as_posix()})"
    if caption:
        yield caption


def _grid(grid: Grid) -> Iterator[str]:
    yield f"**{grid.title}**"
    yield words.table(list(grid.columns), [list(row) for row in grid.rows])
    if grid.note:
        yield re.sub(r"^[*+-] ", r"\\\g<0>", grid.note)  # a footnote is no list


def _settings(settings: object) -> str:
    return ", ".join(f"{name} {value}" for name, value in settings.items()) if isinstance(settings, dict) else ""


# --- how it was run -------------------------------------------------------------------------------------------------


def _noise(sections: Sequence[Section]) -> Iterator[str]:
    rows = []
    for section in sections:
        if section.lateness:
            whole = summary(section.lateness)
            figures = [words.number(value) for value in (whole.p50, whole.p95, whole.p99, whole.largest)]
            rows.append([section.name, f"{whole.count:,}", *figures])
    if rows:
        yield "## The host's own noise"
        yield (
            "How late a process that sleeps towards a fixed schedule of 1 ms wakes up, in µs, before and after each "
            "cell. The scheduler adds about this much to everything that waits."
        )
        yield words.table(["beside", "sleeps", "p50", "p95", "p99", "largest"], rows)


def _manifest(manifest: Manifest) -> Iterator[str]:
    plan, code = manifest.plan, manifest.code
    spent = sum(record.seconds for record in manifest.cells.values())
    done = sum(record.state == "done" for record in manifest.cells.values())
    again = sum(record.attempts > 1 for record in manifest.cells.values())
    yield "## How it was run"
    rows = [
        ["size", plan.size],
        ["bed", plan.bed],
        ["nodes of", ", ".join(plan.clients)],
        ["cables", words.link(plan.link)],
        ["seed", str(plan.seed)],
        ["code", f"rmpa {code.version}, digest {code.digest}" + (f", commit {code.commit}" if code.commit else "")],
        ["files changed since that commit", "yes" if code.changed else "no"],
        ["cells measured", f"{done:,} of {len(manifest.cells):,}"],
        ["cells tried more than once", f"{again:,}"],
        ["time spent measuring", f"{spent / 60:.1f} min"],
        *(
            [name.replace("_", " "), words.value(value)]
            for name, value in manifest.machine.items()
            if value != "" and name not in _SAID_WITH_THE_CODE
        ),
    ]
    yield words.table(["", ""], [[words.plain(name), words.plain(value)] for name, value in rows])
    for session in manifest.sessions:
        load = ", ".join(f"{one:.2f}" for one in session.load)
        ended = f"{session.end} {session.ended}".strip() or "was killed"
        command = shlex.join(session.argv)
        yield f"```text\n{command}\nbegan {session.began}, {ended}; load averages before: {load or 'unknown'}\n```"
    yield (
        "Raw samples: `EXPERIMENT/CELL/TABLE.csv` in the run directory; `manifest.json` there has the settings, "
        "duration and facts of every cell."
    )
