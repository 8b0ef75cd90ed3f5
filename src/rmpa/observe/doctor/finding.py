"""What a check found, and what that means for the exit code."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    from collections.abc import Iterable


class FindingLevel(StrEnum):
    """How bad it is."""

    OK = "ok"
    WARN = "warn"
    """It works, or may: but this is where to look when something does not."""
    FAIL = "fail"
    """Something cannot work like this."""
    SKIPPED = "skipped"
    """It could not be looked at."""


class Finding(msgspec.Struct, frozen=True, omit_defaults=True):
    """One answer of one check.

    Attributes:
        check: What was looked at: ``multicast``, ``clock`` …
        subject: Which of several: an interface, a variable, a peer; empty where there is one only.
        level: How bad it is.
        text: What was seen, ready to read.
        remedy: What to do, where something is to be done.
    """

    check: str
    subject: str
    level: FindingLevel
    text: str
    remedy: str = ""


def exit_code(findings: Iterable[Finding]) -> int:
    """1 if something fails, else 0: warnings are for people."""
    return int(any(finding.level is FindingLevel.FAIL for finding in findings))
