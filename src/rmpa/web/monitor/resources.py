"""The Smart Resources of all modules, from the topics that they publish about themselves."""

from __future__ import annotations

import contextlib
import functools
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.core.errors import RmpaError
from rmpa.core.identity import proxied_peer
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel
from rmpa.ros.types.descriptor import CONFIG_TYPE, LEVEL_FOR, TOPIC, Descriptor
from rmpa.web.monitor import limits
from rmpa.web.monitor.messages import Tree, without_nulls

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.node_link import Follower
    from rmpa.web.hub.topics import ClientSubscription, ReceivedMessage


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
        descriptor: What it declares (``ros.types.descriptor``), as JSON values.
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


def resource_flows(facts: Sequence[ResourceFacts], own: str) -> dict[str, Tree]:
    """Flows between modules, by what resources declare and measure: ``from>to`` with rate and topics.

    The agent sees the messages of its own links alone. What flows between two other modules is known from the
    descriptors: an input of a resource of one that is an output of a resource of the other. The rate is measured by
    the resource that has the input.
    """
    producers = [(one.peer, topic) for one in facts for topic in sorted(one.topics("outputs"))]
    found: dict[str, Any] = {}
    for consumer in facts:
        wanted = consumer.topics("inputs")
        for module, topic in producers:
            if module and consumer.peer and module != consumer.peer and topic in wanted:
                flow = found.setdefault(f"{module}>{consumer.peer}", {"by": "resource", "topics": []})
                flow["topics"].append(topic)
                rate = consumer.quality(f"{topic.rpartition('/')[2]}.rate")
                if rate is not None:
                    flow["rate"] = rate + flow.get("rate", 0.0)
    return {key: flow for key, flow in found.items() if own not in key.split(">")}


_TEXT: Final = "std_msgs/String"
# When a topic of a resource is followed: always, while pages are open, while a page shows the resource.
_ALWAYS, _SHOWN, _LOOKED_AT = range(3)
# The topics below each resource, with their types.
_TOPICS: Final = {
    TOPIC: (_TEXT, _ALWAYS),
    "state": (_TEXT, _SHOWN),
    "profile": (_TEXT, _SHOWN),
    "context": (_TEXT, _SHOWN),
    "quality": (ARRAY_TYPE, _SHOWN),
    "decision": (_TEXT, _LOOKED_AT),
    "responses": (ARRAY_TYPE, _LOOKED_AT),
    "parameter_updates": (CONFIG_TYPE, _LOOKED_AT),
}


@dataclass(slots=True, eq=False)
class _Path:
    """What is followed below one path; several modules may have a resource of that path, by their names."""

    name: str
    # By the last part of the topic's name; ``None``: the rules deny it.
    subscriptions: dict[str, ClientSubscription | None] = field(default_factory=dict)
    # The nodes that publish the descriptor.
    publishers: frozenset[str] = frozenset()
    # Those included whose descriptor has not come yet.
    heard: dict[str | None, ResourceFacts] = field(default_factory=dict)
    # Since when each resource has its level: as it says itself, or else since it was heard with it.
    since: dict[str | None, float] = field(default_factory=dict)
    looked: float = -1e9

    def unsubscribe(self, topics: Iterable[str]) -> None:
        """End some subscriptions."""
        for topic in [*topics]:
            if (subscription := self.subscriptions.pop(topic)) is not None:
                subscription.close()


class ResourceWatch:
    """Follows the resources of the graph.

    Args:
        hub: Subscribes to their topics.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._follower: Follower | None = None
        self._paths: dict[str, _Path] = {}
        self._wanted = False

    @property
    def facts(self) -> dict[str, ResourceFacts]:
        """The resources, by ``ResourceFacts.key``."""
        heard = (facts for path in self._paths.values() for facts in path.heard.values())
        return {facts.key: facts for facts in heard if facts.descriptor}

    def start(self) -> None:
        """Begin to follow the graph."""
        self._follower = self._hub.graph.follow(self._graph_changed)

    def close(self) -> None:
        """End all subscriptions."""
        if self._follower is not None:
            self._follower.close()
        for path in self._paths.values():
            path.unsubscribe(path.subscriptions)
        self._paths.clear()

    def show_all(self, *, wanted: bool) -> None:
        """Whether the state of each resource is shown anywhere."""
        if wanted != self._wanted:
            self._wanted = wanted
            for path in self._paths.values():
                self._follow(path)

    def look(self, key: str) -> None:
        """A page shows this resource: follow all that it says, for ``limits.LOOK_KEPT`` from now on."""
        facts = self.facts.get(key)
        path = self._paths.get(facts.name) if facts is not None else None
        if path is not None and facts is not None:
            path.looked = time.monotonic()
            self._follow(path)

    def alarms(self) -> list[Tree]:
        """The alarms that stand, for the state."""
        return [
            {
                "id": facts.key,
                "module": facts.peer or "",
                "resource": facts.key,
                "level": facts.level,
                "text": str((facts.health or {}).get("message", "")),
                "at": round(path.since[peer], 1),
            }
            for path in self._paths.values()
            for peer, facts in path.heard.items()
            if facts.descriptor and facts.level in ("WARN", "ERROR", "STALE")
        ]

    def _graph_changed(self) -> None:
        ending = f"/{TOPIC}"
        present = {
            name.removesuffix(ending): topic
            for name, topic in self._hub.graph.topics.items()
            if name.endswith(ending) and topic.publishers and _TEXT in topic.types
        }
        for name in self._paths.keys() - present.keys():
            gone = self._paths.pop(name)
            gone.unsubscribe(gone.subscriptions)
        for name, topic in present.items():
            if name in self._paths or len(self._paths) < limits.RESOURCES_MAX:
                path = self._paths.setdefault(name, _Path(name))
                publishers = frozenset(topic.publishers)
                if path.publishers and publishers - path.publishers:
                    # A source that is back sends the same latched messages, which a subscription has had: begin anew.
                    path.unsubscribe(path.subscriptions)
                path.publishers = publishers
                peers = {proxied_peer(node) for node in publishers}
                path.heard = {peer: facts for peer, facts in path.heard.items() if peer in peers}
                self._follow(path)

    def _follow(self, path: _Path) -> None:
        looked = time.monotonic() - path.looked < limits.LOOK_KEPT
        most = (_LOOKED_AT if looked else _SHOWN) if self._wanted else _ALWAYS
        wanted = {topic: type_ for topic, (type_, when) in _TOPICS.items() if when <= most}
        path.unsubscribe(path.subscriptions.keys() - wanted.keys())
        for topic in wanted.keys() - path.subscriptions.keys():
            path.subscriptions[topic] = None
            take = functools.partial(self._take, path, topic)
            with contextlib.suppress(RmpaError):
                path.subscriptions[topic] = self._hub.topics.subscribe(f"{path.name}/{topic}", wanted[topic], take)

    def _take(self, path: _Path, topic: str, message: ReceivedMessage) -> None:
        peer = proxied_peer(message.source)
        before = path.heard.get(peer) or ResourceFacts(name=path.name, peer=peer)
        try:
            values = self._hub.values(message)  # latched ones may come before the descriptor
            said = _described(values["data"]) if topic == TOPIC else _said(before, topic, values)
        except (RmpaError, msgspec.DecodeError, KeyError, TypeError, RecursionError):
            return  # another program's topic of that name
        path.heard[peer] = after = msgspec.structs.replace(before, **said)
        if after.level != before.level:
            path.since[peer] = time.time() - max(0.0, after.quality(LEVEL_FOR) or 0.0)


def _described(text: str) -> dict[str, Any]:
    """What a descriptor says."""
    descriptor = Descriptor.parse(text)
    return {
        "descriptor": msgspec.to_builtins(descriptor),
        "contexts": tuple(map(msgspec.to_builtins, descriptor.contexts)),
    }


def _said(facts: ResourceFacts, topic: str, values: Any) -> dict[str, Any]:
    """What a message says of a resource: members of ``ResourceFacts``."""
    if topic in ("state", "profile", "context"):
        return {topic: str(values["data"])}
    if topic == "decision":
        decision = msgspec.json.decode(values["data"] or "{}")
        is_shown = isinstance(decision, dict) and _depth(decision, 32) <= 32
        return {"decision": decision if is_shown else facts.decision}
    if topic == "responses":
        return {"clients": tuple(map(_status, values["status"]))}
    if topic == "parameter_updates":
        pairs = [pair for kind in ("bools", "ints", "strs", "doubles") for pair in values[kind]]
        return {"parameters": {pair["name"]: pair["value"] for pair in pairs}}
    statuses = [*map(_status, values["status"]), facts.health]
    return {"health": statuses[0]}


def _depth(value: Any, most: int) -> int:
    """How many objects and arrays are within each other, counted up to one more than ``most``."""
    if most < 0 or not isinstance(value, dict | list):
        return 0
    inner = value.values() if isinstance(value, dict) else value
    return 1 + max((_depth(each, most - 1) for each in inner), default=0)


def _status(values: Any) -> dict[str, Any]:
    """A ``diagnostic_msgs/DiagnosticStatus`` as ``rmpa resource info --json`` has it."""
    return {
        "name": values["name"],
        "level": DiagnosticLevel(values["level"] & 3).name,
        "message": values["message"],
        "values": {pair["key"]: pair["value"] for pair in values["values"]},
    }
