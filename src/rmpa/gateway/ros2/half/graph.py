"""ROS 2's graph, looked at again and again, since rclpy tells of no change; and the QoS of its endpoints."""

from __future__ import annotations

import importlib
import json
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

_WHOLE_PERIOD = 5.0
# The namespace of the nodes that gateways show.
_OWN = "/rmpa/"
# The name of a node of which an endpoint was heard before the node (rcl's graph).
_UNKNOWN = "_NODE_NAME_UNKNOWN_"
_INFINITE = 2**63 - 1
_POLICIES = {
    "reliability": {1: "RELIABLE", 2: "BEST_EFFORT"},
    "durability": {1: "TRANSIENT_LOCAL", 2: "VOLATILE"},
    "history": {1: "KEEP_LAST", 2: "KEEP_ALL"},
    "liveliness": {1: "AUTOMATIC", 2: "AUTOMATIC", 3: "MANUAL_BY_TOPIC"},
}


class Watcher:
    """What ROS 2 has, looked at again and again: rclpy tells of no change."""

    def __init__(self, node: Any, say: Callable[..., None]) -> None:
        self._node = node
        self._say = say
        self._names: Any = None
        self._known: dict[str, dict[str, Any]] = {}
        self._nodes: Any = None
        self._whole_at = 0.0

    def look(self, now: float) -> None:
        """Tell the gateway what has changed."""
        node = self._node
        nodes = sorted(set(node.get_node_names_and_namespaces()))
        topics = sorted((name, tuple(types)) for name, types in node.get_topic_names_and_types())
        by_node = []
        for base, namespace in nodes:
            try:
                by_node.append(
                    (
                        namespace.rstrip("/") + "/" + base,
                        tuple(map(_row, node.get_publisher_names_and_types_by_node(base, namespace))),
                        tuple(map(_row, node.get_subscriber_names_and_types_by_node(base, namespace))),
                        tuple(map(_row, node.get_service_names_and_types_by_node(base, namespace))),
                    )
                )
            except Exception:  # the node has just gone
                continue
        names = (topics, by_node)
        if names == self._names and now < self._whole_at:
            return
        self._names, self._whole_at = names, now + _WHOLE_PERIOD
        found: dict[str, dict[str, Any]] = {}
        for name, _ in topics:
            for kind, infos in (
                ("MP", node.get_publishers_info_by_topic(name)),
                ("MS", node.get_subscriptions_info_by_topic(name)),
            ):
                for info in infos:
                    if info.node_name.startswith(_UNKNOWN):
                        self._whole_at = 0.0  # what names its node is still on its way
                        continue
                    gid = bytes(info.endpoint_gid).hex()
                    owner = info.node_namespace.rstrip("/") + "/" + info.node_name
                    found[gid] = {
                        "gid": gid,
                        "kind": kind,
                        "node": owner,
                        "name": name,
                        "type": info.topic_type,
                        "hash": str(getattr(info, "topic_type_hash", "") or ""),
                        "qos": _told_qos(info.qos_profile),
                    }
        for owner, _, _, services in by_node:
            for name, types in services:
                for kind_of in types:
                    key = "%s %s %s" % (owner, name, kind_of)
                    found[key] = {
                        "gid": key,
                        "kind": "SS",
                        "node": owner,
                        "name": name,
                        "type": kind_of,
                        "hash": _service_hash(kind_of),
                        "qos": {},
                    }
        added = [each for key, each in found.items() if key not in self._known]
        removed = [key for key in self._known if key not in found]
        self._known = found
        shown = [owner for owner, _, _, _ in by_node]
        if added or removed or shown != self._nodes:
            self._nodes = shown
            self._say("G", 0, nodes=shown, added=added, removed=removed)


def _row(pair: tuple[str, list[str]]) -> tuple[str, tuple[str, ...]]:
    return pair[0], tuple(pair[1])


def _told_qos(profile: Any) -> dict[str, Any]:
    told: dict[str, Any] = {}
    for name, words in _POLICIES.items():
        word = words.get(int(getattr(profile, name)))
        if word is not None:
            told[name] = word
    if profile.depth:
        told["depth"] = profile.depth
    for name, field in (("deadline", "deadline"), ("lifespan", "lifespan"), ("lease", "liveliness_lease_duration")):
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


def read_qos(given: dict[str, Any]) -> Any:
    """The QoS as the gateway writes it: the fields of rmw that differ from its defaults; times in nanoseconds."""
    from rclpy import qos
    from rclpy.duration import Duration

    fields: dict[str, Any] = {"depth": given.get("depth", 10)}
    kinds = (
        ("reliability", qos.ReliabilityPolicy),
        ("durability", qos.DurabilityPolicy),
        ("history", qos.HistoryPolicy),
        ("liveliness", qos.LivelinessPolicy),
    )
    for name, policy in kinds:
        if name in given:
            fields[name] = getattr(policy, given[name])
    for name, field in (("deadline", "deadline"), ("lifespan", "lifespan"), ("lease", "liveliness_lease_duration")):
        if name in given:
            fields[field] = Duration(nanoseconds=given[name])
    return qos.QoSProfile(**fields)
