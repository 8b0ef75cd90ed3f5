"""What the report says of each experiment, gathered from a run directory."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lab.experiments.registry import find_experiment
from lab.findings import Figure, Findings
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from lab.experiments.model import Experiment, Results, Value
    from lab.experiments.store import Store

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FailedCell:
    """A cell that could not be measured.

    Args:
        settings: Which.
        error: Why.
    """

    settings: Mapping[str, Value]
    error: str


@dataclass(frozen=True, slots=True)
class Section:
    """One experiment.

    Args:
        name: As the command line has it.
        title: Its heading.
        about: What is measured, and how, in Markdown.
        findings: What follows.
        cells: How many were measured.
        waiting: How many have not been tried yet.
        failures: Those that could not be measured.
        lateness: How late the host woke up before and after each cell, µs.
        images: The files of each figure by its name, PNG and SVG; empty where they could not be drawn.
        problem: Why there are no findings; empty if there are.
    """

    name: str
    title: str
    about: str
    findings: Findings
    cells: int
    waiting: int
    failures: Sequence[FailedCell]
    lateness: Sequence[float]
    images: Mapping[str, tuple[Path, Path]]
    problem: str = ""


def gather(
    store: Store,
    name: str,
    draw: Callable[[Figure, Sequence[float]], tuple[Path, Path]] | None = None,
    find: Callable[[str], Experiment] = find_experiment,
) -> Section:
    """Read an experiment's samples and say what follows.

    Args:
        store: The run directory.
        name: Which experiment.
        draw: Draws a figure with the host's lateness beside it and returns its files; without it there are none.
        find: Finds the experiment.

    Returns:
        A section with a ``problem`` where the samples cannot be read or make no sense: the others can still be told.
    """
    failures = [FailedCell(record.settings, record.error) for record in store.records(name, "failed")]
    title, about, cells = store.manifest.titles.get(name, name), "", 0
    late: list[float] = []
    images: dict[str, tuple[Path, Path]] = {}
    findings, problem = Findings(), ""
    try:
        asked = find(name)
        title, about = asked.title, asked.about
        results = store.results(name)
        cells, late = len(results.cells), lateness(results)
        if cells:
            findings = asked.findings(results)
        if draw is not None:
            for figure in findings.figures:
                images[figure.name] = draw(figure, late)
    except RmpaError as error:
        problem = str(error)
    except Exception as error:  # noqa: BLE001 - an experiment that fails must not take the others' report away
        _log.exception("%s: no findings", name)
        problem = f"{type(error).__name__}: {error}"
    waiting = len(store.records(name, "planned"))
    return Section(name, title, about, findings, cells, waiting, failures, late, images, problem)


def lateness(results: Results) -> list[float]:
    """How late the host woke up beside the cells of an experiment, µs."""
    tables = [measured.tables["lateness"] for _, measured in results.cells if "lateness" in measured.tables]
    return [late for table in tables for late in table["late_us"].tolist()]
