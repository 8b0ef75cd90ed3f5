"""The file of last values: over a restart, bounded, with a damaged file, with a disk that takes nothing."""

from __future__ import annotations

import contextlib
import logging
import sqlite3
from typing import TYPE_CHECKING

import pytest

from rmpa.gateway import limits
from rmpa.gateway.sites.io.last_value_store import LastValueStore
from rmpa.gateway.sites.last_values import LastValue, ValueKey

if TYPE_CHECKING:
    from pathlib import Path

MAP = ValueKey("arm", "/map", "/map_server")


def value(body: bytes = b"map", stamp: int = 1) -> LastValue:
    return LastValue("nav_msgs/OccupancyGrid", "a" * 32, "float32 x", True, stamp, body)


def numbered(number: int) -> ValueKey:
    return ValueKey("arm", f"/topic_{number}", "/node")


async def test_the_last_value_is_there_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "values.sqlite"
    first = LastValueStore(path)
    await first.open()
    first.put(MAP, value(b"old", 1))
    first.put(MAP, value(b"new", 2))
    assert await first.body(MAP) == b"new"
    await first.close()
    second = LastValueStore(path)
    await second.open()
    header = second.headers[MAP]
    assert (header.type, header.md5sum, header.definition) == ("nav_msgs/OccupancyGrid", "a" * 32, "float32 x")
    assert (header.latching, header.stamp, header.size) == (True, 2, 3)
    assert await second.body(MAP) == b"new"
    assert await second.body(numbered(1)) is None
    second.forget(MAP)
    await second.close()
    third = LastValueStore(path)
    await third.open()
    assert third.headers == {}
    await third.close()


async def test_the_oldest_values_go_first(tmp_path: Path) -> None:
    store = LastValueStore(tmp_path / "values.sqlite", values_max=3, bytes_max=100 + 3 * len("float32 x"))
    await store.open()
    for number in range(5):
        store.put(numbered(number), value(b"x" * 30, number))
    assert list(store.headers) == [numbered(2), numbered(3), numbered(4)]
    store.put(numbered(5), value(b"y" * 60, 5))
    assert list(store.headers) == [numbered(4), numbered(5)]
    assert not store.put(numbered(4), value(b"z" * 128, 6))
    assert list(store.headers) == [numbered(5)]
    assert store.dropped == 1
    await store.close()
    with contextlib.closing(sqlite3.connect(tmp_path / "values.sqlite")) as connection:
        rows = connection.execute("SELECT topic FROM last_values").fetchall()
    assert rows == [("/topic_5",)]


@pytest.mark.parametrize("garbage", [b"no database at all" * 500, b"SQLite format 3\0" + b"\xff" * 5000])
async def test_a_damaged_file_is_set_aside_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, garbage: bytes
) -> None:
    path = tmp_path / "values.sqlite"
    path.write_bytes(garbage)
    store = LastValueStore(path)
    with caplog.at_level(logging.WARNING):
        await store.open()
    assert "is damaged" in caplog.text
    assert path.with_name("values.sqlite.damaged").read_bytes() == garbage
    store.put(MAP, value())
    await store.close()
    again = LastValueStore(path)
    await again.open()
    assert await again.body(MAP) == b"map"
    await again.close()


async def test_a_file_that_is_damaged_while_it_is_used_is_begun_anew(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "values.sqlite"
    store = LastValueStore(path)
    await store.open()
    store.put(MAP, value(b"x" * 100_000))
    await store.close()
    data = bytearray(path.read_bytes())
    data[4096 : len(data)] = b"\xff" * (len(data) - 4096)
    path.write_bytes(data)
    again = LastValueStore(path)
    with caplog.at_level(logging.WARNING):
        await again.open()
    assert "is damaged" in caplog.text
    assert again.headers == {}
    again.put(MAP, value(b"new"))
    await again.close()
    assert again.problem == ""


async def test_a_disk_that_takes_nothing_is_a_warning_and_values_are_still_answered(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "LAST_VALUES_INTERVAL", 0.001)
    monkeypatch.setattr(limits, "LAST_VALUES_PENDING_MAX", 20)
    (tmp_path / "no_folder").write_text("a file where the folder should be")
    store = LastValueStore(tmp_path / "no_folder" / "values.sqlite")
    with caplog.at_level(logging.WARNING):
        await store.open()
    assert "last values are not kept" in caplog.text
    assert store.problem
    store.put(MAP, value(b"123456", 1))
    assert await store.body(MAP) == b"123456"
    store.put(numbered(1), value(b"abcdef", 2))  # more than may wait: the older one is dropped
    assert store.dropped == 1
    assert await store.body(MAP) is None
    assert await store.body(numbered(1)) == b"abcdef"
    (tmp_path / "no_folder").unlink()
    await store.close()
    assert store.problem == ""
    again = LastValueStore(tmp_path / "no_folder" / "values.sqlite")
    await again.open()
    assert list(again.headers) == [numbered(1)]
    await again.close()


async def test_a_full_file_is_a_problem_and_not_an_error(tmp_path: Path) -> None:
    store = LastValueStore(tmp_path / "values.sqlite")
    await store.open()
    store.put(MAP, value())
    await store._flush()
    assert store._connection is not None
    store._connection.execute("PRAGMA max_page_count = 1")  # as a full disk: SQLITE_FULL
    store.put(numbered(1), value(b"x" * 1_000_000))
    assert not await store._flush()
    assert "full" in store.problem
    assert await store.body(numbered(1)) == b"x" * 1_000_000
    assert await store.body(MAP) == b"map"
    assert await store._flush()  # the file is opened anew, with its own bound
    assert store.problem == ""
    await store.close()


async def test_a_file_of_a_later_release_is_set_aside(tmp_path: Path) -> None:
    path = tmp_path / "values.sqlite"
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA user_version = 99")
    store = LastValueStore(path)
    await store.open()
    store.put(MAP, value())
    await store.close()
    assert path.with_name("values.sqlite.damaged").exists()


async def test_without_a_state_directory_values_are_kept_while_it_runs() -> None:
    store = LastValueStore(None)
    await store.open()
    store.put(MAP, value())
    assert await store.body(MAP) == b"map"
    assert "no state directory" in store.problem
    await store.close()


async def test_definitions_count_and_giant_ones_are_left_out(tmp_path: Path) -> None:
    """Another site's header may have half a megabyte of definition beside a message of one byte."""
    store = LastValueStore(tmp_path / "values.sqlite", bytes_max=100_000)
    await store.open()
    for number in range(50):
        giant = "x" * (limits.LAST_VALUE_DEFINITION_MAX + 1)
        store.put(ValueKey("eve", f"/giant{number}", "/n"), LastValue("a/B", "0" * 32, giant, True, number, b"x"))
    assert {header.definition for header in store.headers.values()} == {""}
    for number in range(50):
        text = "x" * 10_000
        store.put(ValueKey("eve", f"/long{number}", "/n"), LastValue("a/B", "0" * 32, text, True, 100 + number, b"x"))
    assert len(store.headers) == 9, "100,000 bytes, with the definitions"
    await store.close()
    assert (tmp_path / "values.sqlite").stat().st_size < 1_000_000
