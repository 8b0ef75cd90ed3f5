"""What the monitor knows of a Smart Resource, from the topics that it publishes about itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from rmpa.web.monitor.patch import without_nulls

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.web.monitor.patch import Tree
    from rmpa.web.monitor.steady import Steady


class ResourceFacts(msgspec.Struct, kw_only=True, frozen=True):
    """One resource; the fields are those of ``rmpa resource info --json``.

    Attributes:
        name: Its name in its own graph: ``/base``.
        peer: Its module; ``None`` for this one.
        state: The state of its life cycle; empty while it does not answer.
        profile: The System Profile that runs; empty for none.
        context: Its context; empty for none.
        health: The first status of ``quality``: ``level``, ``message`` and ``values`` by attribute, with units.
        parameters: Values by name.
        clients: The statuses of ``responses``: what each client asks and is told.
        descriptor: What it declares (``resource.run.descriptor``), as JSON values.
        decision: The last decision, as ``rmpa profile explain --json`` gives it.
        contexts: As ``rmpa context list --json`` gives them.
    """

    name: str
    peer: str | None = None
    state: str = ""
    profile: str = ""
    context: str = ""
    health: dict[str, Any] | None = None  # the edge: JSON of a peer's topic, shown as it is
    parameters: dict[str, Any] = {}
    clients: tuple[dict[str, Any], ...] = ()
    descriptor: dict[str, Any] = {}
    decision: dict[str, Any] = {}
    contexts: tuple[dict[str, Any], ...] = ()

    @property
    def key(self) -> str:
        """``module:/name``; of this module ``/name``."""
        return f"{self.peer}:{self.name}" if self.peer else self.name

    @property
    def level(self) -> str:
        """``OK``, ``WARN``, ``ERROR`` or ``STALE``; empty while it sent no quality."""
        return str((self.health or {}).get("level", ""))

    def topics(self, direction: str) -> set[str]:
        """Global names of its ``inputs`` or ``outputs``."""
        declared = self.descriptor.get(direction, ())
        return {str(each.get("topic", "")) for each in declared if isinstance(each, dict)}

    def quality(self, attribute: str) -> float | None:
        """The number of a measured attribute, without its unit."""
        text = str(((self.health or {}).get("values") or {}).get(attribute, ""))
        try:
            return float(text.partition(" ")[0])
        except ValueError:
            return None


def resource_entry(facts: ResourceFacts, own: str, *, lost: bool = False) -> Tree:
    """What the state says of a resource; ``resource_detail`` has the rest.

    Args:
        facts: The resource.
        own: This module's name.
        lost: Whether nothing comes of its module any more: what it said last is no news then.
    """
    descriptor = facts.descriptor
    health = facts.health or {}
    profiles = descriptor.get("profiles", ())
    entry = {
        "name": facts.name,
        "module": facts.peer or own,
        "role": descriptor.get("role"),
        "physical": descriptor.get("physical"),
        "description": descriptor.get("description"),
        "state": "not known" if lost else facts.state,
        "profile": facts.profile,
        "profiles": [str(each.get("name", "")) for each in profiles if isinstance(each, dict)],
        "context": facts.context,
        "level": "STALE" if lost else facts.level,
        "message": f"nothing comes from {facts.peer}" if lost else health.get("message", ""),
        "clients": len(facts.clients),
    }
    made = without_nulls(entry)
    return made if isinstance(made, dict) else {}


def resource_detail(facts: ResourceFacts, own: str) -> Tree:
    """All of a resource, for its page."""
    made = without_nulls(msgspec.to_builtins(facts))
    return (made if isinstance(made, dict) else {}) | {"module": facts.peer or own}


def resource_flows(facts: Iterable[ResourceFacts], own: str, steady: Steady) -> dict[str, Tree]:
    """Flows between modules, by what resources declare and measure: ``from>to`` with rate and topics.

    The agent sees the messages of its own links alone. What flows between two other modules is known from the
    descriptors: an input of a resource of one that is an output of a resource of the other. The rate is measured by
    the resource that has the input.
    """
    known = list(facts)
    producers = [(one.peer or own, topic) for one in known for topic in sorted(one.topics("outputs"))]
    found: dict[str, Tree] = {}
    for consumer in known:
        here = consumer.peer or own
        wanted = consumer.topics("inputs")
        for module, topic in producers:
            if module == here or topic not in wanted or own in (module, here):
                continue
            short = topic.rpartition("/")[2]
            key = f"{module}>{here}"
            rate = steady.figure(f"declared {key} {topic}", consumer.quality(f"{short}.rate"))
            flow = found.setdefault(key, {"by": "resource", "topics": []})
            topics, sum_ = flow["topics"], flow.get("rate")
            if isinstance(topics, list):
                topics.append(topic)
            if rate is not None:
                flow["rate"] = rate + (sum_ if isinstance(sum_, float) else 0.0)
    return found
