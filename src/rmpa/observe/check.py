"""The result of a check: one model behind ``rmpa doctor``, ``rmpa why``, the agent's health and ``/diagnostics``."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Self

import msgspec

from rmpa.core import codes

if TYPE_CHECKING:
    from collections.abc import Iterable


class CheckLevel(StrEnum):
    """How bad a result is."""

    OK = "ok"
    # It works, or may work: the first thing to check when something fails.
    WARN = "warn"
    # Something cannot work like this. ERROR on ``/diagnostics``.
    FAIL = "fail"
    # It could not be checked.
    SKIPPED = "skipped"
    # The agent that knows the answer did not reply; the walk along a path goes on.
    UNKNOWN = "unknown"
    # It existed before, and is gone (REP 107).
    STALE = "stale"


OK, WARN, FAIL = CheckLevel.OK, CheckLevel.WARN, CheckLevel.FAIL
SKIPPED, UNKNOWN, STALE = CheckLevel.SKIPPED, CheckLevel.UNKNOWN, CheckLevel.STALE


class Check(msgspec.Struct, frozen=True, omit_defaults=True):
    """One result of one check.

    It crosses the mesh as a stage of ``rmpa why``, where ``level`` is called ``verdict``.

    Attributes:
        name: What was looked at: ``multicast``, ``clock``, a stage of a topic's path, a component of
            ``/diagnostics``.
        level: How bad it is.
        text: What was seen, ready to read.
        remedy: What to do, where something is to be done.
        where: Which of several: an interface, a variable, a peer; empty where there is one only.
        evidence: Figures by their name, as ``/diagnostics`` shows them; units stand in the names.
        code: What is wrong, by ``core.codes``: that of the name where none is given; empty where nothing is wrong.
    """

    name: str
    level: CheckLevel = msgspec.field(name="verdict")
    text: str
    remedy: str = ""
    where: str = ""
    evidence: dict[str, str] = {}
    code: str = ""

    def __post_init__(self) -> None:
        """Take the code from the name."""
        if not self.code and self.level in (WARN, FAIL) and (code := codes.CHECKS.get(self.name)):
            msgspec.structs.force_setattr(self, "code", code)

    @property
    def line(self) -> str:
        """The text with its code."""
        return f"{self.text} [{self.code}]" if self.code else self.text

    @classmethod
    def from_message(cls, name: str, level: CheckLevel, message: str, remedy: str = "", where: str = "") -> Self:
        """Split a message as ``message`` joins it: text after the first "; " replaces the given remedy."""
        text, _, own = message.partition("; ")
        return cls(name, level, text, own or remedy, where)

    @property
    def message(self) -> str:
        """Text and remedy in one line."""
        return f"{self.text}; {self.remedy}" if self.remedy else self.text


def exit_code(checks: Iterable[Check]) -> int:
    """The exit code of a command: 1 if something fails, else 0; warnings do not count."""
    return int(any(check.level is FAIL for check in checks))
