"""Quality as clients observe it, and inputs that are missing; both are judged once a window.

A resource measures the messages that it sends. Fewer may arrive in another module, which only the client there sees.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.core.errors import ConfigError
from rmpa.resource import limits
from rmpa.resource.declare.attributes import Direction
from rmpa.resource.declare.requirements import find_attribute

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

    from rmpa.resource.declare.attributes import Attribute, Value

MISSING_WINDOWS: Final = 2
"""Consecutive windows in which something is missing before it is reported: connecting takes a while at the start."""
_WORSE: Final = {Direction.MAX: -1, Direction.MIN: 1}


class ObservedQualities:
    """The last report of each client.

    Args:
        attributes: The resource's, by name.
        resource: Its name, for errors.
        lifespan: Seconds for which a report counts.
    """

    def __init__(self, attributes: Mapping[str, Attribute], resource: str, lifespan: float) -> None:
        self._attributes = attributes
        self._resource = resource
        self._lifespan = lifespan
        self._reports: dict[str, tuple[float, dict[str, Value]]] = {}

    def report(self, client: str, values: Iterable[tuple[str, str]], now: float) -> None:
        """Take a client's report, in place of its previous one.

        Raises:
            ConfigError: An unknown attribute or an invalid value; the whole report is dropped then.
        """
        found: dict[str, Value] = {}
        for number, (name, text) in enumerate(values):
            where = f"observation of {name}"
            if number >= limits.REQUIREMENT_BOUNDS_MAX:
                raise ConfigError(where, f"more than {limits.REQUIREMENT_BOUNDS_MAX} attributes")
            found[name] = find_attribute(self._attributes, name, self._resource).parse(text, where)
        self._reports[client] = (now, found)

    def observed(self, client: str, name: str) -> Value | None:
        """The value of an attribute in a client's report, if any."""
        _, found = self._reports.get(client, (0.0, {}))
        return found.get(name)

    def worst(self, measured: Mapping[str, Value], clients: Collection[str], now: float) -> dict[str, Value]:
        """The worse of the measured values and the reported ones.

        Args:
            measured: By attribute.
            clients: Those that have a requirement; reports of others do not count.
            now: Monotonic seconds.
        """
        self._reports = {client: r for client, r in self._reports.items() if now - r[0] <= self._lifespan}
        worst = dict(measured)
        for client, (_, found) in self._reports.items():
            for name, value in found.items() if client in clients else ():
                attribute, known = self._attributes[name], worst.get(name)
                sign = _WORSE.get(attribute.direction)
                if (
                    known is None
                    or sign is None
                    or sign * (attribute.position(value) - attribute.position(known)) > 0
                ):
                    worst[name] = value
        return worst

    def clear(self) -> None:
        """Drop all reports: they are about the previous profile."""
        self._reports.clear()


class MissingInputs:
    """Tracks what a resource needs and lacks."""

    def __init__(self) -> None:
        self._windows: dict[str, int] = {}

    def update(self, missing: Iterable[str]) -> list[tuple[str, bool]]:
        """Take what is missing in this window.

        Returns:
            The changes to report: each text with true (missing) or false (back).
        """
        texts = set(missing)
        back = [text for text in self._windows if text not in texts]
        changes = [(text, False) for text in back if self._windows.pop(text) >= MISSING_WINDOWS]
        for text in sorted(texts):
            self._windows[text] = self._windows.get(text, 0) + 1
            if self._windows[text] == MISSING_WINDOWS:
                changes.append((text, True))
        return changes
