"""Nodes restored from the previous run of a core, which have not answered since its restart."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from rmpa.ros.master.effects import RegistrationKind

if TYPE_CHECKING:
    from collections.abc import Iterator


class NodeRecord(msgspec.Struct, omit_defaults=True):
    """Everything that one node registered.

    Attributes:
        api: The URI of its slave API.
        publishers: Topics that it publishes, with their types.
        subscribers: Topics that it subscribes to, with their types.
        services: Services that it provides, with their ``rosrpc://`` URIs.
        params: Parameters that it subscribed to; each ends in ``/``.
    """

    api: str
    publishers: dict[str, str] = msgspec.field(default_factory=dict)
    subscribers: dict[str, str] = msgspec.field(default_factory=dict)
    services: dict[str, str] = msgspec.field(default_factory=dict)
    params: dict[str, None] = msgspec.field(default_factory=dict)

    def serialize(self) -> bytes:
        """Return the record as JSON."""
        return msgspec.json.encode(self)

    def of(self, kind: RegistrationKind) -> dict[str, str] | dict[str, None]:
        """The node's registrations of one kind; the record's own dict, not a copy."""
        match kind:
            case RegistrationKind.PUBLISHER:
                return self.publishers
            case RegistrationKind.SUBSCRIBER:
                return self.subscribers
            case RegistrationKind.SERVICE:
                return self.services
            case RegistrationKind.PARAM:
                return self.params


class UnverifiedNodes:
    """The records of unverified nodes, and the publishers among them by topic."""

    def __init__(self) -> None:
        self._records: dict[str, NodeRecord] = {}
        self._publishers: dict[str, dict[str, str]] = {}

    def __len__(self) -> int:
        return len(self._records)

    def __iter__(self) -> Iterator[str]:
        return iter(self._records)

    def get(self, node: str) -> NodeRecord | None:
        """The record of an unverified node; not to be changed."""
        return self._records.get(node)

    def add(self, node: str, record: NodeRecord) -> None:
        """Add a node; the caller must not change the record afterwards."""
        self._records[node] = record
        for topic in record.publishers:
            self._publishers.setdefault(topic, {})[node] = record.api

    def pop(self, node: str) -> NodeRecord | None:
        """Remove a node and return its record; ``None`` if it is not unverified."""
        record = self._records.pop(node, None)
        for topic in record.publishers if record is not None else ():
            self._forget_publisher(topic, node)
        return record

    def withdraw(self, kind: RegistrationKind, key: str, node: str, api: str) -> bool:
        """Remove one registration, if ``api`` is that node's; return whether it was there."""
        record = self._records.get(node)
        if record is None or record.api != api or key not in record.of(kind):
            return False
        del record.of(kind)[key]
        if kind is RegistrationKind.PUBLISHER:
            self._forget_publisher(key, node)
        return True

    def publishers_of(self, topic: str) -> dict[str, str]:
        """The unverified publishers of a topic with their slave APIs."""
        return dict(self._publishers.get(topic, {}))

    def publishers(self, topic: str) -> list[str]:
        """The slave APIs of the unverified publishers of a topic."""
        return list(self._publishers.get(topic, {}).values())

    def _forget_publisher(self, topic: str, node: str) -> None:
        nodes = self._publishers[topic]
        del nodes[node]
        if not nodes:
            del self._publishers[topic]
