"""A core that ends and begins again, with nodes that go on, hang, end or change places meanwhile."""

from __future__ import annotations

import asyncio
import sqlite3
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Final, Self
from unittest.mock import AsyncMock

import pytest

from rmpa.config.state_dir import core_file
from rmpa.ros import limits
from rmpa.ros.core import persistence, store
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.core.store import CoreStore
from rmpa.ros.http.client import call, call_api
from rmpa.ros.http.server import XmlRpcServer
from rmpa.ros.wire.xmlrpc import RosFault, XmlRpcValue

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

DEADLINE: Final = 20.0
STRING: Final = "std_msgs/String"


class Slave:
    """A node's slave API as rospy has it; without a name as a roscpp node that publishes nothing has it."""

    def __init__(self, name: str = "") -> None:
        self.name = name
        self.publications: list[list[str]] = []
        self.subscriptions: list[list[str]] = []
        self.updates: list[tuple[str, list[str]]] = []
        self.asked = 0
        self.lists = 0
        self.error = False
        """Whether it refuses to say what it has, as a client library without these methods."""
        self.go = asyncio.Event()
        self.go.set()
        self.server = XmlRpcServer(self._answer)

    async def __aenter__(self) -> Self:
        await self.server.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        self.go.set()
        await self.server.close()

    @property
    def uri(self) -> str:
        return f"http://127.0.0.1:{self.server.port}/"

    async def _answer(self, method: str, params: tuple[XmlRpcValue, ...], _client: str) -> XmlRpcValue:
        self.asked += 1
        await self.go.wait()
        match method, params:
            case "getName", _ if self.name:
                return [1, "", self.name]
            case (("getPublications" | "getSubscriptions"), _) if self.error:
                self.lists += 1
                return [-1, "not implemented", []]
            case "getPublications", _:
                return [1, "", self.publications]
            case "getSubscriptions", _:
                return [1, "", self.subscriptions]
            case "publisherUpdate", (_, str(topic), list(publishers)):
                self.updates.append((topic, [str(uri) for uri in publishers]))
                return [1, "", 0]
        raise RosFault(-1, f"{method}: unknown method name")

    async def publish(self, core: RosCore, topic: str) -> None:
        self.publications.append([topic, STRING])
        await call(core.uri, "registerPublisher", self.name or "/nameless", topic, STRING, self.uri)

    async def subscribe(self, core: RosCore, topic: str) -> None:
        self.subscriptions.append([topic, STRING])
        await call(core.uri, "registerSubscriber", self.name or "/nameless", topic, STRING, self.uri)


async def until(wanted: Callable[[], object]) -> None:
    async with asyncio.timeout(DEADLINE):
        while not wanted():
            await asyncio.sleep(0.005)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "core.sqlite"


@asynccontextmanager
async def running(path: Path, **options: object) -> AsyncIterator[RosCore]:
    options.setdefault("keep", "always")
    core = RosCore(port=0, rosout=False, state=path, **options)  # type: ignore[arg-type] # the core's own
    await core.start()
    try:
        yield core
    finally:
        await core.close()


def names(core: RosCore) -> set[str]:
    return set(core.state().nodes)


def rows(path: Path) -> list[tuple[str, str]]:
    with sqlite3.connect(f"file:{path}?mode=ro", uri=True) as connection:
        found: list[tuple[str, str]] = connection.execute(
            "SELECT kind, name FROM kept ORDER BY kind, name"
        ).fetchall()
    connection.close()
    return found


async def all_asked(core: RosCore) -> None:
    assert core.persistence is not None
    memory = core.persistence
    await until(lambda: memory.verification.all_asked)


async def test_running_nodes_are_restored_and_notified(path: Path) -> None:
    async with Slave("/talker") as talker, Slave("/hearer") as hearer:
        async with running(path) as core:
            await talker.publish(core, "/chatter")
            await hearer.subscribe(core, "/chatter")
            await call(core.uri, "registerService", "/talker", "/add", "rosrpc://127.0.0.1:9", talker.uri)
            await call(core.uri, "subscribeParam", "/hearer", hearer.uri, "/speed")
            await until(lambda: core.counters["kept.written"])
            run_id = core.call("getParam", "/x", "/run_id").value
        hearer.updates.clear()
        async with running(path) as core:
            await until(lambda: names(core) == {"/talker", "/hearer"})
            assert core.state().publishers == {"/chatter": {"/talker": talker.uri}}
            assert core.state().subscribers == {"/chatter": {"/hearer": hearer.uri}}
            assert core.state().services == {"/add": {"/talker": "rosrpc://127.0.0.1:9"}}
            assert core.state().types == {"/chatter": STRING}
            assert core.call("getParam", "/x", "/run_id").value == run_id
            await until(lambda: hearer.updates)
            assert hearer.updates[-1] == ("/chatter", [talker.uri])
            assert "2 of 2 nodes of the run before are taken up" in core.restored()
            assert str(path) in core.restored()


async def test_who_is_gone_or_has_another_name_is_not_shown(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async with Slave("/moved") as moved:
        async with Slave("/dead") as dead, running(path) as core:
            await moved.publish(core, "/a")
            await dead.publish(core, "/b")
        moved.name = "/stranger"
        caplog.set_level("INFO")
        async with running(path) as core:
            await all_asked(core)
            assert core.state().publishers == {}
            assert core.restored().endswith("0 of 2 nodes of the run before are taken up, 2 are gone")
            assert "node /moved" in caplog.text
            assert "another node is there" in caplog.text
            await until(lambda: core.counters["kept.written"])
        assert not [name for kind, name in rows(path) if kind == "node"]


async def test_hanging_node_delays_no_other_and_is_restored_later(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "VERIFY_AT_ONCE", 1)
    monkeypatch.setattr(limits, "VERIFY_PROMPT", 0.01)
    monkeypatch.setattr(limits, "SLAVE_CALL_TIMEOUT", 0.3)
    async with Slave("/hangs") as hangs, Slave("/answers") as answers, Slave("/hearer") as hearer:
        async with running(path) as core:
            await hangs.publish(core, "/a")
            await answers.publish(core, "/a")
            await hearer.subscribe(core, "/a")
        hangs.go.clear()
        hearer.updates.clear()
        async with running(path) as core:
            await until(lambda: names(core) == {"/answers", "/hearer"})
            assert dict(core.unverified("/a")) == {"/hangs": hangs.uri}
            await until(lambda: hearer.updates)
            # It may be connected to the one that hangs: roscpp would hang up on who is not named.
            assert set(hearer.updates[-1][1]) == {answers.uri, hangs.uri}
            await all_asked(core)
            await until(lambda: any("/hangs at" in note and "does not answer" in note for note in core.notes()))
            hangs.go.set()
            await until(lambda: "/hangs" in names(core))
            assert core.notes() == ()


async def test_a_node_that_never_answers_is_given_up(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "VERIFY_PATIENCE", 0.1)
    monkeypatch.setattr(limits, "SLAVE_CALL_TIMEOUT", 0.1)
    async with Slave("/hangs") as hangs:
        async with running(path) as core:
            await hangs.publish(core, "/a")
        hangs.go.clear()
        async with running(path) as core:
            await until(lambda: "did not answer for" in core.restored())
            assert core.notes() == ()
            await until(lambda: ("node", "/hangs") not in core_rows(core))


def core_rows(core: RosCore) -> set[tuple[str, str]]:
    assert core.persistence is not None
    return set(core.persistence._writer._known)


async def test_hanging_node_stays_stored_over_a_second_restart(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SLAVE_CALL_TIMEOUT", 0.1)
    async with Slave("/hangs") as hangs:
        async with running(path) as core:
            await hangs.publish(core, "/a")
        hangs.go.clear()
        async with running(path) as core:
            await all_asked(core)
        hangs.go.set()
        async with running(path) as core:
            await until(lambda: core.state().publishers == {"/a": {"/hangs": hangs.uri}})


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
            await all_asked(core)
            assert names(core) == {"/nameless"}


async def test_new_registration_wins_over_the_stored_one(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SLAVE_CALL_TIMEOUT", 0.5)
    async with Slave("/talker") as old, Slave("/talker") as new:
        async with running(path) as core:
            await old.publish(core, "/a")
        old.go.clear()
        async with running(path) as core:
            await new.publish(core, "/b")
            old.go.set()
            await all_asked(core)
            assert core.state().nodes == {"/talker": new.uri}
            assert core.state().publishers == {"/b": {"/talker": new.uri}}


async def test_our_own_nodes_are_not_stored(path: Path) -> None:
    async with Slave("/rmpa/proxy") as proxy, Slave("/user") as user:
        core = RosCore(port=0, state=path, temporary=lambda name: name.startswith("/rmpa"))
        await core.start()
        await proxy.publish(core, "/a")
        await user.publish(core, "/a")
        await core.close()
        assert [name for kind, name in rows(path) if kind == "node"] == ["/user"]


async def test_parameters_survive_with_their_types_and_never_forgets_all(path: Path) -> None:
    value: XmlRpcValue = {"gains": [1, 2.5], "map": b"\0\1", "name": "ärm", "on": True, "none": {}}
    async with Slave("/node") as node:
        async with running(path) as core:
            await call(core.uri, "setParam", "/x", "/robot", value)
            await call(core.uri, "setParam", "/x", "/gone", 1)
            await until(lambda: core.counters["kept.written"])
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
            assert "the core begins empty: core.keep is never" in core.restored()
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
    monkeypatch.setattr(persistence, "_BOOT_ID", boot_id)
    async with Slave("/node") as node:
        async with running(path, keep="auto") as core:
            await node.publish(core, "/a")
            core.call("setParam", "/x", "/robot/speed", 1)
            run_id = core.call("getParam", "/x", "/run_id").value
            assert core.persistence is not None
            writer = core.persistence._writer
            await until(lambda: writer._tree is core._api.parameters.tree and "/node" in writer._revisions)
            if died:
                monkeypatch.setattr(writer, "_write", AsyncMock(return_value=True))
        boot_id.write_text(f"{boot}\n")
        node.name = {"node": "/node", "another node": "/other"}.get(left, "/node")
        if not left:
            await node.server.close()
        for again in (1, 2):  # what the core decided at its start holds for the next one too
            async with running(path, keep="auto") as core:
                assert core.call("hasParam", "/x", "/robot").value is kept
                assert (core.call("getParam", "/x", "/run_id").value == run_id) is kept
                assert ("the core begins empty: no node of the run before is left" in core.restored()) is (
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
            assert ("/use_sim_time of the run before is not taken up" in caplog.text) is not left
        async with running(path) as core:
            assert core.call("hasParam", "/x", "/use_sim_time").value is left


async def test_a_graph_that_does_not_change_writes_nothing(path: Path) -> None:
    async with Slave("/node") as node, running(path) as core:
        await node.publish(core, "/a")
        await until(lambda: core.counters["kept.written"] == 1)
        for _ in range(3):
            await call(core.uri, "registerPublisher", "/node", "/a", STRING, node.uri)
            await call(core.uri, "getSystemState", "/x")
            core.call("setParam", "/x", "/run_id", core.call("getParam", "/x", "/run_id").value)
        await asyncio.sleep(2 * limits.CORE_STATE_GATHER)
        assert core.counters["kept.written"] == 1


async def test_churn_is_gathered(path: Path) -> None:
    async with running(path) as core:
        began = asyncio.get_running_loop().time()
        for number in range(300):
            await call(core.uri, "registerPublisher", "/node", f"/t{number}", STRING, "http://127.0.0.1:1/")
        took = asyncio.get_running_loop().time() - began
        assert core.counters["kept.written"] <= 2 + took / limits.CORE_STATE_GATHER


async def test_what_does_not_fit_is_reported_and_the_rest_stored(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(limits, "CORE_STATE_BYTES", 20_000)
    async with running(path) as core:
        core.call("setParam", "/x", "/small", 1)
        core.call("setParam", "/x", "/large", "x" * 30_000)
        await until(lambda: core.counters["kept.unfit"])
        await until(lambda: core.counters["kept.written"])
        (note,) = core.notes()
        assert "not kept over a restart of the core" in note
        assert "large" in note
        assert caplog.text.count("is not kept over a restart") == 1
        core.call("setParam", "/x", "/large", "short")
        await until(lambda: not core.notes())
    async with running(path) as core:
        assert core.call("getParam", "/x", "/large").value == "short"


@pytest.mark.parametrize("damage", [b"this is no data base" * 100, "middle", "newer", "foreign", "kind"])
async def test_a_file_that_cannot_be_read_is_set_aside(
    path: Path, damage: bytes | str, caplog: pytest.LogCaptureFixture
) -> None:
    async with running(path) as core:
        core.call("setParam", "/x", "/a", "b" * 20_000)
    _harm(path, damage)
    async with running(path) as core:
        assert core.call("hasParam", "/x", "/a").value is False
        assert "the core begins empty" in caplog.text
        assert path.with_name("core.sqlite.damaged").exists()
        core.call("setParam", "/x", "/c", 1)
    async with running(path) as core:
        assert core.call("hasParam", "/x", "/c").value is True


def _harm(path: Path, damage: bytes | str) -> None:
    if isinstance(damage, bytes):
        path.write_bytes(damage)
    elif damage == "middle":
        content = bytearray(path.read_bytes())
        content[4096:] = b"\x55" * (len(content) - 4096)
        path.write_bytes(content)
    else:
        connection = sqlite3.connect(path)
        statement = {
            "newer": "PRAGMA user_version = 99",
            "foreign": "PRAGMA application_id = 7",
            "kind": "INSERT INTO kept VALUES ('param', 'x', 'text instead of bytes')",
        }[damage]
        connection.execute(statement)
        connection.commit()
        connection.close()


async def test_an_empty_file_is_a_new_one(path: Path) -> None:
    path.parent.mkdir()
    path.touch()
    async with running(path) as core:
        assert core.notes() == ()


async def test_the_file_is_for_its_user_alone(path: Path) -> None:
    async with running(path) as core:
        await until(lambda: core.counters["kept.written"])
        found = {entry.name: entry.stat().st_mode & 0o777 for entry in path.parent.iterdir()}
        assert found
        assert set(found.values()) == {0o600}
        assert path.parent.stat().st_mode & 0o777 == 0o700


async def test_unusable_place_is_reported_and_used_when_usable(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(limits, "CORE_STATE_RETRY", 0.05)
    path.parent.write_text("a file in the directory's place")
    async with running(path) as core:
        core.call("setParam", "/x", "/a", 1)
        (note,) = core.notes()
        assert "nothing of the core is kept over a restart" in note
        assert "set RMPA_STATE_DIR" in note
        assert "nothing is kept" in core.restored()
        await until(lambda: core.counters["kept.failed"] > 1)
        assert caplog.text.count("nothing of the core is kept") == 1
        path.parent.unlink()
        await until(lambda: not core.notes())
    async with running(path) as core:
        assert core.call("getParam", "/x", "/a").value == 1


async def test_full_disk_is_reported_and_nothing_is_lost(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "CORE_STATE_RETRY", 0.05)
    async with running(path) as core:
        core.call("setParam", "/x", "/before", 1)
        await until(lambda: core.counters["kept.written"])
        write = CoreStore._write

        def full(*_: object, **__: object) -> None:
            error = sqlite3.OperationalError("database or disk is full")
            error.sqlite_errorcode = sqlite3.SQLITE_FULL
            raise error

        monkeypatch.setattr(CoreStore, "_write", full)
        core.call("setParam", "/x", "/meanwhile", 2)
        await until(lambda: any("make room on that disk" in note for note in core.notes()))
        monkeypatch.setattr(CoreStore, "_write", write)
        await until(lambda: not core.notes())
    async with running(path) as core:
        assert [core.call("getParam", "/x", key).value for key in ("/before", "/meanwhile")] == [1, 2]


async def test_removed_file_is_written_again(path: Path) -> None:
    async with running(path) as core:
        core.call("setParam", "/x", "/before", 1)
        await until(lambda: core.counters["kept.written"])
        for entry in list(path.parent.iterdir()):
            entry.unlink()
        core.call("setParam", "/x", "/after", 2)
        await until(lambda: core.counters["kept.written"] > 1)
    async with running(path) as core:
        assert [core.call("getParam", "/x", key).value for key in ("/before", "/after")] == [1, 2]


async def test_two_cores_do_not_share_a_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "CORE_STATE_LOCKED", 0.05)
    async with running(path) as one:
        one.call("setParam", "/x", "/a", 1)
        async with running(path) as other:
            assert other.call("hasParam", "/x", "/a").value is False
            assert any("another process uses it" in note for note in other.notes())
    async with running(path) as core:
        assert core.call("getParam", "/x", "/a").value == 1


async def test_a_file_that_was_locked_for_a_moment_is_read(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "CORE_STATE_LOCKED", 0.05)
    async with running(path) as one:
        one.call("setParam", "/x", "/a", 1)
    opens, errors = CoreStore._open, [sqlite3.OperationalError("database is locked") for _ in range(2)]

    def locked(store: CoreStore) -> object:
        if errors:
            error = errors.pop()
            error.sqlite_errorcode = sqlite3.SQLITE_BUSY
            raise error
        return opens(store)

    monkeypatch.setattr(CoreStore, "_open", locked)
    async with running(path) as core:
        assert core.call("getParam", "/x", "/a").value == 1


async def test_what_a_file_holds_that_was_not_read_is_not_lost(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(limits, "CORE_STATE_RETRY", 0.05)
    async with running(path) as one:
        one.call("setParam", "/x", "/calibration", 1)
    opens = CoreStore._open

    def refused(_: CoreStore) -> object:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(CoreStore, "_open", refused)
    async with running(path) as core:
        monkeypatch.setattr(CoreStore, "_open", opens)
        core.call("setParam", "/x", "/new", 2)
        await until(lambda: not core.notes())
    before = path.with_name(f"{path.name}.before")
    assert ("param", '["calibration"]') in rows(before)
    assert before.stat().st_mode & 0o777 == 0o600
    assert f"kept as {before}" in caplog.text
    async with running(path) as core:
        assert core.call("getParam", "/x", "/new").value == 2


async def test_a_node_that_answers_with_an_error_keeps_what_it_had(path: Path) -> None:
    async with Slave("/odd") as odd:
        async with running(path) as core:
            await odd.publish(core, "/t")
            await until(lambda: core.counters["kept.written"])
        odd.error = True
        async with running(path) as core:
            await until(lambda: names(core) == {"/odd"})
            await all_asked(core)
            await until(lambda: odd.lists)
            core.call("setParam", "/x", "/a", 1)
            await until(lambda: core.counters["kept.written"])
            assert core.state().publishers == {"/t": {"/odd": odd.uri}}


async def test_hanging_disk_is_reported(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import threading

    monkeypatch.setattr(limits, "CORE_STATE_WRITE", 0.05)
    go = threading.Event()
    async with running(path) as core:
        await until(lambda: core.counters["kept.written"])
        monkeypatch.setattr(CoreStore, "_replaced", lambda _: go.wait(DEADLINE) and False)
        try:
            core.call("setParam", "/x", "/a", 1)
            await until(lambda: any("the disk does not answer" in note for note in core.notes()))
        finally:
            go.set()


async def test_a_disk_that_hangs_keeps_no_core_from_its_start_or_end(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import threading

    monkeypatch.setattr(limits, "CORE_STATE_OPEN", 0.05)
    monkeypatch.setattr(limits, "CORE_STATE_CLOSE", 0.05)
    go = threading.Event()
    monkeypatch.setattr(store.CoreStore, "_open", lambda _: go.wait(DEADLINE) and [])
    try:
        async with running(path) as core:
            assert any("the disk does not answer" in note for note in core.notes())
            core.call("setParam", "/x", "/a", 1)
    finally:
        go.set()


def test_where_a_core_keeps(tmp_path: Path) -> None:
    home = {"HOME": "/h"}
    assert str(core_file(home, 11311, "base")) == "/h/.local/state/rmpa/base/core-11311.sqlite"
    assert str(core_file(home, 11311)) == "/h/.local/state/rmpa/core-11311.sqlite"
    assert str(core_file(home, 11311, "base", "/s")) == "/s/base/core-11311.sqlite"
    unit = {"HOME": "/", "STATE_DIRECTORY": "/var/lib/rmpa:/var/lib/more"}
    assert str(core_file(unit, 11311, "base")) == "/var/lib/rmpa/base/core-11311.sqlite"
    assert core_file(home, 0, "base") is None
    assert core_file({}, 11311, "base") is None
