"""Smart Resources: nodes that offer a service with a quality, and adapt (paper, section 3).

This package is the public interface; the modules below it may be moved::

    from rmpa.resource import Resource, at_least

``docs/guides/smart-resources.md`` shows how to write a resource, and lists what it offers to others.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Final

from rmpa.resource.declare import DeclaredAttribute, Demand, Input, Output, Parameter, Role
from rmpa.resource.quality import QoSRequest, RequirementAnswer, at_least, at_most, between, exactly
from rmpa.resource.resource import Resource

if TYPE_CHECKING:
    from rmpa.resource.client import ResourceClient
    from rmpa.ros.node.node import Node

__all__ = [
    "DeclaredAttribute",
    "Demand",
    "Input",
    "Node",
    "Output",
    "Parameter",
    "QoSRequest",
    "RequirementAnswer",
    "Resource",
    "ResourceClient",
    "Role",
    "at_least",
    "at_most",
    "between",
    "exactly",
]
# Names that are imported at their first use, because their modules import asyncio and sockets.
_LAZY: Final = {"ResourceClient": "rmpa.resource.client", "Node": "rmpa.ros.node.node"}


def __getattr__(name: str) -> object:
    """Find names that are imported at their first use.

    Raises:
        AttributeError: The package has no such name.
    """
    if (module := _LAZY.get(name)) is not None:
        return getattr(importlib.import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
