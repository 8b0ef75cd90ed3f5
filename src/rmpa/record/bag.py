"""ROS 1 bags (version 2.0, wiki.ros.org/Bags/Format/2.0): recordings as rosbag and rqt_bag read them, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rosbags.rosbag1 import Reader, ReaderError, Writer

from rmpa.core.errors import RmpaError
from rmpa.core.identity import OWN_NODE
from rmpa.record.format import DamagedError, Recorded, RecordedSource, read_in_order
from rmpa.record.merge import files_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from rosbags.interfaces import Connection

BAG: Final = ".bag"


def _bag_type(name: str) -> str:
    """The type's name as the library writes it: ``std_msgs/msg/String``."""
    package, _, kind = name.partition("/")
    return f"{package}/msg/{kind}"


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
        for source, log_time, _, data in messages:
            connection = connections.get(source)
            if connection is None:
                node = f"{OWN_NODE}/{source.module}{source.node}" if source.module else source.node
                connection = connections[source] = writer.add_connection(
                    source.topic,
                    _bag_type(source.type),
                    msgdef=source.definition.encode("utf-8", "replace").decode(),  # the library has text alone
                    md5sum=source.md5sum,
                    callerid=node,
                    latching=int(source.latching),
                )
            writer.write(connection, log_time, data)
            count += 1
    return count


def read_bag(path: Path) -> Iterator[Recorded]:
    """The messages of a bag, in order of their times.

    Raises:
        DamagedError: It cannot be read.
    """
    try:
        with Reader(path) as reader:
            sources = {
                one.id: RecordedSource(
                    one.topic,
                    one.msgtype.replace("/msg/", "/"),
                    one.digest,
                    one.msgdef.data,
                    one.ext.callerid or "",  # type: ignore[union-attr] # of a bag of ROS 1
                    bool(one.ext.latching),  # type: ignore[union-attr] # likewise
                )
                for one in reader.connections
            }
            for connection, at, data in reader.messages():
                yield Recorded(sources[connection.id], at, at, data)
    except (ReaderError, OSError, ValueError) as error:
        raise DamagedError(f"{path}: {error}; `rosbag reindex` may mend it") from None


def read_any(path: Path) -> Iterator[Recorded]:
    """The messages of a recording: a bag, an MCAP file, or a folder of segments; in order of their times.

    Raises:
        DamagedError: It cannot be read.
        RmpaError: There is none.
    """
    if path.suffix == BAG:
        return read_bag(path)
    return read_in_order(files_of(path))
