"""Measures all quality attributes of one resource: of outputs, of inputs, and those that the user's code observes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.resource.decide.quality import ObservedQuality, TopicQuality

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.connections import Input, Output
    from rmpa.resource.declare.resource import Resource


class QualityMeasurement:
    """Measures messages and observations; each window yields their quality.

    Args:
        resource: The resource, completely declared.
        now: Beginning of the first window, in monotonic seconds; all times of this class are.
    """

    def __init__(self, resource: Resource, now: float) -> None:
        self._attributes = resource.attributes
        self._labels = resource.labels
        self._topics: dict[str, TopicQuality] = {}
        for name, output in resource.outputs.items():
            self._topics[name] = TopicQuality(now, stamped=_stamped(output), deadline=output.contract.deadline)
        for item in resource.inputs.values():
            self._add_input(item, now)
        self._unknown = {name: item for name, item in resource.inputs.items() if item.kind.known is None}
        """Inputs whose type is not known yet, by name; it is learnt from their first publisher."""
        self._primary = next(iter(resource.outputs), "")
        """The first output; its attributes are also available without the output's label."""
        self._declared = {
            name: ObservedQuality(declared.attribute) for name, declared in resource.declared_attributes.items()
        }

    def message(self, topic: str, raw: bytes, now: float, now_ns: int, caller: str = "") -> None:
        """Measure a message that an output has sent or an input has received.

        Args:
            topic: Declared name of the output or input.
            raw: The serialized message.
            now: When it was sent or received.
            now_ns: The same moment by the wall clock (Unix nanoseconds), to which stamps refer.
            caller: For inputs: name of the publishing node.
        """
        if topic in self._unknown and self._unknown[topic].kind.known is not None:
            self._add_input(self._unknown.pop(topic), now)
        if (quality := self._topics.get(topic)) is not None:
            quality.message(raw, now, now_ns, caller)

    def _add_input(self, item: Input, now: float) -> None:
        self._topics[item.name] = TopicQuality(
            now, stamped=_stamped(item), numbered=True, deadline=item.contract.deadline
        )

    def observe(self, attribute: str, value: Value) -> None:
        """Record a value that the user's code has observed of a declared attribute; others are ignored."""
        if (quality := self._declared.get(attribute)) is not None:
            quality.observe(value)

    def restart(self, now: float) -> None:
        """Discard the measurements so far and begin a new window, because another profile runs."""
        for topic in self._topics.values():
            topic.restart(now)
        for quality in self._declared.values():
            quality.restart()

    def window(self, now: float) -> dict[str, Value]:
        """End the window and return its measured values by attribute."""
        measured: dict[str, Value] = {}
        for name, topic in self._topics.items():
            for key, value in topic.window(now).items():
                measured[f"{self._labels[name]}.{key}"] = value
                if name == self._primary:
                    measured[key] = value
        for name, quality in self._declared.items():
            if (seen := quality.window()) is not None:
                measured[name] = seen
        return measured

    def format(self, measured: Mapping[str, Value]) -> dict[str, str]:
        """The values of a window as texts with units; the first output's attributes only by their short names."""
        twice = f"{self._labels[self._primary]}." if self._primary else None
        return {
            name: self._attributes[name].format(value)
            for name, value in measured.items()
            if name in self._attributes and not (twice and name.startswith(twice))
        }


def _stamped(topic: Output | Input) -> bool:
    fields = topic.kind.known.fields if topic.kind.known is not None else ()
    return bool(fields) and fields[0].name == "header"
