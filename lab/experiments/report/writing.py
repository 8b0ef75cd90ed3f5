"""Writes a run directory's ``report/``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from lab.experiments.registry import find_experiment
from lab.experiments.report import page
from lab.experiments.report.sections import gather
from lab.experiments.store import Store
from lab.figures import drawing
from rmpa.core.errors import StartError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from lab.experiments.model import Experiment
    from lab.findings import Figure, Findings


@dataclass(frozen=True, slots=True)
class Report:
    """What was written.

    Args:
        html: One page that needs no other file.
        markdown: The same, with images beside it.
        figures: The images.
        findings: What was found, by experiment.
        missing: What is left out and what would bring it; empty if nothing.
    """

    html: Path
    markdown: Path
    figures: tuple[Path, ...]
    findings: Mapping[str, Findings]
    missing: str


def write_report(directory: Path, find: Callable[[str], Experiment] = find_experiment) -> Report:
    """Write ``report/report.html``, ``report.md`` and ``figures/`` from what a run directory holds.

    Args:
        directory: The run's.
        find: Finds an experiment by name.

    Raises:
        ConfigError: It is no run directory.
        StartError: It cannot be written to.
    """
    store = Store.load(directory)
    folder = directory / "report"
    images = folder / "figures"
    try:
        images.mkdir(parents=True, exist_ok=True)
        return _write(store, folder, images, find)
    except OSError as error:
        raise StartError(str(folder), f"cannot be written to ({error.strerror})") from None


def _write(store: Store, folder: Path, images: Path, find: Callable[[str], Experiment]) -> Report:
    def draw(figure: Figure, lateness: Sequence[float]) -> tuple[Path, Path]:
        return drawing.draw(figure, lateness, images)

    sections = [gather(store, name, draw, find) for name in store.names]
    drawn = tuple(path for section in sections for pair in section.images.values() for path in pair)
    for old in {*images.glob("*.png"), *images.glob("*.svg")} - set(drawn):
        old.unlink()
    missing = "; ".join(f"findings of {section.name} ({section.problem})" for section in sections if section.problem)
    text = page.markdown(store.manifest, sections, folder, missing)
    report = Report(
        folder / "report.html",
        folder / "report.md",
        drawn,
        {section.name: section.findings for section in sections},
        missing,
    )
    report.markdown.write_text(text, encoding="utf-8")
    report.html.write_text(page.page(text, page.TITLE, folder), encoding="utf-8")
    return report
