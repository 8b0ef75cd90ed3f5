"""Decodes the snapshots of one agent, one after the other; what has not changed is not decoded again."""

from __future__ import annotations

from typing import Generic, TypeVar

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.observe.peer_info import PeerInfo  # noqa: TC001 - msgspec reads the annotation
from rmpa.observe.snapshot import AgentInfo, ServiceInfo, Snapshot, TopicInfo, UnreachableInfo
from rmpa.trust.joining import TrustStatus  # noqa: TC001 - msgspec reads the annotation

_T = TypeVar("_T")


class _SnapshotParts(msgspec.Struct, kw_only=True, frozen=True):
    """A ``Snapshot`` whose long lists are not decoded."""

    agent: AgentInfo
    taken: float
    peers: tuple[PeerInfo, ...] = ()
    topics: tuple[msgspec.Raw, ...] = ()
    services: tuple[msgspec.Raw, ...] = ()
    counters: dict[str, int] = {}
    notes: tuple[str, ...] = ()
    unreachable: tuple[UnreachableInfo, ...] = ()
    trust: TrustStatus | None = None
    topics_left: int = 0
    services_left: int = 0
    strangers: tuple[PeerInfo, ...] = ()


class _SnapshotReply(msgspec.Struct, frozen=True):
    """A ``ControlReply`` with a snapshot."""

    ok: bool
    value: _SnapshotParts


class _Entries(Generic[_T]):
    """The entries of one list, by their bytes in the last snapshot."""

    def __init__(self, type_: type[_T]) -> None:
        self._decode = msgspec.json.Decoder(type_).decode
        self._known: dict[bytes, _T] = {}

    def decode(self, raws: tuple[msgspec.Raw, ...]) -> tuple[_T, ...]:
        before, known = self._known, {}
        made: list[_T] = []
        for raw in raws:
            text = bytes(raw)
            entry = before.get(text)
            if entry is None:
                entry = self._decode(text)
            known[text] = entry
            made.append(entry)
        self._known = known
        return tuple(made)


class SnapshotDecoder:
    """Snapshots of one agent. An entry of topics and services with the same bytes as before is the same object.

    Most of a large mesh is idle: its bytes are found again in less time than they are decoded in, and equal entries
    need not be compared.
    """

    def __init__(self) -> None:
        self._reply = msgspec.json.Decoder(_SnapshotReply)
        self._topics = _Entries(TopicInfo)
        self._services = _Entries(ServiceInfo)

    def decode(self, line: bytes) -> Snapshot:
        """The snapshot of a control reply.

        Raises:
            RemoteProtocolError: It has none.
        """
        try:
            parts = self._reply.decode(line).value
            return Snapshot(
                agent=parts.agent,
                taken=parts.taken,
                peers=parts.peers,
                topics=self._topics.decode(parts.topics),
                services=self._services.decode(parts.services),
                counters=parts.counters,
                notes=parts.notes,
                unreachable=parts.unreachable,
                trust=parts.trust,
                topics_left=parts.topics_left,
                services_left=parts.services_left,
                strangers=parts.strangers,
            )
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
            raise RemoteProtocolError(f"not a snapshot: {error}") from None
