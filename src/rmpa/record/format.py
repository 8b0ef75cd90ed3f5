"""Recordings as MCAP (mcap.dev, profile ``ros1``): writes segments, and reads them again, also unfinished ones.

A channel is one publisher of one topic. Its metadata has ``callerid``, ``latching``, ``md5sum`` and, in a file of
several modules, ``module``. ``log_time`` is when this module received a message, ``publish_time`` when it first did:
a latched message that a segment repeats has another one. What happened besides messages are events: JSON in
``std_msgs/String`` on ``EVENTS``. Metadata records: ``rmpa.module`` (``ModuleRecord``), ``rmpa.clock``
(``ClockRecord`` as JSON, by peer) and ``rmpa.time`` (``boot``, the machine's run, and ``epoch``, the wall clock less
the monotonic one, ns), once in each segment: a segment ends where its module's clock was set.
"""

from __future__ import annotations

import contextlib
import heapq
import logging
import os
import struct
from bisect import bisect_left
from functools import partial
from types import SimpleNamespace
from typing import IO, TYPE_CHECKING, Final, NamedTuple

import mcap.writer
import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, Footer, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from rmpa.core.errors import RmpaError
from rmpa.record import limits
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

_log = logging.getLogger(__name__)
# The topic of events.
EVENTS: Final = "/rmpa/events"
# A topic of which each segment repeats the last message of each publisher, whether it latches or not.
STATIC: Final = "/tf_static"
MODULE: Final = "rmpa.module"
CLOCK: Final = "rmpa.clock"
TIME: Final = "rmpa.time"
MERGE: Final = "rmpa.merge"
SUFFIX: Final = ".mcap"
# The end of the name of a segment that is being written.
UNFINISHED: Final = ".part"
_ENCODING, _SCHEMA = "ros1", "ros1msg"
_TEXT: Final = MessageType("std_msgs/String")
_LENGTH: Final = struct.Struct("<I")
# Above all times of the format.
_TIMES: Final = 1 << 64
# Definitions may have comments in any encoding, and their MD5 sums are of their bytes.
_AS_IT_WAS: Final = "surrogateescape"
# The library compresses at zstd's level 3 and has no option for it. Of an image with noise in its low bits (922 KB)
# that takes 6 ms and leaves 49 %; level 1 takes 1 ms and leaves 58 %.
vars(mcap.writer)["zstandard"] = SimpleNamespace(compress=partial(zstandard.compress, level=1))
# Bytes of opcode and length in front of a record of MCAP.
_RECORD_HEAD: Final = 9


class DamagedError(RmpaError):
    """A recording cannot be read."""

    code = "recording-damaged"


class RecordedSource(NamedTuple):
    """One publisher of one topic.

    Attributes:
        topic: The topic's name in its module.
        type: The message type, ``package/Name``.
        md5sum: Its MD5 sum.
        definition: Its definition, with those of the types in it.
        node: The publisher's name.
        latching: Whether it latches.
        module: The module that recorded it.
    """

    topic: str
    type: str
    md5sum: str
    definition: str
    node: str
    latching: bool = False
    module: str = ""


class Recorded(NamedTuple):
    """A message of a recording; times in Unix nanoseconds.

    Attributes:
        source: Where it came from.
        log_time: When the module received it, or wrote it again.
        publish_time: When the module first received it.
        data: Its bytes.
    """

    source: RecordedSource
    log_time: int
    publish_time: int
    data: bytes

    @property
    def repeated(self) -> bool:
        """Whether it is a latched message that a segment has again, for what begins to read there."""
        source = self.source
        return self.publish_time != self.log_time and (source.latching or source.topic == STATIC)


class ClockRecord(msgspec.Struct, frozen=True):
    """What a module knew of another one's clock.

    Attributes:
        at: When, by the own clock, Unix nanoseconds.
        ahead: By so many seconds the other clock was ahead.
        error: The bound of that, seconds; ``None``: it was not known.
    """

    at: int
    ahead: float
    error: float | None


class ModuleRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The module that recorded a segment.

    Attributes:
        name: Its name.
        guid: Its GUID.
        instance: The random id of the agent's run.
        host: The machine's host name.
        version: Of RMPA.
    """

    name: str = ""
    guid: str = ""
    instance: str = ""
    host: str = ""
    version: str = ""


class Event(msgspec.Struct, frozen=True, omit_defaults=True):
    """Something that happened, beside messages.

    Attributes:
        kind: ``peer_lost``, ``node_died``, ``contract`` …
        text: A sentence for people.
        subject: What it is about: a peer, node, topic or resource.
        module: Where it was noticed.
        trigger: Whether it is a reason to keep a recording.
        facts: Further values.
    """

    kind: str
    text: str
    subject: str = ""
    module: str = ""
    trigger: bool = False
    facts: dict[str, str | float | int | None] = {}


EVENT_SOURCE: Final = RecordedSource(EVENTS, _TEXT.name, _TEXT.md5sum, _TEXT.definition, "/record")


def event_bytes(event: Event) -> bytes:
    """An event as the bytes of a ``std_msgs/String``."""
    text = msgspec.json.encode(event)
    return _LENGTH.pack(len(text)) + text


def read_event(data: bytes) -> Event | None:
    """The event in a message on ``EVENTS``; ``None`` if it is none of this release."""
    try:
        return msgspec.json.decode(data[_LENGTH.size :], type=Event)
    except msgspec.DecodeError:
        return None


class SegmentWriter:
    """Writes one MCAP file.

    Args:
        file: The file, open for writing; it stays open.
        module: The module that records; ``None``: the file is one of several modules.
        compress: Whether chunks are compressed.
    """

    def __init__(self, file: IO[bytes], module: ModuleRecord | None, *, compress: bool = True) -> None:
        compression = CompressionType.ZSTD if compress else CompressionType.NONE
        self._writer = Writer(file, chunk_size=limits.CHUNK, compression=compression)
        self._writer.start(_ENCODING, "rmpa")
        self._schemas: dict[tuple[str, str], int] = {}
        self._channels: dict[RecordedSource, int] = {}
        self._sequence = 0
        if module is not None:
            self.metadata(MODULE, msgspec.to_builtins(module))

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record."""
        self._writer.add_metadata(name, dict(values))

    def attachment(self, name: str, media_type: str, data: bytes, at: int) -> None:
        """Write an attachment of a time, Unix nanoseconds."""
        self._writer.add_attachment(at, at, name, media_type, data)

    def write(self, source: RecordedSource, log_time: int, publish_time: int, data: bytes) -> None:
        """Write a message.

        Raises:
            ValueError: It cannot be written; the file is as it was.
        """
        if not (0 < log_time < _TIMES and 0 <= publish_time < _TIMES):
            raise ValueError(f"{source.topic} has a time that is none: {log_time}, {publish_time}")
        channel = self._channels.get(source)
        if channel is None:
            channel = self._channels[source] = self._register(source)
        self._sequence = self._sequence + 1 & 0xFFFFFFFF
        self._writer.add_message(channel, log_time, data, publish_time, self._sequence)

    def flush(self) -> None:
        """Write what is in memory to the file; the kernel has it then."""
        self._writer.flush()  # type: ignore[no-untyped-call] # of the library

    def finish(self) -> None:
        """Write the rest with the index of the file."""
        self._writer.finish()  # type: ignore[no-untyped-call] # of the library

    def _register(self, source: RecordedSource) -> int:
        for text in (source.topic, source.type, source.md5sum, source.node, source.module):
            text.encode()  # what is no UTF-8 would damage the whole file
        key = source.type, source.md5sum
        if key not in self._schemas:
            definition = source.definition.encode("utf-8", _AS_IT_WAS)
            self._schemas[key] = self._writer.register_schema(source.type, _SCHEMA, definition)
        about = {"callerid": source.node, "latching": str(int(source.latching)), "md5sum": source.md5sum}
        if source.module:
            about["module"] = source.module
        return self._writer.register_channel(source.topic, _ENCODING, self._schemas[key], about)


class SegmentReader:
    """Reads one MCAP file of ROS 1, of this program or another one; an unfinished one as far as it goes.

    Args:
        path: The file.

    Raises:
        DamagedError: It cannot be opened, or is none.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.module = ModuleRecord()
        # What the file says of clocks, by peer; a merged one has many of each.
        self.readings: list[tuple[str, ClockRecord]] = []
        # The machine's run, and its wall clock less the monotonic one, ns.
        self.epoch = "", 0
        self.merged: dict[str, str] = {}
        # As they are, in an unfinished file; known after ``messages``.
        self.metadata: list[Metadata] = []
        self.attachments: list[Attachment] = []
        # Whether the end of the file is missing, and chunks that cannot be read; known after ``messages``.
        self.unfinished = False
        self.damage = 0
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, RecordedSource] = {}
        self._span = 0, 0

    def head(self) -> tuple[int, int, list[RecordedSource]]:
        """The times of the first and the last message, and all sources as they appear; by the index, if there is one.

        Raises:
            DamagedError: As for ``messages``.
        """
        try:
            with self.path.open("rb") as file:
                if self._index(file) is not None:
                    return *self._span, list(self._channels.values())
        except OSError as error:
            raise DamagedError(f"{self.path}: {error.strerror or error}") from error
        first = last = 0
        for message in self.messages():
            first, last = min(first or message.log_time, message.log_time), max(last, message.log_time)
        return first, last, list(self._channels.values())

    def messages(self, since: int = 0) -> Iterator[Recorded]:
        """The messages in order of their log times; metadata is known after the first one.

        Args:
            since: Messages before may be left out, but for latched ones.

        Raises:
            DamagedError: The file cannot be read from its beginning on.
        """
        try:
            with self.path.open("rb") as file:
                chunks = self._index(file)
                yield from self._unindexed(file) if chunks is None else self._indexed(file, chunks, since)
        except OSError as error:
            raise DamagedError(f"{self.path}: {error.strerror or error}") from error

    def _index(self, file: IO[bytes]) -> list[ChunkIndex] | None:
        """The chunks by the times of their first messages; ``None``: there is no index, as after a crash."""
        try:
            reader = SeekingReader(file)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None or not summary.chunk_indexes:
                return None
            for record in reader.iter_metadata():
                self._metadata(record)
            self._schemas = dict(summary.schemas)
            self._channels = {number: self._source(one) for number, one in summary.channels.items()}
            self._span = summary.statistics.message_start_time, summary.statistics.message_end_time
            return sorted(summary.chunk_indexes, key=lambda one: (one.message_start_time, one.chunk_start_offset))
        except OSError:
            raise
        except Exception as error:  # noqa: BLE001 - whatever the library makes of damaged bytes
            _log.debug("%s: %s", self.path, error)
            return None

    def _indexed(self, file: IO[bytes], chunks: list[ChunkIndex], since: int) -> Iterator[Recorded]:
        """By the index: in order also where the clock was set back, and past chunks that are damaged."""
        latching = {number for number, one in self._channels.items() if one.latching or one.topic == STATIC}
        waiting: list[Recorded] = []
        for one in chunks:
            if one.message_end_time < since and not latching & one.message_index_offsets.keys():
                continue
            due = bisect_left(waiting, one.message_start_time, key=_log_time)
            yield from waiting[:due]
            del waiting[:due]
            try:
                file.seek(one.chunk_start_offset + _RECORD_HEAD)
                records = breakup_chunk(Chunk.read(ReadDataStream(file)), validate_crc=True)
            except Exception as error:  # noqa: BLE001 - as above
                _log.debug("%s: %s", self.path, error)
                self.damage += 1
                continue
            waiting += [message for record in records if (message := self._take(record)) is not None]
            waiting.sort(key=_log_time)
        yield from waiting

    def _unindexed(self, file: IO[bytes]) -> Iterator[Recorded]:
        """From the beginning on, as far as the file goes; in order within each chunk."""
        ended, chunk = False, list[Recorded]()
        file.seek(0)
        try:
            for record in StreamReader(file, emit_chunks=True).records:
                ended = isinstance(record, Footer)
                if isinstance(record, Chunk):
                    yield from sorted(chunk, key=_log_time)
                    chunk = [one for part in breakup_chunk(record) if (one := self._take(part)) is not None]
                elif (one := self._take(record)) is not None:
                    chunk.append(one)
        except OSError:
            raise
        except Exception as error:
            if not self._channels and not self.module.name:
                why = "it is empty" if not file.seek(0, 2) else "it is no recording, or its beginning is damaged"
                raise DamagedError(f"{self.path}: {why}") from error
        self.unfinished = not ended
        yield from sorted(chunk, key=_log_time)

    def _take(self, record: object) -> Recorded | None:
        if isinstance(record, Message):
            source = self._channels.get(record.channel_id)
            return source and Recorded(source, record.log_time, record.publish_time, record.data)
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels.setdefault(record.id, self._source(record))
        elif isinstance(record, Metadata):
            self.metadata.append(record)
            self._metadata(record)
        elif isinstance(record, Attachment):
            self.attachments.append(record)
        return None

    def _source(self, channel: Channel) -> RecordedSource:
        schema, about = self._schemas.get(channel.schema_id), channel.metadata
        name, definition = (schema.name, schema.data.decode("utf-8", _AS_IT_WAS)) if schema else ("", "")
        node, latching = about.get("callerid", ""), about.get("latching", "0") in ("1", "true")
        module = about.get("module", self.module.name)
        return RecordedSource(channel.topic, name, about.get("md5sum", ""), definition, node, latching, module)

    def _metadata(self, record: Metadata) -> None:
        try:
            if record.name == MODULE:
                self.module = msgspec.convert(record.metadata, ModuleRecord)
            elif record.name == CLOCK:
                known = {p: msgspec.json.decode(text, type=ClockRecord) for p, text in record.metadata.items()}
                self.readings += known.items()
            elif record.name == TIME:
                self.epoch = record.metadata["boot"], int(record.metadata["epoch"])
            elif record.name == MERGE:
                self.merged = dict(record.metadata)
        except (msgspec.DecodeError, msgspec.ValidationError, KeyError, ValueError):
            pass  # of another release


def _log_time(message: Recorded) -> int:
    return message.log_time


def read_in_order(streams: Iterable[tuple[int, Iterator[Recorded]]]) -> Iterator[Recorded]:
    """The messages of several files in order; a file is opened when its first message is due.

    Args:
        streams: The time of the first message of each, and its messages in order.
    """
    waiting: list[tuple[tuple[int, str, str, str], int, Recorded | None, Iterator[Recorded]]] = [
        ((begin, "", "", ""), number, None, stream) for number, (begin, stream) in enumerate(streams)
    ]
    heapq.heapify(waiting)
    while waiting:
        _, number, message, stream = waiting[0]
        if message is not None:
            yield message
        if (message := next(stream, None)) is None:
            heapq.heappop(waiting)
        else:
            source = message.source
            key = message.log_time, source.module, source.topic, source.node
            heapq.heapreplace(waiting, (key, number, message, stream))


def finish_file(path: Path) -> Path:
    """Write a segment that a crash left unfinished again, with its index.

    Args:
        path: The file, ``NAME.mcap.part``.

    Returns:
        The finished file; the unfinished one is gone.

    Raises:
        DamagedError: Nothing of it can be read.
        OSError: It cannot be written.
    """
    reader, done = SegmentReader(path), path.with_name(path.name.removesuffix(UNFINISHED))
    found = list(reader.messages())
    if not reader.unfinished:
        return path.replace(done)
    whole, about = done.with_name(f"{done.name}.new"), path.stat()
    try:
        with whole.open("wb") as file:
            writer = SegmentWriter(file, None)
            for record in reader.metadata:
                writer.metadata(record.name, record.metadata)
            for one in reader.attachments:
                writer.attachment(one.name, one.media_type, one.data, one.log_time)
            for message in found:
                writer.write(*message)
            writer.finish()
        os.utime(whole, ns=(about.st_atime_ns, about.st_mtime_ns))  # it is as old as it was
        whole.replace(done)
    except OSError:
        with contextlib.suppress(OSError):
            whole.unlink(missing_ok=True)
        raise
    path.unlink()
    return done
