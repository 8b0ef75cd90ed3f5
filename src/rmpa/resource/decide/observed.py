"""Quality as observed by clients, and things that a resource lacks; both are judged once in each window.

A resource measures the messages that it sends. Fewer may arrive in another module, where only the client can measure
the loss.
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
"""Consecutive windows for which something must be missing before it is reported, since connecting takes a while."""
_WORSE: Final = {Direction.MAX: -1, Direction.MIN: 1}


class ObservedQualities:
    """The last report of each client.

    Args:
        attributes: The resource's attributes, by name.
        resource: Name of the resource, for errors.
        lifespan: Seconds for which a report counts.
    """

    def __init__(self, attributes: Mapping[str, Attribute], resource: str, lifespan: float) -> None:
        self._attributes = attributes
        self._resource = resource
        self._lifespan = lifespan
        self._reports: dict[str, tuple[float, dict[str, Value]]] = {}

    def report(self, client: str, values: Iterable[tuple[str, str]], now: float) -> None:
        """Take a client's report of attributes and values as texts, in place of its previous report.

        Raises:
            ConfigError: An attribute is unknown or a value is invalid; the whole report is dropped.
        """
        found: dict[str, Value] = {}
        for number, (name, text) in enumerate(values):
            where = f"observation of {name}"
            if number >= limits.REQUIREMENT_BOUNDS_MAX:
                raise ConfigError(where, f"more than {limits.REQUIREMENT_BOUNDS_MAX} attributes")
            found[name] = find_attribute(self._attributes, name, self._resource).parse(text, where)
        self._reports[client] = (now, found)

    def observed(self, client: str, name: str) -> Value | None:
        """The value of an attribute in a client's last report; ``None``: it has none."""
        _, found = self._reports.get(client, (0.0, {}))
        return found.get(name)

    def worst(self, measured: Mapping[str, Value], clients: Collection[str], now: float) -> dict[str, Value]:
        """For each attribute the worst of the measured and the reported values.

        Args:
            measured: The resource's own measurements, by attribute.
            clients: The clients that have a requirement; reports of others do not count.
            now: Monotonic seconds.

        Returns:
            Values by attribute. Where no direction is better, a reported value replaces the measured one.
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
        """Drop all reports, because they describe the previous profile."""
        self._reports.clear()


class MissingInputs:
    """Tracks what a resource needs and lacks, so that short absences are not reported."""

    def __init__(self) -> None:
        self._windows: dict[str, int] = {}

    def update(self, missing: Iterable[str]) -> list[tuple[str, bool]]:
        """Update with the texts about everything that is missing in this window.

        Returns:
            The changes to report: each text, with true if it is missing now and false if it is back.
        """
        texts = set(missing)
        back = [text for text in self._windows if text not in texts]
        changes = [(text, False) for text in back if self._windows.pop(text) >= MISSING_WINDOWS]
        for text in sorted(texts):
            self._windows[text] = self._windows.get(text, 0) + 1
            if self._windows[text] == MISSING_WINDOWS:
                changes.append((text, True))
        return changes
