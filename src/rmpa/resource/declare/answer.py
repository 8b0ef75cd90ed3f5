"""What a resource tells one client."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.ros.types.diagnostic_array import DiagnosticLevel


@dataclass(frozen=True, slots=True)
class RequirementAnswer:
    """What a resource tells one client.

    Args:
        level: OK; WARN: something falls short; ERROR: no profile can serve, or the request cannot be.
        message: In a few words.
        values: By attribute: what was wanted, and what is given.
    """

    level: DiagnosticLevel
    message: str
    values: Mapping[str, str]
