"""Segments of recordings: written, read again, and read after a crash at any moment."""

from __future__ import annotations

import random
from io import BytesIO
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from rmpa.record.format import (
    EVENT_SOURCE,
    DamagedError,
    Event,
    ModuleRecord,
    Recorded,
    SegmentReader,
    SegmentWriter,
    event_bytes,
    finish_file,
    read_event,
)
from tests.record.conftest import SECOND, START, source, text

ODOM = source("/odom", "/base")
MAP = source("/map", "/map_server", latching=True)


def written(path: Path, count: int, *, finished: bool) -> list[int]:
    """Write so many messages with a flush after each tenth; the sizes that the file had after each flush."""
    sizes = []
    with path.open("wb") as file:
        writer = SegmentWriter(file, ModuleRecord(name="arm"))
        for number in range(count):
            writer.write(ODOM, START + number, START + number, text(f"{number}"))
            if number % 10 == 9:
                writer.flush()
                sizes.append(file.tell())
        if finished:
            writer.finish()
    return sizes


def test_other_readers_of_mcap_read_a_segment(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written(path, 30, finished=True)
    with path.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros1"
        found = [
            (schema.name if schema else "", channel.topic, message.log_time)
            for schema, channel, message in reader.iter_messages()
        ]
    assert found == [("std_msgs/String", "/odom", START + number) for number in range(30)]


def test_what_was_flushed_before_a_crash_at_any_byte_is_read(tmp_path: Path) -> None:
    whole = tmp_path / "whole.mcap.part"
    sizes = written(whole, 200, finished=False)
    data = whole.read_bytes()
    chance = random.Random(1)
    for at in sorted(chance.sample(range(sizes[0], len(data)), 200)):
        path = tmp_path / "cut.mcap.part"
        path.write_bytes(data[:at])
        safe = 10 * sum(size <= at for size in sizes)
        done = finish_file(path)
        reader = SegmentReader(done)
        found = [message.data for message in reader.messages()]
        assert found[:safe] == [text(f"{number}") for number in range(safe)], at
        assert reader.module.name == "arm"
        assert not reader.unfinished
        assert not path.exists()


def test_a_file_that_is_whole_stays_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap.part"
    with path.open("wb") as file:
        writer = SegmentWriter(file, ModuleRecord(name="arm"))
        writer.attachment("parameters.json", "application/json", b"{}", START)
        writer.write(ODOM, START, START, text("0"))
        writer.finish()
    data = path.read_bytes()
    assert finish_file(path).read_bytes() == data
    assert not path.exists()


@pytest.mark.parametrize("data", [b"", b"no recording", b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n"])
def test_what_is_no_recording_is_said(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    with pytest.raises(DamagedError, match=r"a\.mcap"):
        list(SegmentReader(path).messages())


@given(st.binary(max_size=400), st.integers(min_value=0, max_value=600))
def test_any_bytes_are_messages_or_an_error(junk: bytes, at: int) -> None:
    buffer = BytesIO()
    writer = SegmentWriter(buffer, ModuleRecord(name="arm"))
    for number in range(20):
        writer.write(MAP, START + number, START, text("x" * number))
    writer.finish()
    data = buffer.getvalue()
    path = Path(f"/proc/self/fd/{_memory(data[:at] + junk + data[at + len(junk) :])}")
    try:
        found = list(SegmentReader(path).messages())
    except DamagedError:
        return
    assert all(isinstance(message, Recorded) for message in found)


_descriptor: list[int] = []


def _memory(data: bytes) -> int:
    """A file in memory, of one descriptor for all examples."""
    import os

    if not _descriptor:
        _descriptor.append(os.memfd_create("recording"))
    os.ftruncate(_descriptor[0], 0)
    os.pwrite(_descriptor[0], data, 0)
    return _descriptor[0]


def test_an_event_is_a_text_of_ros() -> None:
    event = Event("peer_lost", "the link to base is lost", "base", trigger=True, facts={"after": 1.5})
    assert read_event(event_bytes(event)) == event
    assert EVENT_SOURCE.type == "std_msgs/String"
    assert read_event(text("no event")) is None


def test_messages_are_in_order_of_their_times(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = SegmentWriter(file, None)
        for late in (3, 1):
            writer.write(ODOM, START + late * SECOND, START, b"")
        writer.flush()
        writer.write(ODOM, START + 2 * SECOND, START, b"")  # the clock was set back
        writer.finish()
    assert [m.log_time - START for m in SegmentReader(path).messages()] == [SECOND, 2 * SECOND, 3 * SECOND]


def test_reading_from_a_time_on_gives_what_latched_before(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = SegmentWriter(file, None)
        for late, one in enumerate((MAP, ODOM, ODOM, ODOM)):
            writer.write(one, START + late * SECOND, START + late * SECOND, b"")
            writer.flush()
        writer.finish()
    found = [(m.source.topic, m.log_time - START) for m in SegmentReader(path).messages(START + 2 * SECOND)]
    assert found == [("/map", 0), ("/odom", 2 * SECOND), ("/odom", 3 * SECOND)]
