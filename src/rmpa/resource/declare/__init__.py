"""What a user declares: resources, qualities, requirements, profiles, contexts, parameters.

Programs should import from ``rmpa.resource``. The names that ``rmpa.resource.declare`` had as a single module are
still available here, with a ``DeprecationWarning``.
"""

from __future__ import annotations

import importlib
import warnings
from typing import Final

_PACKAGE: Final = "rmpa.resource.declare"
_MOVED: Final = {
    **dict.fromkeys(("Resource", "Role", "RESERVED", "NOT_ATTRIBUTES"), "resource"),
    **dict.fromkeys(("QoSRequest", "at_least", "at_most", "between", "exactly"), "qos_request"),
    **dict.fromkeys(("DeclaredAttribute", "Demand", "Input", "Output"), "connections"),
    **dict.fromkeys(("Parameter", "ParameterValue", "INT_MIN", "INT_MAX"), "parameters"),
    **dict.fromkeys(("Context", "DeclaredProfile", "Hook", "OnFailure", "Task", "TaskFunction"), "behaviour"),
}


def __getattr__(name: str) -> object:
    """Find a name of the old module.

    Raises:
        AttributeError: The old module had no such name.
    """
    now = "QoSRequest" if name == "Wish" else name
    if now not in _MOVED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    warnings.warn(
        f"rmpa.resource.declare.{name} is deprecated: import {now} from rmpa.resource",
        DeprecationWarning,
        stacklevel=2,
    )
    return getattr(importlib.import_module(f"{_PACKAGE}.{_MOVED[now]}"), now)
