"""A core that ends and begins again, with nodes that go on, hang, end or change places meanwhile; and its file."""

from __future__ import annotations

import asyncio
import errno
import math
import os
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.config.module_name import core_file
from rmpa.core.errors import StartError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.core import state
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.core.state import StoredState, parse, serialize
from rmpa.ros.http.rpc import call, call_api
from rmpa.ros.master.parameters import RegistrationKind
from rmpa.ros.master.registrations import NodeRecord
from rmpa.ros.wire.xmlrpc import XmlRpcValue, response_pieces
from tests.ros.core.slaves import Slave
from tests.waiting import DEADLINE, until

STRING: Final = "std_msgs/String"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "core.state"


@asynccontextmanager
async def running(path: Path, **options: object) -> AsyncIterator[RosCore]:
    options.setdefault("keep", "always")
    core = RosCore(port=0, rosout=False, state=path, **options)  # type: ignore[arg-type] # the core's own
    await core.start()
    try:
        yield core
    finally:
        await core.close()


def saved(core: RosCore) -> bool:
    """Whether the file has the present state."""
    return core.stored is not None and core.stored._writer is not None and not core.stored._changed()


def content(path: Path) -> StoredState:
    return parse(path.read_bytes())


def names(core: RosCore) -> set[str]:
    return set(core.state().nodes)


async def test_running_nodes_are_restored_and_notified(path: Path) -> None:
    async with Slave("/talker") as talker, Slave("/hearer") as hearer:
        async with running(path) as core:
            await talker.publish(core, "/chatter")
            await hearer.subscribe(core, "/chatter")
            await call(core.uri, "registerService", "/talker", "/add", "rosrpc://127.0.0.1:9", talker.uri)
            await call(core.uri, "subscribeParam", "/hearer", hearer.uri, "/speed")
            await until(lambda: saved(core))
            run_id = core.call("getParam", "/x", "/run_id").value
        hearer.calls.clear()
        async with running(path) as core:
            await until(lambda: names(core) == {"/talker", "/hearer"})
            assert core.state().publishers == {"/chatter": {"/talker": talker.uri}}
            assert core.state().subscribers == {"/chatter": {"/hearer": hearer.uri}}
            assert core.state().services == {"/add": {"/talker": "rosrpc://127.0.0.1:9"}}
            assert core.state().types == {"/chatter": STRING}
            assert core.call("getParam", "/x", "/run_id").value == run_id
            await until(lambda: hearer.updates)
            assert hearer.updates[-1] == ("/chatter", [talker.uri])
            assert "2 of 2 nodes of the last run are restored" in core.restored()
            assert str(path) in core.restored()


async def test_changes_without_a_core_come_from_the_nodes_lists(path: Path) -> None:
    async with Slave("/node") as node:
        async with running(path) as core:
            await node.publish(core, "/old")
            await node.publish(core, "/stays")
            await node.subscribe(core, "/heard")
        node.publications = [["/stays", STRING], ["/new", "std_msgs/Int32"]]
        node.subscriptions = [["/heard", STRING], ["/more", STRING]]
        async with running(path) as core:
            await until(lambda: set(core.state().publishers) == {"/stays", "/new"})
            await until(lambda: set(core.state().subscribers) == {"/heard", "/more"})
            assert core.type_of("/new") == "std_msgs/Int32"


async def test_a_node_without_a_name_is_known_by_what_it_has(path: Path) -> None:
    async with Slave() as nameless, Slave() as other:
        async with running(path) as core:
            await nameless.subscribe(core, "/heard")
            await call(core.uri, "registerSubscriber", "/other", "/heard", STRING, other.uri)
        async with running(path) as core:
            assert names(core) == {"/nameless"}


async def test_our_own_nodes_are_not_stored(path: Path) -> None:
    async with Slave("/rmpa/proxy") as proxy, Slave("/user") as user:
        core = RosCore(port=0, state=path, temporary=lambda name: name.startswith("/rmpa"))
        await core.start()
        await proxy.publish(core, "/a")
        await user.publish(core, "/a")
        await core.close()
        assert list(content(path).nodes) == ["/user"]


async def test_parameters_survive_with_their_types_and_never_forgets_all(path: Path) -> None:
    value: XmlRpcValue = {"gains": [1, 2.5], "map": b"\0\1", "name": "ärm", "on": True, "none": {}}
    async with Slave("/node") as node:
        async with running(path) as core:
            await call(core.uri, "setParam", "/x", "/robot", value)
            await call(core.uri, "setParam", "/x", "/gone", 1)
            await until(lambda: saved(core))
            await call(core.uri, "deleteParam", "/x", "/gone")
            await node.publish(core, "/a")
        async with running(path) as core:
            assert (await call_api(core.uri, "getParam", "/x", "/robot")).value == value
            assert (await call_api(core.uri, "hasParam", "/x", "/gone")).value is False
            run_id = core.call("getParam", "/x", "/run_id").value
        async with running(path, keep="never") as core:
            assert (await call_api(core.uri, "hasParam", "/x", "/robot")).value is False
            assert core.call("getParam", "/x", "/run_id").value != run_id
            await asyncio.sleep(0)
            assert names(core) == set()
            assert "the core starts empty: core.keep is never" in core.restored()
            await call(core.uri, "setParam", "/x", "/after", 1)
        async with running(path) as core:
            assert (await call_api(core.uri, "hasParam", "/x", "/robot")).value is False
            assert (await call_api(core.uri, "getParam", "/x", "/after")).value == 1
            assert names(core) == set()


@pytest.mark.parametrize(
    ("left", "died", "boot", "kept"),
    [
        ("node", False, "the same", True),  # an update, Ctrl-C, systemctl restart
        ("node", False, "another", True),  # on another machine, which kept running
        ("", False, "the same", False),  # the end of a session
        ("", True, "the same", True),  # kill -9, and nodes that come again by themselves
        ("", True, "another", False),  # power off
        ("another node", False, "the same", False),  # which has that port now
    ],
)
async def test_what_was_lost_under_running_nodes_is_restored_else_the_core_begins_empty(
    path: Path, left: str, died: bool, boot: str, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    boot_id = path.parent.parent / "boot_id"
    boot_id.write_text("the same\n")
    monkeypatch.setattr(state, "_BOOT_ID", boot_id)
    async with Slave("/node") as node:
        async with running(path, keep="auto") as core:
            await node.publish(core, "/a")
            core.call("setParam", "/x", "/robot/speed", 1)
            run_id = core.call("getParam", "/x", "/run_id").value
            await until(lambda: saved(core))
            running_yet = path.read_bytes()
        if died:
            path.write_bytes(running_yet)
        boot_id.write_text(f"{boot}\n")
        node.name = {"node": "/node", "another node": "/other"}.get(left, "/node")
        if not left:
            await node.server.close()
        for again in (1, 2):  # what the core decided at its start holds for the next one too
            async with running(path, keep="auto") as core:
                assert core.call("hasParam", "/x", "/robot").value is kept
                assert (core.call("getParam", "/x", "/run_id").value == run_id) is kept
                assert ("the core starts empty: no node of the run before is left" in core.restored()) is (
                    not kept and again == 1
                )
                if left == "node":
                    await until(lambda: "/node" in names(core))
            if not left:
                break


@pytest.mark.parametrize("left", [True, False])
async def test_simulated_time_survives_only_with_a_node_of_it(
    path: Path, left: bool, caplog: pytest.LogCaptureFixture
) -> None:
    async with Slave("/stays") as stays:
        async with Slave("/simulator") as simulator, running(path) as core:
            await simulator.publish(core, "/clock")
            if left:
                await stays.subscribe(core, "/clock")
            core.call("setParam", "/simulator", "/use_sim_time", True)
            core.call("setParam", "/simulator", "/other", 1)
        async with running(path) as core:
            assert core.call("hasParam", "/x", "/use_sim_time").value is left
            assert core.call("hasParam", "/x", "/other").value is True
            assert ("/use_sim_time of the run before is not restored" in caplog.text) is not left
        async with running(path) as core:
            assert core.call("hasParam", "/x", "/use_sim_time").value is left


async def test_the_file_is_for_its_user_alone(path: Path) -> None:
    async with running(path) as core:
        await until(lambda: saved(core))
        found = {entry.name: entry.stat().st_mode & 0o777 for entry in path.parent.iterdir()}
        assert found
        assert set(found.values()) == {0o600}
        assert path.parent.stat().st_mode & 0o777 == 0o700


async def test_unusable_place_is_reported_and_used_when_usable(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("rmpa.ros.core.state.CORE_STATE_RETRY", 0.05)
    path.parent.write_text("a file in the directory's place")
    async with running(path) as core:
        core.call("setParam", "/x", "/a", 1)
        await until(core.notes)
        (note,) = core.notes()
        assert "the core keeps nothing when it restarts" in note
        assert "set RMPA_STATE_DIR" in note
        assert "nothing is kept" in core.restored()
        assert caplog.text.count("the core keeps nothing") == 1
        path.parent.unlink()
        await until(lambda: not core.notes())
    async with running(path) as core:
        assert core.call("getParam", "/x", "/a").value == 1


async def test_a_node_that_answers_with_an_error_keeps_what_it_had(path: Path) -> None:
    async with Slave("/odd") as odd:
        async with running(path) as core:
            await odd.publish(core, "/t")
            await until(lambda: saved(core))
        odd.error = True
        async with running(path) as core:
            await until(lambda: names(core) == {"/odd"})
            assert odd.lists
            core.call("setParam", "/x", "/a", 1)
            await until(lambda: saved(core))
            assert core.state().publishers == {"/t": {"/odd": odd.uri}}


async def test_hanging_node_delays_the_start_by_the_bound_and_is_registered_when_it_answers(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "CORE_STATE_ASK", 0.2)
    monkeypatch.setattr(limits, "SLAVE_CALL_TIMEOUT", DEADLINE)
    async with Slave("/hangs") as hangs, Slave("/answers") as answers, Slave("/hearer") as hearer:
        async with running(path) as core:
            await hangs.publish(core, "/a")
            await answers.publish(core, "/a")
            await hearer.subscribe(core, "/a")
        hangs.go.clear()
        hearer.calls.clear()
        async with running(path) as core:
            assert names(core) == {"/answers", "/hearer"}
            assert core.restored().endswith("2 of 3 nodes of the last run are restored, /hangs did not answer")
            await until(lambda: hearer.updates)
            assert hearer.updates[-1] == ("/a", [answers.uri])
            hangs.go.set()
            await until(lambda: hearer.updates[-1] == ("/a", [answers.uri, hangs.uri]))
            assert names(core) == {"/answers", "/hearer", "/hangs"}
            assert "3 of 3" in core.restored()
            assert core.notes() == ()


async def test_a_node_that_never_answers_is_named(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "CORE_STATE_ASK", 0.05)
    monkeypatch.setattr(state, "call_api", None)
    monkeypatch.setattr(state, "name_at", _unreachable)
    async with Slave("/hangs") as hangs:
        async with running(path) as core:
            await hangs.publish(core, "/a")
            core.call("setParam", "/x", "/robot", 1)
        async with running(path, keep="auto") as core:
            assert core.notes() == (
                f"/hangs at {hangs.uri}, of the run before, does not answer and is not shown: start it again",
            )
            assert core.call("hasParam", "/x", "/robot").value is True, "it may be running"
            await hangs.publish(core, "/a")
            assert core.notes() == ()


async def _unreachable(api: str, _topics: object) -> str | None:
    raise UnreachableError("node", api)


async def test_new_registration_wins_over_the_stored_one(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "CORE_STATE_ASK", 0.05)
    async with Slave("/talker") as old, Slave("/talker") as new:
        async with running(path) as core:
            await old.publish(core, "/a")
        old.go.clear()
        async with running(path) as core:
            await new.publish(core, "/b")
            old.go.set()
            assert core.stored is not None
            late = core.stored._asking
            await until(lambda: not late)
            assert core.state().nodes == {"/talker": new.uri}
            assert core.state().publishers == {"/b": {"/talker": new.uri}}


@pytest.mark.parametrize("why", ["large", "full", "read-only"])
async def test_what_cannot_be_written_is_reported_and_nothing_is_lost(
    path: Path, why: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("rmpa.ros.core.state.CORE_STATE_RETRY", 0.05)
    async with running(path) as core:
        core.call("setParam", "/x", "/before", 1)
        await until(lambda: saved(core))
        with monkeypatch.context() as broken:
            if why == "large":
                broken.setattr(limits, "CORE_STATE_BYTES", 20)
            else:
                broken.setattr(os, "fsync", _failing(errno.ENOSPC if why == "full" else errno.EROFS))
            core.call("setParam", "/x", "/meanwhile", 2)
            wanted = {"large": "has at most 20", "full": "make room on that disk", "read-only": "set RMPA_STATE_DIR"}
            await until(lambda: any(wanted[why] in note for note in core.notes()))
            assert core.restored() == "nothing is kept"
            assert "meanwhile" not in content(path).params
        await until(lambda: not core.notes())
        assert caplog.text.count("the core keeps nothing") == 1
    async with running(path) as core:
        assert [core.call("getParam", "/x", key).value for key in ("/before", "/meanwhile")] == [1, 2]


def _failing(code: int) -> Callable[[int], None]:
    def fail(_: int) -> None:
        raise OSError(code, os.strerror(code))

    return fail


async def test_a_disk_that_hangs_is_reported_and_keeps_no_core_from_its_start_or_end(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("CORE_STATE_OPEN", "CORE_STATE_WRITE", "CORE_STATE_CLOSE"):
        monkeypatch.setattr(limits, name, 0.05)
    go = threading.Event()
    path.parent.mkdir()
    monkeypatch.setattr(state.CoreState, "_read", lambda _: go.wait(DEADLINE))
    monkeypatch.setattr(state.CoreState, "_put", lambda *_: go.wait(DEADLINE))
    try:
        async with running(path) as core:
            assert any("the disk does not answer" in note for note in core.notes())
            assert core.stored is not None
            core.stored._problem = ""
            await until(lambda: any("the disk does not answer" in note for note in core.notes()))
    finally:
        go.set()


async def test_a_core_whose_port_is_taken_leaves_the_file_alone(path: Path) -> None:
    async with running(path) as one:
        one.call("setParam", "/x", "/a", 1)
        await until(lambda: saved(one))
        before = path.read_bytes()
        other = RosCore(port=one.port, rosout=False, state=path, keep="never")
        with pytest.raises(StartError):
            await other.start()
        assert path.read_bytes() == before


def state_of(**parts: Any) -> bytes:
    return msgspec.msgpack.encode({"format": "rmpa core 2", **parts})


def lists(depth: int) -> list[Any]:
    """A list in a list, so many deep."""
    value: list[Any] = []
    for _ in range(depth - 1):
        value = [value]
    return value


def nested(depth: int) -> dict[str, Any]:
    return {"a": nested(depth - 1)} if depth else {}


@pytest.mark.parametrize(
    "data",
    [
        b"SQLite format 3\0" * 100, b"", state_of(params={"a": "b" * 20_000})[:-1], state_of(format="rmpa core 1"),
        msgspec.msgpack.encode({"nodes": {}}), state_of(nodes={"/talker": {"api": "rosrpc://h:1"}}),
        state_of(nodes={"talker": {"api": "http://h:1"}}),
        state_of(nodes={"/t": {"api": "http://h:1", "entries": [["publisher", "t", "*"]]}}),
        state_of(nodes={"/t": {"api": "http://h:1", "entries": [["publisher", "/t", "a\0b"]]}}),
        state_of(params={"a": 1 << 40}), state_of(params={"a": None}), state_of(params={"a": "\x1b"}),
        state_of(params={"a": {1: 2}}), state_of(params={"a": msgspec.msgpack.Ext(5, b"")}),
        state_of(params=nested(limits.CORE_STATE_DEPTH_MAX)),
        state_of(params={"a": lists(limits.CORE_STATE_DEPTH_MAX)}), b"\x91" * 100_000,
    ],
    ids=lambda data: f"{data[:30]!r}"[:40],
)  # fmt: skip
def test_what_no_core_has_written_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"\S"):
        parse(data)


async def test_a_file_that_cannot_be_read_is_set_aside(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    data = b"SQLite format 3\0" * 100
    path.parent.mkdir()
    path.write_bytes(data)
    async with running(path) as core:
        assert caplog.text.count("the core starts empty") == 1
        core.call("setParam", "/x", "/c", 1)
        assert core.call("getParam", "/x", "/").code == 1
    assert path.with_name("core.state.before").read_bytes() == data
    async with running(path) as core:
        assert core.call("hasParam", "/x", "/c").value is True
    path.write_bytes(b"another")
    async with running(path) as core:
        core.call("setParam", "/x", "/c", 1)
    assert "is kept as core.state.before-2" in caplog.text
    assert path.with_name("core.state.before").read_bytes() == data
    assert path.with_name("core.state.before-2").read_bytes() == b"another"


async def test_a_larger_file_than_a_core_writes_is_not_read(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path.parent.mkdir()
    path.write_bytes(state_of(params={"a": "b" * 20_000}))
    monkeypatch.setattr(limits, "CORE_STATE_BYTES", 10_000)
    async with running(path) as core:
        assert core.call("hasParam", "/x", "/a").value is False


async def test_what_setparam_takes_at_its_bounds_survives(path: Path) -> None:
    deep = nested(80)
    key = "/k" * limits.PARAM_DEPTH_MAX
    async with running(path) as core:
        assert (await call_api(core.uri, "setParam", "/x", key, deep)).code == 1
    async with running(path) as core:
        assert (await call_api(core.uri, "getParam", "/x", key)).value == deep
        assert list(response_pieces(list(core.call("getParam", "/x", "/"))))


texts = st.text(st.characters(exclude_categories=["Cs", "Cc"], exclude_characters="\ufffe\uffff"), max_size=20)
scalars = (
    st.booleans()
    | st.integers(-(1 << 31), (1 << 31) - 1)
    | st.floats(allow_nan=False)
    | texts
    | st.binary(max_size=20)
    | st.datetimes(datetime(1970, 1, 1), datetime(2100, 1, 1))  # noqa: DTZ001 - XML-RPC's have no zone
)
values = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(texts, values, max_size=3))
def test_each_value_of_ros_comes_back_as_it_was(tree: dict[str, Any]) -> None:
    entries = [
        (RegistrationKind.PUBLISHER, "/t", STRING),
        (RegistrationKind.SERVICE, "/s", "rosrpc://h:2"),
        (RegistrationKind.PARAM, "/p/", ""),
    ]
    node = NodeRecord("http://h:1/", entries)
    stored = StoredState("rmpa core 2", "boot", {"/talker": node}, tree)
    assert parse(serialize(stored)) == stored
    assert math.isnan(parse(serialize(StoredState("rmpa core 2", params={"a": math.nan}))).params["a"])


def test_where_a_core_keeps(tmp_path: Path) -> None:
    home = {"HOME": "/h"}
    assert str(core_file(home, 11311, "base")) == "/h/.local/state/rmpa/base/core-11311.state"
    assert str(core_file(home, 11311)) == "/h/.local/state/rmpa/core-11311.state"
    assert str(core_file(home, 11311, "base", "/s")) == "/s/base/core-11311.state"
    unit = {"HOME": "/", "STATE_DIRECTORY": "/var/lib/rmpa:/var/lib/more"}
    assert str(core_file(unit, 11311, "base")) == "/var/lib/rmpa/base/core-11311.state"
    assert core_file(home, 0, "base") is None
    assert core_file({}, 11311, "base") is None
