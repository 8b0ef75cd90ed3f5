"""Smart Resources: modules that offer services with a quality, and adapt (paper, section 3).

::

    from rmpa.resource import Resource, at_least

``docs/tutorials/resources.md`` shows how to write one, ``docs/smart-resources.md`` what it offers to others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.resource.declare.answer import RequirementAnswer
from rmpa.resource.declare.resource import QoSRequest, Resource, at_least, at_most, between, exactly

if TYPE_CHECKING:
    from rmpa.resource.run.client import ResourceClient

__all__ = [
    "QoSRequest",
    "RequirementAnswer",
    "Resource",
    "ResourceClient",
    "at_least",
    "at_most",
    "between",
    "exactly",
]


def __getattr__(name: str) -> object:
    """Load the client only where it is used: it brings asyncio and sockets."""
    if name == "ResourceClient":
        from rmpa.resource.run.client import ResourceClient  # noqa: PLC0415 - as said

        return ResourceClient
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
