"""Recordings of all modules: what is asked of the recorder, and what others may have, read and remove."""

from __future__ import annotations

import asyncio
import base64
import os
import time
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from rmpa.bridge.kept import KEPT, REQUESTS, Kept, end_request, read_requests, write_kept
from rmpa.bridge.recordings import KEEP, LIST, READ, REMOVE, Recordings
from rmpa.config.peer_rules import PermissionRule
from rmpa.config.settings import Settings
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from tests.bridge.asked_module import AskedModule

NOW = 1_800_000_000 * 10**9


class World(AskedModule):
    """One module with a recorder's folder, and a peer."""

    def __init__(self, state: Path, *rules: PermissionRule, secured: bool = False, folder: bool = True) -> None:
        super().__init__(Settings(name="arm", state_dir=str(state)), *rules, secured=secured)
        self.folder = state / "arm" / "record"
        if folder:
            for name in (KEPT, REQUESTS):
                (self.folder / name).mkdir(parents=True)
        self.base = self.peer("base")
        self.part = Recordings(self.bridge)

    async def asks(self, what: str, **args: Any) -> Any:
        """What the peer is answered."""
        handler: Any = self.handlers[what]
        return await handler(self.base, args)

    async def requests(self) -> list[Kept]:
        """What the recorder is asked to keep."""
        return await asyncio.to_thread(self._requests)

    def _requests(self) -> list[Kept]:
        found = list(read_requests(self.folder))
        for one in found:
            end_request(self.folder, one)
        return found

    async def record(self, name: str, data: bytes = b"x" * 10) -> None:
        """Put a recording there."""
        await asyncio.to_thread(self._write, name, data)

    def _write(self, name: str, data: bytes) -> None:
        place = self.folder / KEPT / name
        place.mkdir()
        (place / "1.mcap").write_bytes(data)
        write_kept(place, Kept(id=name, why="a test"))


async def test_all_modules_keep_and_those_that_were_away_do_it_when_they_are_back(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.peer("base", UnreachableError("agent", "base", "try again"))
    first = await world.part.answer({"what": "keep", "why": "It fell!", "seconds": 30})
    assert first["arm"] == ""
    assert "base" in first["base"]
    (kept,) = await world.requests()
    assert kept.id.endswith("-arm-it_fell")
    assert (kept.why, kept.by_hand, kept.until - kept.since) == ("It fell!", True, 30 * 10**9)
    world.base, world.asked = world.peer("base"), []
    world.part.link_up(world.base)
    while not world.asked:
        await asyncio.sleep(0)
    assert msgspec.convert(world.asked[0][1]["kept"], Kept) == kept
    world.asked.clear()
    world.part.link_up(world.base)
    await world.part.close()
    assert not world.asked, "it has answered"


async def test_only_the_modules_that_are_named_keep_and_no_others_later(tmp_path: Path) -> None:
    world = World(tmp_path)
    assert await world.part.answer({"what": "keep", "modules": ["base"]}) == {"base": ""}
    assert not await world.requests()
    world.asked.clear()
    assert await world.part.answer({"what": "keep", "modules": ["arm"]}) == {"arm": ""}
    world.part.link_up(world.base)
    await world.part.close()
    assert (len(await world.requests()), world.asked) == (1, [])


async def test_a_peers_times_are_put_on_this_clock(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.base.time = SimpleNamespace(ahead_ns=5 * 10**9)
    kept = Kept(id="fall", why="it fell", since=NOW, until=NOW + 10**9)
    assert await world.asks(KEEP, kept=msgspec.to_builtins(kept)) == ""
    (found,) = await world.requests()
    assert (found.since, found.until, found.asked_by) == (NOW - 5 * 10**9, NOW - 4 * 10**9, "base")


async def test_how_long_ago_counts_when_clocks_were_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world, hour, now = World(tmp_path), 3600 * 10**9, time.time_ns()
    world.peer("base", UnreachableError("agent", "base", "try again"))
    asked = Kept(id="fall", why="it fell", since=now - 60 * 10**9, until=now)
    await world.part.keep(asked)
    world.base, world.asked, wall = world.peer("base"), [], time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: wall() + hour)  # this module's clock, while the peer was away
    world.part.link_up(world.base)
    while not world.asked:
        await asyncio.sleep(0)
    await world.part.close()
    sent = world.asked[0][1]
    assert sent["now"] - now < 60 * 10**9, "by the clock as it was"
    await world.requests()
    world.base.time = SimpleNamespace(ahead_ns=-hour)  # as the peer still knew it
    assert await world.asks(KEEP, **sent) == ""
    (found,) = await world.requests()
    assert abs(found.until - (now + hour)) < 60 * 10**9
    assert found.until - found.since == 60 * 10**9


async def test_a_recorder_that_cannot_write_its_status_is_said(tmp_path: Path) -> None:
    world = World(tmp_path)
    status = {"pid": os.getpid(), "at": time.time() - 60.0}
    await asyncio.to_thread((world.folder / "status.json").write_bytes, msgspec.json.encode(status))
    (told,) = [one for one in await world.part.list() if one.module == "arm"]
    assert "wrote its status 60 s ago" in told.problem


async def test_without_a_recorder_it_says_so(tmp_path: Path) -> None:
    world = World(tmp_path, folder=False)
    assert "no recorder has run here" in (await world.part.answer({"what": "keep"}))["arm"]
    assert (await world.part.list())[0].kept == ()


async def test_a_file_is_read_in_parts_and_nothing_beside_it(tmp_path: Path) -> None:
    world = World(tmp_path)
    data = bytes(range(256)) * 2000
    await world.record("fall", data)
    await asyncio.to_thread((world.folder / "secret").write_text, "x")
    found = b""
    while len(found) < len(data):
        part = await world.asks(READ, id="fall", file="1.mcap", offset=len(found))
        assert part.size == len(data)
        found += base64.b64decode(part.data)
    assert found == data
    part = await world.asks(READ, id="fall", file="1.mcap", offset=1000, size=20, check=True)
    assert (base64.b64decode(part.data), part.before) == (data[1000:1020], zlib.crc32(data[:1000]))
    assert (await world.asks(READ, id="fall", file="1.mcap", offset=10**7, check=True)).before == zlib.crc32(data)
    for name, file in (("fall", "../../secret"), ("fall", "recording.json"), ("..", "secret"), ("none", "1.mcap")):
        with pytest.raises(RmpaError, match=r"no file|no recording|not the name"):
            await world.asks(READ, id=name, file=file, offset=0)
    with pytest.raises(RmpaError, match="no file"):
        await world.asks(READ, id="fall", file="1.mcap", offset=-1)


async def test_a_member_without_record_keeps_lists_reads_and_removes_nothing(tmp_path: Path) -> None:
    world = World(tmp_path, secured=True)
    await world.record("fall")
    kept = msgspec.to_builtins(Kept(id="other", since=0, until=1))
    requests: tuple[tuple[str, dict[str, Any]], ...] = (
        (KEEP, {"kept": kept}),
        (READ, {"id": "fall", "file": "1.mcap"}),
        (REMOVE, {"id": "fall"}),
        (LIST, {}),
    )
    for what, args in requests:
        with pytest.raises(RmpaError, match="let base use the recording"):
            await world.asks(what, **args)
    assert not await world.requests()
    assert [one.id for one in (await world.part.list())[0].kept] == ["fall"]


async def test_a_rule_lets_a_module_have_some(tmp_path: Path) -> None:
    rule = PermissionRule(("base",), names={"record": ("/fall*",)})
    world = World(tmp_path, rule, secured=True)
    await world.record("fall")
    await world.record("private")
    assert [one.id for one in (await world.asks(LIST)).kept] == ["fall"]
    assert (await world.asks(REMOVE, id="fall")).id == "fall"
    with pytest.raises(RmpaError, match="let base use the recording"):
        await world.asks(REMOVE, id="private")


async def test_an_earlier_release_is_named(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.peer("base", PeerRefused("base", "this agent does not know the question 'record.keep'"))
    answers = await world.part.answer({"what": "keep"})
    assert answers["base"]
