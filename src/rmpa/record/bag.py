"""ROS 1 bags (version 2.0, wiki.ros.org/Bags/Format/2.0): recordings as rosbag and rqt_bag read them, and back."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Final

from rosbags.rosbag1 import Reader, Writer

from rmpa.core.errors import RmpaError
from rmpa.core.identity import OWN_NODE
from rmpa.record.format import STATIC, DamagedError, Recorded, RecordedSource, SegmentReader

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from rosbags.interfaces import Connection

BAG: Final = ".bag"


def write_bag(messages: Iterable[Recorded], path: Path) -> int:
    """Write messages as a bag, not compressed; those of other modules have the names of their proxies as callers.

    Args:
        messages: In order of their log times.
        path: The file, which must not exist.

    Returns:
        The number of messages.

    Raises:
        RmpaError: The file exists, or cannot be written.
    """
    if path.exists():
        raise RmpaError(f"{path} exists; name another file", code="file-exists")
    count = 0
    writer = Writer(path)
    with writer:
        connections: dict[RecordedSource, Connection] = {}
        for count, (source, log_time, _, data) in enumerate(messages, 1):  # noqa: B007 - it is the result
            connection = connections.get(source)
            if connection is None:
                node = f"{OWN_NODE}/{source.module}{source.node}" if source.module else source.node
                connection = connections[source] = writer.add_connection(
                    source.topic,
                    source.type.replace("/", "/msg/"),  # as the library writes it
                    msgdef=source.definition.encode("utf-8", "replace").decode(),  # the library has text alone
                    md5sum=source.md5sum,
                    callerid=node,
                    latching=int(source.latching),
                )
            writer.write(connection, log_time, data)
    return count


class BagReader(SegmentReader):
    """Reads one bag, as ``SegmentReader`` does MCAP.

    Where each caller is one of a module (``/rmpa/MODULE/node``), the bag is one that was written here.
    """

    def head(self) -> tuple[int, int, list[RecordedSource]]:
        """As of ``SegmentReader``."""
        with self._open() as bag:
            span = (bag.start_time, bag.end_time) if bag.chunk_infos else (0, 0)
            return *span, list(_sources(bag.connections).values())

    def messages(self, since: int = 0) -> Iterator[Recorded]:
        """As of ``SegmentReader``."""
        with self._open() as bag:
            sources = _sources(bag.connections)
            latching = [one for one in bag.connections if sources[one.id].latching or one.topic == STATIC]
            if since and latching:
                for connection, at, data in bag.messages(latching, stop=since):
                    yield Recorded(sources[connection.id], at, at, data)
            for connection, at, data in bag.messages(start=since) if bag.connections else ():
                yield Recorded(sources[connection.id], at, at, data)

    @contextlib.contextmanager
    def _open(self) -> Iterator[Reader]:
        try:
            with Reader(self.path) as bag:
                yield bag
        except GeneratorExit:
            raise
        except Exception as error:  # noqa: BLE001 - whatever the library makes of damaged bytes
            raise DamagedError(f"{self.path}: {error}; `rosbag reindex` may mend it") from None


def _sources(connections: Iterable[Connection]) -> dict[int, RecordedSource]:
    callers = {one.id: one.ext.callerid or "" for one in connections}  # type: ignore[union-attr] # of a bag of ROS 1
    ours = all(name.startswith(f"{OWN_NODE}/") for name in callers.values())
    found = {}
    for one in connections:
        module, _, node = callers[one.id][len(OWN_NODE) + 1 :].partition("/") if ours else ("", "", "")
        node = f"/{node}" if ours else callers[one.id]
        latching = bool(one.ext.latching)  # type: ignore[union-attr] # likewise
        kind = one.msgtype.replace("/msg/", "/")
        found[one.id] = RecordedSource(one.topic, kind, one.digest, one.msgdef.data, node, latching, module)
    return found
