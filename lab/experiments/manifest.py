"""``manifest.json`` of a run directory: plan, code, machine, sessions, and the outcome of each cell."""

from __future__ import annotations

from typing import Literal

import msgspec

from lab.bed.plan import Plan  # noqa: TC001 - msgspec reads these types when it decodes
from lab.experiments.code import Code  # noqa: TC001 - likewise
from lab.experiments.model import Value  # noqa: TC001 - likewise

# Of ``manifest.json``; another number is another layout.
FORMAT = 1


class CellRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One cell.

    Attributes:
        experiment: The name of its experiment.
        settings: As of ``model.Cell``.
        expected: Seconds that it was expected to take.
        state: ``planned``: not measured yet.
        began: UTC, ISO 8601; the last attempt.
        seconds: That the last attempt took, with what is around it.
        attempts: How often it was tried.
        facts: Single values that were measured.
        tables: What the columns of each of its CSV files hold (``frames.kinds``), by the file's name.
        error: Why it failed, or why the attempt before did.
    """

    experiment: str
    settings: dict[str, Value]
    expected: float
    state: Literal["planned", "done", "failed"] = "planned"
    began: str = ""
    seconds: float = 0.0
    attempts: int = 0
    facts: dict[str, Value] = {}
    tables: dict[str, dict[str, str]] = {}
    error: str = ""


class Session(msgspec.Struct, kw_only=True):
    """One call of ``experiment run``; a run that was interrupted has several.

    Attributes:
        argv: The command line.
        began: UTC, ISO 8601.
        ended: Likewise; empty while it runs, and if it was killed.
        end: How it ended.
        load: The machine's load averages when it began.
    """

    argv: list[str]
    began: str
    ended: str = ""
    end: Literal["", "finished", "interrupted"] = ""
    load: tuple[float, ...] = ()


class Manifest(msgspec.Struct, kw_only=True):
    """``manifest.json``.

    Attributes:
        format: Its layout.
        plan: What was asked for.
        code: What measured.
        machine: As of ``machine.facts`` when the run was begun.
        titles: Of the experiments, by name, in their order.
        sessions: In their order.
        cells: By experiment and key: ``control/system-rmpa_round-1``.
    """

    format: int = FORMAT
    plan: Plan
    code: Code
    machine: dict[str, object]
    titles: dict[str, str] = {}
    sessions: list[Session] = []
    cells: dict[str, CellRecord] = {}
