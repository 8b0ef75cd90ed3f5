"""A resource's answer to the requirement of one client."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.ros.types.definitions import DiagnosticLevel


@dataclass(frozen=True, slots=True)
class RequirementAnswer:
    """How a resource serves one client.

    Args:
        level: OK; WARN: a quality falls short, or no profile runs yet; ERROR: no profile meets the requirements, or
            the request is invalid.
        message: A short explanation for people.
        values: By attribute a text with the requested and the measured quality.
    """

    level: DiagnosticLevel
    message: str
    values: Mapping[str, str]
