"""What clients observe of a resource's quality, and what the resource itself lacks: both are judged once a window.

A resource measures what it sends. What arrives in another module may be less, and only the client there sees it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.core.errors import ConfigError
from rmpa.resource import limits
from rmpa.resource.declare.attributes import Direction
from rmpa.resource.declare.requirements import find_attribute
from rmpa.resource.declare.units import quantity

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.resource.declare.attributes import Attribute, Value
    from rmpa.resource.declare.requirements import Requirement

MISSING_WINDOWS: Final = 2
"""Windows running in which something is missing before it is said: at the start it takes a while to connect."""
_WORSE: Final = {Direction.MAX: -1, Direction.MIN: 1}


class ObservedQualities:
    """What each client said last.

    Args:
        attributes: The resource's.
        resource: Its name, for errors.
        patience: Seconds for which that counts.
    """

    def __init__(self, attributes: Mapping[str, Attribute], resource: str, patience: float) -> None:
        self._attributes = attributes
        self._resource = resource
        self._patience = patience
        self._seen: dict[str, tuple[float, dict[str, Value]]] = {}

    def told(self, client: str, values: Iterable[tuple[str, str]], now: float) -> None:
        """A client says what it observes, in place of what it said before.

        Raises:
            ConfigError: There is no such attribute, or that is no value of it; nothing of it counts then.
        """
        found: dict[str, Value] = {}
        for number, (name, text) in enumerate(values):
            where = f"observation of {name}"
            if number >= limits.REQUIREMENT_BOUNDS_MAX:
                raise ConfigError(where, f"more than {limits.REQUIREMENT_BOUNDS_MAX} attributes")
            attribute = find_attribute(self._attributes, name, self._resource)
            value = text if attribute.of_words else quantity(text, attribute.unit, where)
            found[name] = attribute.check(value, where)
        self._seen[client] = (now, found)

    def given(self, client: str, name: str) -> Value | None:
        """What this client said of an attribute, if anything."""
        _, found = self._seen.get(client, (0.0, {}))
        return found.get(name)

    def judge(self, measured: dict[str, Value], requirements: Mapping[str, Requirement], now: float) -> None:
        """Let the worst count: of what was measured here, and of what those observe who ask for something.

        Args:
            measured: Changed in place.
            requirements: By client.
            now: Monotonic seconds.
        """
        for client in [client for client, (at, _) in self._seen.items() if now - at > self._patience]:
            del self._seen[client]
        for client, (_, found) in self._seen.items():
            for name, value in found.items() if client in requirements else ():
                attribute, known = self._attributes[name], measured.get(name)
                worse = _WORSE.get(attribute.direction)
                if known is None or worse is None or worse * (attribute.place(value) - attribute.place(known)) > 0:
                    measured[name] = value

    def clear(self) -> None:
        """Another profile runs: what was observed was of the one before."""
        self._seen.clear()


class MissingInputs:
    """What a resource needs and does not have."""

    def __init__(self) -> None:
        self._windows: dict[str, int] = {}

    def look(self, missing: Iterable[str]) -> list[tuple[str, bool]]:
        """Return what has gone (true) and what is back (false), to be said; called once a window."""
        texts = set(missing)
        back = [text for text in self._windows if text not in texts]
        news = [(text, False) for text in back if self._windows.pop(text) >= MISSING_WINDOWS]
        for text in sorted(texts):
            self._windows[text] = self._windows.get(text, 0) + 1
            if self._windows[text] == MISSING_WINDOWS:
                news.append((text, True))
        return news
