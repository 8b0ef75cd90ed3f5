"""A client as the hub knows it, and the key of what it has asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.web.hub.requests import Answer
    from rmpa.web.hub.rights import Rights

Key: TypeAlias = "tuple[int, int]"
"""The number of a client and one of its handles: unique in the hub."""
OWN_CLIENT: Final = 0
"""The number of the hub itself, and of what it keeps for all clients; clients count from 1."""
Receive: TypeAlias = "Callable[[Answer], None]"


@dataclass(slots=True, eq=False)
class HubClient:
    """One client.

    Args:
        number: Never used again.
        name: For logs and lists.
        rights: What it may do.
        receive: Takes answers; it must not raise.
    """

    number: int
    name: str
    rights: Rights
    receive: Receive
    subscriptions: dict[int, str] = field(default_factory=dict)
    """The topics by handle."""
    publishers: dict[int, str] = field(default_factory=dict)
    """The published topics by handle."""
    services: dict[int, str] = field(default_factory=dict)
    """The served services by handle."""
