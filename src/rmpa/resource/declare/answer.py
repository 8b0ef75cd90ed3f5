"""A resource's answer to the requirement of one client."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.ros.types.diagnostic_array import DiagnosticLevel


@dataclass(frozen=True, slots=True)
class RequirementAnswer:
    """How a resource serves one client.

    Args:
        level: OK; WARN: a quality falls short; ERROR: no profile can serve, or the request is invalid.
        message: A short explanation.
        values: By attribute: the quality that was requested, and the one that is offered.
    """

    level: DiagnosticLevel
    message: str
    values: Mapping[str, str]
