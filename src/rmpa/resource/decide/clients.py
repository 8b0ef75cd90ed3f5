"""The clients of a resource: their last messages, refusals and presence.

``resource.declare.requirements`` merges the requirements themselves. This module keeps for each client: the mark on
its request, by which the client recognises the answer; the stamp of its request, which identifies a latched message
that arrives again; the reason of a refusal; and how long the client has been absent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from rmpa.resource import limits
from rmpa.resource.decide.saved_state import SavedRequirement
from rmpa.resource.declare.requirement_text import parse_requirement

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from rmpa.resource.declare.attributes import Attribute
    from rmpa.resource.declare.requirements import Requirement

_ABSENT: Final = 2
"""Number of consecutive checks without a connection after which a client is gone. One check is not enough: after a
short interruption of its link, the connections of a proxy are made again."""


@dataclass(slots=True)
class _Client:
    """A client that has sent a message.

    Args:
        mark: The mark of its last message.
        stamp: The stamp of its last message, or empty.
        values: The last valid requirement, as texts by attribute; ``None``: there was none.
        refusal: Why its last message was refused; empty: it was accepted.
        absent: Number of consecutive checks without a connection.
        grace: For a client restored after a restart: how long it may stay unconnected, in monotonic seconds.
    """

    mark: str = ""
    stamp: str = ""
    values: tuple[tuple[str, str], ...] | None = None
    refusal: str = ""
    absent: int = 0
    grace: float = -math.inf


class Clients:
    """All clients of one resource.

    Args:
        resource: Name of the resource, for errors.
        attributes: The attributes that clients may request, by name.
    """

    def __init__(self, resource: str, attributes: Mapping[str, Attribute]) -> None:
        self._resource = resource
        self._attributes = attributes
        self._known: dict[str, _Client] = {}
        self.expiries: dict[tuple[str, str], float] = {}
        """Expiry in monotonic seconds, by client and stamp: a latched request that arrives again keeps its expiry."""

    def received(self, name: str, mark: str, stamp: str) -> None:
        """Record that a client has sent a message; called before ``read``, which uses the stamp.

        Args:
            name: Name of the client's node.
            mark: The mark on the message; it is cut to a maximum length, because each response repeats it.
            stamp: The message's stamp as ``seconds.nanoseconds``, or empty.
        """
        client = self._client(name)
        client.mark, client.stamp = mark[: limits.REQUIREMENT_TEXT_MAX], stamp
        client.grace = -math.inf

    def read(self, name: str, values: Sequence[tuple[str, str]], now: float) -> Requirement | None:
        """Read a client's requirement from the values of its message.

        Args:
            name: Name of the client's node.
            values: Attributes with the texts of the requests.
            now: Monotonic seconds.

        Returns:
            The requirement; ``None`` for a latched request that arrives again after it has expired.

        Raises:
            ConfigError: The request is invalid.
        """
        requirement = parse_requirement(name, list(values), self._attributes, self._resource, now)
        client = self._client(name)
        if requirement.expires is not None and client.stamp:
            due = self.expiries.setdefault((name, client.stamp), requirement.expires)
            while len(self.expiries) > limits.RESOURCE_STAMPS_MAX:
                del self.expiries[next(iter(self.expiries))]
            if due <= now:
                return None
            requirement = replace(requirement, expires=due)
        client.refusal, client.values = "", tuple(values)
        return requirement

    def refuse(self, name: str, why: str) -> None:
        """Record why a client's last message was refused."""
        self._client(name).refusal = why

    def refusal(self, name: str) -> str:
        """Why a client's last message was refused; empty: it was accepted."""
        client = self._known.get(name)
        return client.refusal if client is not None else ""

    def mark(self, name: str) -> str:
        """The mark of a client's last message, which the response repeats; empty: there is none."""
        client = self._known.get(name)
        return client.mark if client is not None else ""

    @property
    def refused(self) -> list[str]:
        """The clients whose last message was refused."""
        return [name for name, client in self._known.items() if client.refusal]

    def remove_absent(self, connected: Collection[str], now: float) -> list[str]:
        """Remove clients that have been unconnected for several calls; must be called periodically.

        Args:
            connected: The names of the nodes that are connected.
            now: Monotonic seconds.

        Returns:
            The names of the removed clients.
        """
        removed = []
        for name, client in list(self._known.items()):
            if name in connected:
                client.absent, client.grace = 0, -math.inf
            elif client.grace <= now:
                client.absent += 1
                if client.absent >= _ABSENT:
                    del self._known[name]
                    removed.append(name)
        return removed

    # --- over a restart -----------------------------------------------------------------------------------------

    def save(self, requirements: Mapping[str, Requirement], now: float, now_ns: int) -> list[SavedRequirement]:
        """The requirements of all clients in the form in which they are stored.

        Args:
            requirements: The requirements in force, by client.
            now: Monotonic seconds.
            now_ns: The same moment by the wall clock, Unix nanoseconds.
        """
        found = []
        for name, requirement in requirements.items():
            client = self._known.get(name)
            if client is None or client.values is None:
                continue
            expires = None
            if requirement.expires is not None:
                expires = now_ns + round((requirement.expires - now) * 1e9)
            found.append(
                SavedRequirement(
                    client=name, values=client.values, mark=client.mark, stamp=client.stamp, expires_ns=expires
                )
            )
        return found

    def restore(self, saved: Iterable[SavedRequirement], now: float, now_ns: int) -> list[Requirement]:
        """Return the stored requirements that have not expired, and keep their clients for a grace period."""
        found = []
        for one in saved:
            requirement = one.requirement(self._attributes, self._resource, now, now_ns)
            if requirement is None:
                continue
            found.append(requirement)
            grace = now + limits.RESOURCE_CLIENT_GRACE
            self._known[one.client] = _Client(one.mark, one.stamp, one.values, grace=grace)
            if one.stamp and requirement.expires is not None:
                self.expiries[one.client, one.stamp] = requirement.expires
        return found

    def _client(self, name: str) -> _Client:
        return self._known.setdefault(name, _Client())
