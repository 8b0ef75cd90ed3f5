"""ROS 2's graph, and the QoS of its endpoints."""

from __future__ import annotations

import importlib
import json
import os
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

# Seconds between two looks at the endpoints of every topic, whatever is told.
_WHOLE_PERIOD = 5.0
# Seconds between two looks at names where no change is told, and between two looks at the least.
_POLL_PERIOD = 0.25
_LEAST_PERIOD = 0.05
# The names of the node of an endpoint that has none, or of which it is not known yet (rmw_dds_common).
_NAMELESS = ("_NODE_NAME_UNKNOWN_", "_CREATED_BY_BARE_DDS_APP_")
# Seconds within which that is known: twice the period at which DDS repeats what was lost.
_NAMING_PERIOD = 6.0
# Hexadecimal digits of a GID that the participant of DDS has.
_PARTICIPANT = 24
_INFINITE = 2**63 - 1
# What a QoS is made of, beside its depth, by the names of the gateway: the enumerations and times of rclpy.
_POLICIES = {
    "reliability": "ReliabilityPolicy",
    "durability": "DurabilityPolicy",
    "history": "HistoryPolicy",
    "liveliness": "LivelinessPolicy",
}
_TIMES = {"deadline": "deadline", "lifespan": "lifespan", "lease": "liveliness_lease_duration"}


class Watcher:
    """Looks at what ROS 2 has, when something has changed, or again and again where nothing tells of that."""

    def __init__(self, node: Any, say: Callable[..., None]) -> None:
        self._node = node
        self._say = say
        self._names: Any = None
        self._known: dict[str, dict[str, Any]] = {}
        self._nodes: Any = None
        # When an endpoint without a node was seen first, by GID.
        self._nameless: dict[str, float] = {}
        self._looked = self._whole = self._earliest = 0.0

    def due(self, *, told: bool, changed: bool) -> float:
        """When to look next, by the steady clock; ``told``: a change is told, and one was."""
        period = _WHOLE_PERIOD if told else _POLL_PERIOD
        return self._earliest if changed else self._looked + period

    def look(self, now: float, *, changed: bool) -> bool:
        """Tell the gateway what has changed; return whether to look again soon."""
        node = self._node
        nodes = sorted(set(node.get_node_names_and_namespaces()))
        topics = sorted(name for name, _ in node.get_topic_names_and_types())
        names = nodes, topics, sorted(name for name, _ in node.get_service_names_and_types())
        self._looked, again = now, False
        if changed or names != self._names or now >= self._whole + _WHOLE_PERIOD:
            self._names, self._whole = names, now
            again = self._compare(nodes, topics)
        # Looking takes a tenth of the time at the most.
        self._earliest = now + max(_LEAST_PERIOD, 10 * (time.monotonic() - now))
        return again

    def _compare(self, nodes: list[tuple[str, str]], topics: list[str]) -> bool:
        found = {row["gid"]: row for name in topics for row in self._endpoints(name)}
        again = found.pop("", None) is not None
        shown = []
        for base, namespace in nodes:
            try:
                services = self._node.get_service_names_and_types_by_node(base, namespace)
            except Exception:  # the node has just gone
                continue
            owner = namespace.rstrip("/") + "/" + base
            shown.append(owner)
            for name, types in services:
                for kind_of in types:
                    key = "%s %s %s" % (owner, name, kind_of)
                    found[key] = _told(key, "SS", owner, name, kind_of, _service_hash(kind_of), {})
        added = [each for key, each in found.items() if key not in self._known]
        removed = [key for key in self._known if key not in found]
        if not again:
            self._nameless.clear()
        self._known = found
        if added or removed or shown != self._nodes:
            self._nodes = shown
            self._say("G", 0, nodes=shown, added=added, removed=removed)
        return again

    def _endpoints(self, name: str) -> Iterator[dict[str, Any]]:
        """Those of a topic; one without a GID stands for those of which the node is not known yet."""
        for kind, infos in (
            ("MP", self._node.get_publishers_info_by_topic(name)),
            ("MS", self._node.get_subscriptions_info_by_topic(name)),
        ):
            for info in infos:
                gid = bytes(info.endpoint_gid).hex()
                if gid in self._known:
                    yield self._known[gid]
                    continue
                owner = info.node_namespace.rstrip("/") + "/" + info.node_name
                if info.node_name.startswith(_NAMELESS):
                    # Programs of plain DDS have no node; what names that of others may be late by seconds.
                    if time.monotonic() < self._nameless.setdefault(gid, time.monotonic()) + _NAMING_PERIOD:
                        yield {"gid": ""}
                        continue
                    owner = "/dds_" + gid[_PARTICIPANT - 8 : _PARTICIPANT]
                type_hash = str(getattr(info, "topic_type_hash", "") or "")
                yield _told(gid, kind, owner, name, info.topic_type, type_hash, _told_qos(info.qos_profile))


def _told(gid: str, kind: str, node: str, name: str, kind_of: str, type_hash: str, qos: Any) -> dict[str, Any]:
    return {"gid": gid, "kind": kind, "node": node, "name": name, "type": kind_of, "hash": type_hash, "qos": qos}


def _told_qos(profile: Any) -> dict[str, int]:
    """A QoS for the gateway: the numbers of rmw/types.h, times in nanoseconds."""
    told = {name: int(getattr(profile, name)) for name in _POLICIES}
    if profile.depth:
        told["depth"] = profile.depth
    for name, field in _TIMES.items():
        value = getattr(profile, field).nanoseconds
        if 0 < value < _INFINITE:
            told[name] = value
    return told


_HASHES: dict[str, str] = {}


def _service_hash(name: str) -> str:
    """The hash of a service type, from the description that its package has installed; empty: there is none."""
    if name not in _HASHES:
        _HASHES[name] = ""
        package, kind, base = name.split("/")
        file_name = (base.rpartition("_")[0] if kind == "action" else base) + ".json"
        try:
            folder = os.path.dirname(importlib.import_module(package).__file__ or "")
            while not os.path.isdir(os.path.join(folder, "share", package)):
                if folder == os.path.dirname(folder):
                    return ""
                folder = os.path.dirname(folder)
            with open(os.path.join(folder, "share", package, kind, file_name)) as file:
                for each in json.load(file)["type_hashes"]:
                    if each["type_name"] == name:
                        _HASHES[name] = each["hash_string"]
        except (ImportError, OSError, ValueError, KeyError):  # before Iron, or a package that is not installed here
            pass
    return _HASHES[name]


def read_qos(given: dict[str, int]) -> Any:
    """The QoS as the gateway writes it: what differs from rmw's defaults, in the form of ``_told_qos``."""
    from rclpy import qos
    from rclpy.duration import Duration

    fields: dict[str, Any] = {"depth": given.get("depth", 10)}
    fields.update((name, getattr(qos, kind)(given[name])) for name, kind in _POLICIES.items() if name in given)
    fields.update((field, Duration(nanoseconds=given[name])) for name, field in _TIMES.items() if name in given)
    return qos.QoSProfile(**fields)
