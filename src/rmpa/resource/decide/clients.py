"""Who asks something of a resource, in which words, and who of them is gone.

What is asked together is ``resource.declare.requirements``'; here is what belongs to each client: the mark on its
request, by
which it knows the answer; its stamp, so that the same message, latched, is the same request when it comes again; why
its last one cannot be; and how long it may be away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from rmpa.resource import limits
from rmpa.resource.decide.saved_state import SavedRequirement
from rmpa.resource.declare.requirement_text import parse_requirement

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from rmpa.resource.declare.attributes import Attribute
    from rmpa.resource.declare.requirements import Requirement

_ABSENT: int = 2
"""Looks in a row: a proxy's subscribers connect anew when its link was gone for a moment."""


@dataclass(slots=True)
class _Client:
    """One that has said something.

    Args:
        mark: On its last message.
        stamp: Of its last message, or empty.
        values: What it asks, in its own words; ``None``: nothing that could be.
        refusal: Why what it said last cannot be, or empty.
        absent: Looks in a row at which it was not there.
        grace: It asked before a restart: until when it may come back, monotonic seconds.
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
        resource: Its name, for errors.
        attributes: What can be asked for, by name.
    """

    def __init__(self, resource: str, attributes: Mapping[str, Attribute]) -> None:
        self._resource = resource
        self._attributes = attributes
        self._known: dict[str, _Client] = {}
        self.expiries: dict[tuple[str, str], float] = {}
        """By client and stamp: when a request expires, so that the same message, latched, does not begin anew."""

    def speaks(self, name: str, mark: str, stamp: str) -> None:
        """A message of a client has come.

        Args:
            name: Its node.
            mark: On the message; what is too long is cut, for it goes to everybody, again and again.
            stamp: The message's, ``seconds.nanoseconds``; or empty.
        """
        client = self._client(name)
        client.mark, client.stamp = mark[: limits.REQUIREMENT_TEXT_MAX], stamp
        client.grace = -math.inf

    def read(self, name: str, values: Sequence[tuple[str, str]], now: float) -> Requirement | None:
        """What a client asks for, in place of what it asked before; without bounds: nothing any more.

        Args:
            name: Its node.
            values: Attribute and text, as it said it.
            now: Monotonic seconds.

        Returns:
            ``None`` if it is a latched message that comes again, behind its time.

        Raises:
            ConfigError: It cannot be; what it asked before stays.
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
        """What a client said cannot be."""
        self._client(name).refusal = why

    def refusal(self, name: str) -> str:
        """Why what a client said last cannot be, or empty."""
        client = self._known.get(name)
        return client.refusal if client is not None else ""

    def mark(self, name: str) -> str:
        """The one on a client's last message; it comes back on the answer."""
        client = self._known.get(name)
        return client.mark if client is not None else ""

    @property
    def refused(self) -> list[str]:
        """Those whose last message cannot be."""
        return [name for name, client in self._known.items() if client.refusal]

    def gone(self, here: Collection[str], now: float) -> list[str]:
        """Forget those that are not here: killed, unplugged, or simply over; to be called again and again.

        Args:
            here: Those that are connected.
            now: Monotonic seconds.

        Returns:
            Those that are forgotten.
        """
        found = []
        for name, client in list(self._known.items()):
            if name in here:
                client.absent, client.grace = 0, -math.inf
            elif client.grace <= now:
                client.absent += 1
                if client.absent >= _ABSENT:
                    del self._known[name]
                    found.append(name)
        return found

    # --- over a restart -----------------------------------------------------------------------------------------

    def asked(self, requirements: Mapping[str, Requirement], now: float, now_ns: int) -> list[SavedRequirement]:
        """What each client asks, in its own words.

        Args:
            requirements: In force, by client.
            now: Monotonic seconds.
            now_ns: The same by the wall clock.
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

    def recall(self, before: Iterable[SavedRequirement], now: float, now_ns: int) -> list[Requirement]:
        """Take up what was asked before a restart; who does not come back within the grace is forgotten."""
        found = []
        for asked in before:
            requirement = asked.requirement(self._attributes, self._resource, now, now_ns)
            if requirement is None:
                continue
            found.append(requirement)
            grace = now + limits.RESOURCE_CLIENT_GRACE
            self._known[asked.client] = _Client(asked.mark, asked.stamp, asked.values, grace=grace)
            if asked.stamp and requirement.expires is not None:
                self.expiries[asked.client, asked.stamp] = requirement.expires
        return found

    def _client(self, name: str) -> _Client:
        return self._known.setdefault(name, _Client())
