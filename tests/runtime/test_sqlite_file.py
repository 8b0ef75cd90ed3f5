"""Files of SQLite: a damaged or a newer one is told apart, and is kept under another name."""

from __future__ import annotations

import contextlib
import sqlite3
from typing import TYPE_CHECKING

import pytest

from rmpa.runtime import sqlite_file
from rmpa.runtime.sqlite_file import DamagedFileError

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A sound file of version 2, with some pages."""
    path = tmp_path / "state.sqlite"
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("CREATE TABLE rows (number, text)")
        connection.executemany("INSERT INTO rows VALUES (?, ?)", [(number, "x" * 200) for number in range(500)])
        connection.execute("PRAGMA user_version = 2")
    return path


def check(path: Path, version: int) -> None:
    with contextlib.closing(sqlite3.connect(path)) as connection:
        sqlite_file.check(connection, version)


def test_a_sound_file_of_this_or_an_earlier_version_is_used(path: Path) -> None:
    check(path, 2)
    check(path, 3)


def test_a_newer_one_is_not(path: Path) -> None:
    with pytest.raises(DamagedFileError, match="it is of version 2; this release reads 1"):
        check(path, 1)


def test_a_damaged_one_is_not(path: Path) -> None:
    raw = bytearray(path.read_bytes())
    raw[4096:] = bytes(byte ^ 0x5A for byte in raw[4096:])
    path.write_bytes(raw)
    with pytest.raises(DamagedFileError):
        check(path, 2)


def test_what_is_no_data_base_is_damaged_and_a_locked_one_is_not(path: Path, tmp_path: Path) -> None:
    text = tmp_path / "text"
    text.write_text("this is no data base" * 100)
    with pytest.raises(sqlite3.DatabaseError) as caught:
        check(text, 2)
    assert sqlite_file.is_damaged(caught.value)
    with (
        contextlib.closing(sqlite3.connect(path)) as one,
        contextlib.closing(sqlite3.connect(path, timeout=0)) as two,
    ):
        one.execute("BEGIN EXCLUSIVE")
        with pytest.raises(sqlite3.OperationalError) as locked:
            sqlite_file.check(two, 2)
        assert not sqlite_file.is_damaged(locked.value)


def test_it_is_kept_in_place_of_an_earlier_one_without_its_journals(path: Path) -> None:
    path.with_name("state.sqlite.damaged").write_text("an earlier one")
    for suffix in ("-wal", "-shm", "-journal"):
        path.with_name(f"state.sqlite{suffix}").write_text("of the damaged one")
    content = path.read_bytes()
    aside = sqlite_file.set_aside(path)
    assert aside.read_bytes() == content
    assert [each.name for each in path.parent.iterdir()] == ["state.sqlite.damaged"]


def test_a_connection_is_closed_and_none_is_no_mistake(path: Path) -> None:
    sqlite_file.close(None)
    connection = sqlite3.connect(path)
    sqlite_file.close(connection)
    with pytest.raises(sqlite3.ProgrammingError):
        connection.execute("SELECT 1")
