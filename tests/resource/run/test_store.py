from __future__ import annotations

import asyncio
import sqlite3
from typing import TYPE_CHECKING

import pytest

from rmpa.config.state_dir import module_dir, state_dir
from rmpa.resource import limits
from rmpa.resource.run import store as store_module
from rmpa.resource.run.store import ResourceStore

if TYPE_CHECKING:
    from pathlib import Path

GAIN, DRIVER = ("parameter", "gain"), ("requirement", "/driver")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return module_dir(tmp_path / "state", "robot1") / "sonar.sqlite"


async def until(fits: object) -> None:
    async with asyncio.timeout(30):
        while not fits():  # type: ignore[operator] # a plain function
            await asyncio.sleep(0.01)


def read(path: Path, query: str) -> list[tuple[object, ...]]:
    with sqlite3.connect(path) as connection:
        rows = connection.execute(query).fetchall()
    connection.close()
    return rows


def test_path_of_the_state(tmp_path: Path) -> None:
    assert str(state_dir({"HOME": "/h"})) == "/h/.local/state/rmpa"
    assert str(state_dir({"HOME": "/h", "XDG_STATE_HOME": "/x"})) == "/x/rmpa"
    assert str(state_dir({"HOME": "/h", "RMPA_STATE_DIR": "/r"})) == "/r"
    assert str(state_dir({"RMPA_STATE_DIR": "/r"}, "/s")) == "/s"
    assert state_dir({}) is None
    assert module_dir(tmp_path, "../a b") == tmp_path / "_a_b"


async def test_state_survives_and_deleted_rows_do_not(path: Path) -> None:
    store = ResourceStore(path)
    assert await store.open() == {}
    store.put(GAIN, "2.5")
    store.put(DRIVER, '"x"')
    store.put(DRIVER, None)
    await until(lambda: read(path, "SELECT value FROM state") == [("2.5",)])  # at once: a crash may come
    store.window(1, "fine", 0, "profile fine", "{}")
    store.event(2, "alarm", 1, "adaptation", "{}")
    store.descriptor("/sonar", "one", 3)
    store.descriptor("/sonar", "one", 4)
    await store.close()
    assert read(path, "SELECT at_ns, profile, level FROM windows") == [(1, "fine", 0)]
    assert read(path, "SELECT at_ns, event, message FROM events") == [(2, "alarm", "adaptation")]
    assert read(path, "SELECT node, first_ns, last_ns FROM descriptors") == [("/sonar", 3, 4)]
    again = ResourceStore(path)
    assert await again.open() == {GAIN: "2.5"}
    await again.close()


async def test_the_history_is_bounded(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(store_module._KEPT, "windows", 10)
    store = ResourceStore(path, interval=0.02)
    await store.open()
    for number in range(25):
        store.window(number, "fine", 0, "", "{}")
        if number == 12:
            await until(lambda: (12,) in read(path, "SELECT at_ns FROM windows"))
    await store.close()
    assert read(path, "SELECT at_ns FROM windows ORDER BY id") == [(number,) for number in range(15, 25)]


@pytest.mark.parametrize("damage", [b"this is no data base", b"", "middle", "newer"])
async def test_damaged_file_is_renamed(path: Path, damage: bytes | str, caplog: pytest.LogCaptureFixture) -> None:
    store = ResourceStore(path)
    await store.open()
    store.put(GAIN, "2.5")
    for number in range(500):
        store.window(number, "fine", 0, "x" * 200, "{}")
    await store.close()
    if damage == "newer":
        read(path, "PRAGMA user_version = 99")
    elif isinstance(damage, str):
        raw = bytearray(path.read_bytes())
        raw[4096:] = bytes(byte ^ 0x5A for byte in raw[4096:])
        path.write_bytes(raw)
    else:
        path.write_bytes(damage)
    again = ResourceStore(path)
    assert await again.open() == {}
    again.put(GAIN, "3")
    await again.close()
    assert read(path, "SELECT value FROM state") == [("3",)]
    if damage:  # an empty file is as good as none
        assert "is set aside as sonar.sqlite.damaged" in caplog.text
        assert path.with_name("sonar.sqlite.damaged").stat().st_size
    assert again.problem == ""


async def test_removed_file_is_written_anew(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = ResourceStore(path, interval=0.02)
    await store.open()
    store.put(GAIN, "2.5")
    await until(lambda: read(path, "SELECT value FROM state") == [("2.5",)])
    path.unlink()
    store.put(DRIVER, '"x"')
    await until(path.exists)
    await store.close()
    assert sorted(read(path, "SELECT name, value FROM state")) == [("/driver", '"x"'), ("gain", "2.5")]
    assert "was taken away" in caplog.text


async def test_full_disk_is_reported_once(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    store = ResourceStore(path, interval=0.02, bytes_max=32 * 4096)
    await store.open()
    store.put(GAIN, "2.5")
    store.put(DRIVER, f'"{"x" * 200_000}"')
    await until(lambda: store.problem)
    assert "full" in store.problem
    await asyncio.sleep(0.1)  # it is tried again, and not said again
    assert caplog.text.count("nothing is kept") == 1
    store.put(DRIVER, None)  # room again
    await until(lambda: not store.problem)
    await store.close()
    assert read(path, "SELECT name, value FROM state") == [("gain", "2.5")]
    assert "everything is kept again" in caplog.text


async def test_unusable_path_and_used_file_are_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").touch()
    nowhere = ResourceStore(tmp_path / "file" / "sonar.sqlite", interval=0.02)
    assert await nowhere.open() == {}
    nowhere.put(GAIN, "1")
    for number in range(limits.STORE_PENDING_MAX + 100):
        nowhere.window(number, "fine", 0, "", "{}")
    assert "File exists" in nowhere.problem
    await nowhere.close()
    first, second = ResourceStore(tmp_path / "s.sqlite"), ResourceStore(tmp_path / "s.sqlite", interval=0.02)
    await first.open()
    first.put(GAIN, "1")
    assert await second.open() == {}
    assert "another process uses it" in second.problem
    second.put(GAIN, "2")
    await first.close()
    await second.close()
    assert caplog.text.count("nothing is kept") == 2
