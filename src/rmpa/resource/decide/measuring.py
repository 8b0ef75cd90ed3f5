"""Measures all qualities of one resource: of its outputs, its inputs, and those of the user's own."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.resource.decide.quality import ObservedQuality, TopicQuality

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.resource import Input, Output, Resource


class QualityMeasurement:
    """Takes what leaves and what comes; each window tells what it was.

    Args:
        resource: Declared completely.
        now: Monotonic seconds, here and everywhere below.
    """

    def __init__(self, resource: Resource, now: float) -> None:
        self._attributes = resource.attributes
        self._labels = resource.labels
        self._topics: dict[str, TopicQuality] = {}
        for name, output in resource.outputs.items():
            self._topics[name] = TopicQuality(now, stamped=_stamped(output), deadline=output.contract.deadline)
        for item in resource.inputs.values():
            self._listen(item, now)
        self._unknown = {name: item for name, item in resource.inputs.items() if item.kind.known is None}
        """Inputs whose type their first publisher tells."""
        self._primary = next(iter(resource.outputs), "")
        """The output whose qualities are also named without it."""
        self._own = {
            name: ObservedQuality(declared.attribute) for name, declared in resource.declared_attributes.items()
        }

    def message(self, topic: str, raw: bytes, now: float, now_ns: int, caller: str = "") -> None:
        """A message has left by an output, or come by an input.

        Args:
            topic: The output's or input's name.
            raw: The message.
            now: The time.
            now_ns: By the wall clock, which stamps are by.
            caller: Who sent it, for inputs.
        """
        if topic in self._unknown and self._unknown[topic].kind.known is not None:
            self._listen(self._unknown.pop(topic), now)
        if (quality := self._topics.get(topic)) is not None:
            quality.message(raw, now, now_ns, caller)

    def _listen(self, item: Input, now: float) -> None:
        self._topics[item.name] = TopicQuality(
            now, stamped=_stamped(item), numbered=True, deadline=item.contract.deadline
        )

    def observed(self, attribute: str, value: Value) -> None:
        """An attribute of the user's own was observed."""
        if (quality := self._own.get(attribute)) is not None:
            quality.observe(value)

    def restart(self, now: float) -> None:
        """Forget the window that has begun: it was under another profile."""
        for topic in self._topics.values():
            topic.restart(now)
        for quality in self._own.values():
            quality.restart()

    def window(self, now: float) -> dict[str, Value]:
        """End a window: what was measured in it, by attribute."""
        measured: dict[str, Value] = {}
        for name, topic in self._topics.items():
            for key, value in topic.window(now).items():
                measured[f"{self._labels[name]}.{key}"] = value
                if name == self._primary:
                    measured[key] = value
        for name, quality in self._own.items():
            if (seen := quality.window()) is not None:
                measured[name] = seen
        return measured

    def shown(self, measured: Mapping[str, Value]) -> dict[str, str]:
        """A window for people, each quality once."""
        twice = f"{self._labels[self._primary]}." if self._primary else None
        return {
            name: self._attributes[name].show(value)
            for name, value in measured.items()
            if name in self._attributes and not (twice and name.startswith(twice))
        }


def _stamped(topic: Output | Input) -> bool:
    fields = topic.kind.known.fields if topic.kind.known is not None else ()
    return bool(fields) and fields[0].name == "header"
