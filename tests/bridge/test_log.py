"""The log of a module: which lines are kept, what a question finds of them, what others may read and set."""

from __future__ import annotations

import asyncio
import logging
import struct
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from rmpa.bridge import limits
from rmpa.bridge.log import LEVEL, LINES, ModuleLogs
from rmpa.bridge.log_ring import LogQuery, LogRing, ModuleLog
from rmpa.config.peer_rules import PermissionRule
from rmpa.config.settings import Settings
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, UnreachableError
from rmpa.core.identity import OWN_NODE
from tests.bridge.asked_module import AskedModule

NOW = 1_800_000_000 * 10**9


def message(node: str, text: str, level: int = 2, stamp_ns: int = NOW) -> bytes:
    """A framed rosgraph_msgs/Log, as roscpp sends it."""

    def string(value: str) -> bytes:
        raw = value.encode()
        return struct.pack("<I", len(raw)) + raw

    body = struct.pack("<III", 1, *divmod(stamp_ns, 10**9)) + string("frame") + bytes((level,)) + string(node)
    body += string(text) + string("main.cpp") + string("main") + struct.pack("<II", 7, 1) + string("/topic")
    return struct.pack("<I", len(body)) + body


def ring_of(*lines: tuple[str, str, int]) -> LogRing:
    ring = LogRing(NOW)
    for node, text, level in lines:
        ring.take(node, message(node, text, level), NOW)
    return ring


def texts(found: ModuleLog) -> list[str]:
    return [line.text for line in found.lines]


def ask(ring: LogRing, now_ns: int = NOW, **query: Any) -> ModuleLog:
    return ring.find(LogQuery.of(query), now_ns)


def test_lines_are_found_by_level_node_and_age_in_their_order() -> None:
    ring = ring_of(("/arm/hand", "a", 1), ("/base", "b", 4), ("/arm/hand", "c", 16))
    ring.take("/base", message("/base", "old", stamp_ns=NOW - 20 * 10**9), NOW)
    assert texts(ask(ring)) == ["a", "b", "c", "old"]
    assert [line.level for line in ask(ring).lines] == ["debug", "warn", "fatal", "info"]
    assert texts(ask(ring, level="warn")) == ["b", "c"]
    assert texts(ask(ring, node="/arm/*")) == ["a", "c"]
    assert texts(ask(ring, since=10)) == ["a", "b", "c"]
    assert texts(ask(ring, most=2)) == ["c", "old"]


def test_a_question_goes_on_behind_the_last_answer_also_over_a_restart() -> None:
    ring = ring_of(("/a", "1", 2), ("/a", "2", 2))
    first = ask(ring)
    ring.take("/a", message("/a", "3"), NOW)
    assert texts(ask(ring, after=first.next)) == ["3"]
    assert texts(ask(ring, after=ask(ring).next)) == []
    later = LogRing(NOW + 10**9)
    later.take("/a", message("/a", "after the restart"), NOW)
    assert texts(ask(later, after=first.next)) == ["after the restart"]
    behind = LogRing(NOW - 10**15)  # its clock was set back meanwhile
    behind.take("/a", message("/a", "behind"), NOW)
    assert texts(ask(behind, after=first.next)) == ["behind"]


def test_a_node_that_floods_loses_its_own_lines_alone_and_the_reader_is_told() -> None:
    ring = ring_of(("/quiet", "hot", 8))
    ring.take_own(logging.WARNING, NOW, "the agent says")
    first = ask(ring)
    for number in range(20_000):
        ring.take("/loud", message("/loud", f"line {number}"), NOW)
    assert texts(ask(ring, level="warn")) == ["hot", "the agent says"]
    loud = ask(ring, node="/loud", after=first.next)
    assert (len(loud.lines), loud.lines[-1].text) == (limits.LOG_LINES_ASKED, "line 19999")
    assert (loud.lost, ask(ring, node="/quiet", after=first.next).lost) == (("/loud",), ())


def test_the_kept_bytes_are_bounded_whatever_comes() -> None:
    ring = LogRing(NOW)
    for number in range(400):
        ring.take("/big", message("/big", "x" * 1_000_000), NOW)
        ring.take("/n", message(f"/n{number % 20}", "y" * 3000), NOW)
    found = ask(ring, node="/big")
    assert found.lines[-1].text == "x" * limits.LOG_TEXT_MAX + f"… {1_000_000 - limits.LOG_TEXT_MAX:,} bytes more"
    assert sum(kept.size for kept in ring._nodes.values()) == ring._size <= limits.LOG_BYTES_KEPT
    assert len(msgspec.json.encode(ask(ring))) < 2 * limits.LOG_ANSWER_BYTES


@pytest.mark.parametrize("stamp_ns", [0, 1, 2**32 * 10**9 - 1, NOW - 10**14])
def test_a_stamp_far_from_the_clock_gives_way_to_the_arrival(stamp_ns: int) -> None:
    ring = LogRing(NOW)
    ring.take("/a", message("/a", "x", stamp_ns=stamp_ns), NOW)
    assert ask(ring).lines[0].at == NOW / 1e9


def test_what_is_no_message_is_left_out_and_no_node_speaks_for_the_agent() -> None:
    ring = LogRing(NOW)
    whole = message("/a", "text")
    for end in range(len(whole) - 38):  # what is behind the text is not read
        ring.take("/a", whole[:end], NOW)
    assert ask(ring).lines == ()
    for name in (OWN_NODE, "/rmpa/arm/talker", "no name", "", "/n" * 900):
        ring.take("/teller", message(name, "forged"), NOW)
    assert {(line.node, line.agent) for line in ask(ring).lines} == {("/teller", False)}
    ring.take("/a", message("/a", "\x1b[31mred\x1b[0m \0 é").replace(b"\xc3\xa9", b"\xff\xfe"), NOW)
    assert ask(ring).lines[-1].text == "red \0 \ufffd\ufffd"


@pytest.mark.parametrize(
    "query", [{"level": "loud"}, {"most": 0}, {"most": 10**6}, {"after": -1}, {"node": "x" * 2000}, {"since": "5m"}]
)
def test_a_malformed_question_is_refused(query: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        LogQuery.of(query)


class Core:
    """A core with one node, which passes its log on."""

    def __init__(self) -> None:
        self.registrations = SimpleNamespace(service_uri=lambda _name: None)
        self.log: Any = None

    def on_log(self, callback: Any) -> bool:
        self.log = callback
        return True

    def state(self) -> Any:
        return SimpleNamespace(nodes={"/talker": "http://a:1/", "/secret": "http://a:2/", OWN_NODE: "http://a:3/"})


class Module(AskedModule):
    """A module's part, beside a bridge that is made up."""

    def __init__(self, name: str, *rules: PermissionRule) -> None:
        self.core = Core()
        super().__init__(Settings(name=name), *rules, core=self.core)
        self.logs = ModuleLogs(self.bridge)
        self.logs.start()

    async def lines(self, asker: str = "arm", **query: Any) -> ModuleLog:
        found: ModuleLog = await self.answer(asker, LINES, query)
        return found


SAID = ["said by the talker", "said by another"]


@pytest.fixture
def say() -> Any:
    def heard(module: Module) -> None:
        for node, text in zip(("/talker", "/secret"), SAID, strict=True):
            module.core.log(node, memoryview(message(node, text)))

    return heard


async def test_a_peer_reads_and_sets_the_log_of_the_nodes_that_a_permission_names(say: Any) -> None:
    module = Module("base", PermissionRule(("arm",), names={"log": ("/talker",)}))
    say(module)
    assert texts(await module.lines()) == SAID[:1]
    with pytest.raises(RmpaError, match="do not let eve use the log of"):
        await module.lines("eve")
    with pytest.raises(RmpaError, match="do not let arm use the log of /secret"):
        await module.answer("arm", LEVEL, {"node": "/secret", "level": "debug"})
    with pytest.raises(RmpaError, match="base has no node /no"):
        await module.logs.level(None, {"node": "/no"})
    with pytest.raises(RmpaError, match="/talker has no loggers"):  # it is permitted
        await module.answer("arm", LEVEL, {"node": "/talker"})
    await module.logs.close()


async def test_lines_that_came_from_another_module_are_not_kept_again_and_the_agents_own_are(say: Any) -> None:
    module = Module("base")
    say(module)
    module.core.log("/rmpa/arm/talker", memoryview(message("/talker", "of arm")))
    logging.getLogger("rmpa.test").error("! the agent's own [failed]")
    await asyncio.to_thread(logging.getLogger("rmpa.test").error, "! of a thread [failed]")
    await asyncio.sleep(0)
    found = await module.lines(level="info")
    assert texts(found) == [*SAID, "! the agent's own [failed]", "! of a thread [failed]"]
    assert [line.agent for line in found.lines] == [False, False, True, True]
    await module.logs.close()
    logging.getLogger("rmpa.test").error("! after its end [failed]")
    assert len((await module.lines()).lines) == 4


async def test_the_logs_of_all_modules_have_one_clock_and_each_problem_is_told(say: Any) -> None:
    module = Module("base")
    say(module)
    at = 1_800_000_000.0
    lines = [{"n": 1, "at": at + 3600, "level": "info", "node": "/far", "text": "an hour ahead"}]
    module.peer("arm", {"lines": lines, "next": 1}, ahead=3600.0)
    module.peer("old", PeerRefused("old", "this agent does not know the question 'log.lines'"))
    module.peer("hung", UnreachableError("agent", "hung"))
    module.peer("evil", {"lines": [{"n": 1, "at": 1e300, "level": "x", "node": "/", "text": ""}], "next": 1})
    module.peer("mute", None, linked=False)
    found = {one.module: one for one in await module.logs.read({})}
    assert list(found) == ["base", "arm", "old", "hung", "evil", "mute"]
    assert [line.at for line in found["arm"].lines] == [at]
    assert (found["base"].error, found["arm"].error) == (0.0, 0.002)
    told = {name: one.problem for name, one in found.items() if one.problem}
    assert told.keys() == {"old", "hung", "evil", "mute"}
    assert "earlier release" in told["old"]
    assert "malformed" in told["evil"]
    (one,) = await module.logs.read({"modules": ["arn"]})
    assert "did you mean arm?" in one.problem
    await module.logs.close()


async def test_each_module_is_asked_from_where_it_was_left(say: Any) -> None:
    module = Module("base")
    say(module)
    asked: list[Any] = []

    def answer(args: Any) -> Any:
        asked.append(args)
        return {"lines": [], "next": 7}

    module.peer("arm", answer)
    first = await module.logs.read({"level": "warn"})
    again = await module.logs.read({"level": "warn", "after": {one.module: one.next for one in first}})
    assert [args.get("after", 0) for args in asked] == [0, 7]
    assert asked[0]["level"] == "warn"
    assert again[0].lines == ()
    await module.logs.close()
