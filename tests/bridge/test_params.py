from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from datetime import datetime
from types import SimpleNamespace
from typing import Any, ClassVar, cast

import pytest

from rmpa.bridge import limits
from rmpa.bridge.bridge import Bridge
from rmpa.bridge.data.reception import LinkTime
from rmpa.bridge.messages import decode
from rmpa.bridge.params import owner as requests
from rmpa.bridge.params.follower import Params
from rmpa.bridge.params.owner import (
    follow_rules,
    key_problem,
    read_text,
    replaced,
    why_not_follow,
    why_not_get,
    why_not_set,
    write_text,
)
from rmpa.bridge.policy import OPEN_GATE, BridgeContext, Needs, PermissionGate
from rmpa.bridge.rpc import PeerRpc
from rmpa.bridge.sessions import PeerSession
from rmpa.config.peer_rules import Effect, PermissionRule
from rmpa.config.rules import FollowRule
from rmpa.config.settings import ParamSettings, Settings, TimeSettings, TrustSettings
from rmpa.core.errors import LimitExceeded, PeerRefused, RmpaError, UnreachableError
from rmpa.core.statistics import Counters
from rmpa.ros.master.api import MasterApi
from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue
from rmpa.trust.permissions import Permissions
from tests.bridge.services.test_calls import Wire
from tests.waiting import until

# What peers may do with parameters, by name.


SETTINGS = Settings(
    params=ParamSettings(
        ("/open/**", "/followed/**"),
        ("/open/**", "/roslaunch/**", "/followed/**"),
        (FollowRule("/x", "arm", "/followed"),),
    )
)


@pytest.mark.parametrize(
    ("key", "get", "put", "follow"),
    [
        ("/open/a", "", "", ""), ("/open", "", "", ""), ("/opened", "remote_get", "remote_set", "remote_get"),
        ("/", "remote_get", "the root", "the root"),
        ("/roslaunch/uris", "remote_get", "roslaunch's own", "remote_get"),
        ("/run_id", "remote_get", "names the run", "remote_get"),
        ("/use_sim_time", "remote_get", "[time] alone", "does not share"),
        ("/followed", "", "followed from arm:/x", "followed from arm:/x"),
        ("/followed/deep", "", "followed from arm:/x", "followed from arm:/x"),
    ],
)  # fmt: skip
def test_policy(key: str, get: str, put: str, follow: str) -> None:
    for why, expected in (
        (why_not_get(SETTINGS, key), get),
        (why_not_set(SETTINGS, key), put),
        (why_not_follow(SETTINGS, key), follow),
    ):
        assert (expected in why) if expected else why == ""


def test_time_is_followed_where_it_is_shared() -> None:
    shared = Settings(params=ParamSettings(remote_get=()), time=TimeSettings(share=True))
    assert why_not_follow(shared, "/use_sim_time") == ""
    chained = Settings(time=TimeSettings("sim", share=True))
    assert "time comes from sim here" in why_not_follow(chained, "/use_sim_time")
    rules = follow_rules(chained)
    assert rules == (FollowRule("/use_sim_time", "sim", "/use_sim_time"),)


@pytest.mark.parametrize("key", ["/a", "/joint-1/x.y", "/", "/a/b/"])
def test_names_that_masters_take(key: str) -> None:
    assert key_problem(key) == ""


@pytest.mark.parametrize("key", ["", "a", "~a", 1, None, "/a//b", "/a b", "/a\n", "/" + "a" * 2000, "/a" * 100])
def test_names_that_are_none(key: object) -> None:
    assert key_problem(key)


@pytest.mark.parametrize(
    ("names", "at", "present", "lost"),
    [
        (["/a/b"], "/a", {"b": 1}, []), (["/a/b"], "/a", {"b": {"x": 1, "y": {"z": 2}}}, ["/a/b/x", "/a/b/y/z"]),
        (["/a/b/c"], "/a", {"b": 7, "d": 8}, ["/a/b"]), (["/a/b"], "/a", 7, ["/a"]),
        (["/a"], "/a", {"b": 1}, ["/a/b"]), (["/a/new/x"], "/a", {"b": 1}, []),
        (["/x/y", "/b"], "/", {"x": 1, "b": {"c": 2}}, ["/x", "/b/c"]), (["/a"], "/a", None, []),
    ],
)  # fmt: skip
def test_what_is_lost_when_a_value_takes_the_place_of_a_namespace_or_the_other_way_round(
    names: list[str], at: str, present: XmlRpcValue, lost: list[str]
) -> None:
    assert list(replaced(names, at, present)) == lost


# Two modules' parameters, joined by their questions: real parameter servers, real parts; the links are doubles.


OURS = "http://127.0.0.1:1/"


class FakeCore:
    """A parameter server that tells the agent's node at once."""

    def __init__(self) -> None:
        self.api = MasterApi("http://core/", 1, lambda _: None)
        self.told: Callable[[str], bool] = lambda _: False
        self.calls: deque[tuple[str, str]] = deque(maxlen=1000)
        self.down = False
        self.call("/core", "setParam", "/run_id", "1")

    def call(self, caller: str, method: str, *params: XmlRpcValue) -> RosReply:
        reply = self.api.call(method, (caller, *params))
        for api, what, key, _ in self.api.registrations.take()[0]:
            if (api, what) == (OURS, "paramUpdate"):
                self.told(key.rstrip("/"))
        return reply

    async def ask(self, method: str, *params: XmlRpcValue) -> RosReply:
        if self.down:
            raise UnreachableError("ROS master", "http://core/")
        await asyncio.sleep(0)
        caller, *rest = params
        self.calls.append((method, str(rest[-1] if method.endswith("Param") and len(rest) == 1 else rest)))
        return self.call(str(caller), method, *rest)

    def set(self, key: str, value: XmlRpcValue) -> None:
        assert self.call("/somebody", "setParam", key, value).code == 1

    def get(self, key: str) -> XmlRpcValue:
        reply = self.api.call("getParam", ("/somebody", key))
        return reply.value if reply.code == 1 else None


class Side:
    """One module."""

    made: ClassVar[list[Side]] = []

    def __init__(
        self,
        name: str,
        params: ParamSettings | None = None,
        time: TimeSettings | None = None,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        self.name = name
        self.core = FakeCore()
        self.counters = Counters()
        self.asks = PeerRpc(self.counters)
        self.links: dict[int, PeerSession] = {}
        self.shared = SimpleNamespace(
            core=self.core,
            node=SimpleNamespace(uri=OURS),
            sessions=SimpleNamespace(linked=self.links.values),
            rpc=self.asks,
            counters=self.counters,
            context=BridgeContext.of(Settings(params=params or ParamSettings(), time=time or TimeSettings()), gate),
        )
        self.params = Params(cast("Bridge", self.shared))
        self.core.told = self.params.param_update
        self.made.append(self)

    def reload(self, settings: Settings) -> None:
        self.shared.context = BridgeContext.of(settings, self.shared.context.gate)
        self.params.reload()

    def link(self, other: Side, number: int) -> PeerSession:
        def send(payload: bytes) -> None:
            assert len(payload) < 2 * limits.ASK_EXPRESS_MAX + 1000
            back = other.links.get(number)
            if back is not None:
                asyncio.get_running_loop().call_soon(other.asks.message, back, decode(payload))

        wire = Wire()
        wire.name, wire.send_control, wire.routes = other.name, send, {}
        attached = cast("PeerSession", SimpleNamespace(peer=number, linked=True, link=wire, time=LinkTime()))
        self.links[number] = attached
        self.asks.link_up(attached)
        if (back := other.links.get(number)) is not None:
            wire.takers, cast("Any", back.link).takers = cast("Any", back.link.routes), attached.link.routes
        return attached

    def up(self, number: int) -> None:
        self.params.link_up(self.links[number])

    def down(self, number: int) -> None:
        attached = self.links.pop(number)
        self.asks.link_down(attached)
        self.params.link_down(attached)

    def states(self) -> dict[str, str]:
        return {entry.rule.to: entry.state for entry in self.params.followed}

    async def look(self) -> None:
        self.params.reconcile()
        assert self.params._looking is not None
        await asyncio.wait([self.params._looking])

    async def ask(self, what: str, args: dict[str, Any], number: int = 1) -> Any:
        return await self.asks.request(self.links[number], what, args)

    async def close(self) -> None:
        await self.asks.close()
        await self.params.close()


def join(one: Side, other: Side, number: int = 1) -> None:
    one.link(other, number)
    other.link(one, number)
    one.up(number)
    other.up(number)


def follows(*rules: FollowRule) -> ParamSettings:
    return ParamSettings(follow=rules)


DESCRIPTION = FollowRule("/robot_description", "base", "/base/robot_description")


ARM = FollowRule("/arm", "base", "/arm")


@pytest.fixture(autouse=True)
async def sides(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[None]:
    monkeypatch.setattr(limits, "ASK_EXPRESS_MAX", 1000)
    monkeypatch.setattr(limits, "PARAM_SMALL", 4000)
    monkeypatch.setattr(limits, "PARAM_GATHER", 0.002)
    yield
    while Side.made:
        await Side.made.pop().close()


DATE = datetime(2020, 1, 2, 3, 4, 5)  # noqa: DTZ001 - XML-RPC's have no zone


VALUES: list[XmlRpcValue] = [
    True, 3, -1.5, "", "<x>&\n  é☃ ", b"\x00\xff", DATE, [], [1, [2.0, "x"]], {},
    {"a": {"b": [True, {"c": b"x"}]}, "d": 0.1},
]  # fmt: skip


@pytest.mark.parametrize("value", VALUES, ids=repr)
async def test_types_survive_as_text(value: XmlRpcValue) -> None:
    back = await read_text(await write_text("/x", value))
    assert back == value
    assert type(back) is type(value)


@pytest.mark.parametrize(
    "text", ["", "nonsense", "<methodResponse>", "\ud800", "<?xml version='1.0'?><methodCall></methodCall>"]
)
async def test_a_text_that_does_not_parse(text: str) -> None:
    with pytest.raises(RmpaError):
        await read_text(text)


async def test_a_value_of_more_parameters_than_a_peer_may_set_sets_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "PARAMS_SET_MAX", 100)
    base, pad = Side("base", ParamSettings(remote_get=("/**",), remote_set=("/**",))), Side("pad")
    join(base, pad)
    for count in (101, 100):
        text = await write_text("", {"deep": {f"p{number}": number for number in range(count)}})
        if count > 100:
            with pytest.raises(PeerRefused, match="/many has more than 100 parameters: set its parts one by one"):
                await pad.ask(requests.SET, {"key": "/many", "text": text})
            assert base.core.get("/many") is None
        else:
            assert await pad.ask(requests.SET, {"key": "/many", "text": text}) == {"count": 100}


async def test_get_set_list_delete() -> None:
    base = Side("base", ParamSettings(remote_get=("/open/**", "/big"), remote_set=("/open/**",)))
    pad = Side("pad")
    join(base, pad)
    base.core.set("/open", {"a": 1, "b": "x" * 5000})
    base.core.set("/closed", 1)
    answer = await pad.ask(requests.GET, {"key": "/open"})
    assert await read_text(answer["text"]) == {"a": 1, "b": "x" * 5000}
    assert await read_text((await pad.ask(requests.NAMES, {}))["text"]) == ["/open/a", "/open/b"]
    large = await write_text("", {"c": "y" * 9000, "d": {"e": True}})
    assert await pad.ask(requests.SET, {"key": "/open", "text": large}) == {"count": 2}
    assert base.core.get("/open") == {"a": 1, "b": "x" * 5000, "c": "y" * 9000, "d": {"e": True}}
    await pad.ask(requests.DELETE, {"key": "/open/d"})
    assert base.core.get("/open/d") is None
    before = base.core.get("/")
    bad = await write_text("", {"open": {"new": 1}, "closed": 2})
    nil = (await write_text("", "x")).replace("<string>x</string>", "<nil/>")
    for what, args, error in (
        (requests.GET, {"key": "/closed"}, "no glob of params.remote_get"),
        (requests.GET, {"key": "/"}, "may not be read"),
        (requests.GET, {"key": "/open/nothing"}, "no parameter /open/nothing"),
        (requests.GET, {"key": "relative"}, "not the global name"),
        (requests.GET, {}, "not the global name"),
        (requests.SET, {"key": "/", "text": bad}, "/closed may not be set"),
        (requests.SET, {"key": "/open/x", "text": "<nonsense"}, "malformed XML"),
        (requests.SET, {"key": "/open/x", "text": nil}, "nil"),
        (requests.SET, {"key": "/open//x", "text": nil}, "not a parameter's name"),
        (requests.SET, {"key": "/run_id", "text": "x"}, "malformed XML"),
        (requests.SET, {"key": "/open/x", "text": "x" * 2000}, "malformed XML"),
        (requests.SET, {"key": "/open/x"}, "text of a parameter's value is missing"),
        (requests.DELETE, {"key": "/open/nothing"}, "no parameter /open/nothing"),
        (requests.DELETE, {"key": "/"}, "the root holds every parameter"),
        (requests.FOLLOW, {"keys": "x"}, "not a list"),
    ):
        with pytest.raises(PeerRefused, match=error):
            await pad.ask(what, args)
    assert base.core.get("/") == before, "nothing is set in part"


def large_set(text: str) -> dict[str, Any]:
    return {"key": "/x", "text": f"<?xml version='1.0'?>{' ' * 20_000}" + text.partition("?>")[2]}


async def owner_and_peer() -> tuple[Side, Side, dict[str, Any]]:
    base, pad = Side("base", ParamSettings(remote_get=("/**",), remote_set=("/**",))), Side("pad")
    join(base, pad)
    return base, pad, large_set(await write_text("", "y"))


async def test_a_large_value_that_comes_after_its_asker_gave_it_up_is_not_set() -> None:
    base, pad, args = await owner_and_peer()
    base.links[1].time.set(60.0, 0.001)  # by the peer's clock it is a minute later
    with pytest.raises(PeerRefused, match=r"came \d\d.\d s after the asking agent had given it up"):
        await pad.ask(requests.SET, args)
    assert base.core.get("/x") is None
    assert base.counters["ask.late"] == 1
    base.links[1].time.set(60.0, 61.0)  # perhaps not
    assert await pad.ask(requests.SET, args) == {"count": 1}


async def test_large_messages_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    base, pad, args = await owner_and_peer()
    base.asks._links[1]._budget.limit = pad.asks._links[1]._outgoing.limit = 30_000
    entered, leave = asyncio.Event(), asyncio.Event()

    async def hold(_session: PeerSession, _args: dict[str, Any]) -> object:
        entered.set()
        await leave.wait()
        return {"text": "z" * 40_000}

    base.asks.on_request("hold", hold, Needs((), ""))
    held = asyncio.create_task(pad.ask("hold", args))
    await entered.wait()
    with pytest.raises(PeerRefused, match="too many large questions at once"):
        await pad.ask(requests.SET, args)
    with pytest.raises(PeerRefused, match="the question was lost: large calls hold"):
        await pad.ask(requests.SET, args | {"text": args["text"] * 10})
    monkeypatch.setattr(limits, "ASK_BYTES_MAX", 30_000)
    with pytest.raises(LimitExceeded, match="message between agents"):
        await pad.ask(requests.SET, args | {"text": args["text"] * 2})
    leave.set()
    with pytest.raises(PeerRefused, match="the answer cannot be sent: message between agents"):
        await held
    assert await pad.ask(requests.SET, args) == {"count": 1}, "what was answered counts no more"
    assert base.asks._links[1]._budget.used == pad.asks._links[1]._outgoing.used == 0


async def test_a_large_value_does_not_replace_one_that_was_told_after_it() -> None:
    base, pad = Side("base", ParamSettings(remote_get=("/**",))), Side("pad", follows(DESCRIPTION))
    base.core.set("/robot_description", "x" * 20_000)
    pad.link(base, 1)
    base.link(pad, 1)
    lane = cast("Any", base.links[1].link).bulk
    lane.slow = True
    pad.up(1)
    base.up(1)
    await until(lambda: lane.kept)
    base.core.set("/robot_description", "small")
    await base.look()
    for deliver in lane.kept:
        deliver()
    await until(lambda: pad.core.get("/base/robot_description") == "small")
    await until(lambda: all(task is None or task.done() for task in base.params.owner.tasks()))
    assert pad.core.get("/base/robot_description") == "small"


async def test_a_followed_parameter_is_as_over_there() -> None:
    base, pad = Side("base"), Side("pad", follows(DESCRIPTION, ARM))
    base.core.set("/robot_description", "one")
    join(base, pad)
    await until(lambda: pad.core.get("/base/robot_description") == "one")
    assert pad.core.get("/robot_description") is None
    base.core.set("/robot_description", "two" * 3000)  # it crosses as a body
    await until(lambda: pad.core.get("/base/robot_description") == "two" * 3000)
    base.core.set("/arm", {"p": 1, "q": {"r": 2.5}})
    await until(lambda: pad.core.get("/arm") == {"p": 1, "q": {"r": 2.5}})
    base.core.call("/x", "deleteParam", "/arm/q/r")
    await until(lambda: pad.core.get("/arm") == {"p": 1, "q": {}})
    base.core.set("/arm/q/s", True)
    await until(lambda: pad.core.get("/arm") == {"p": 1, "q": {"s": True}})
    base.core.call("/x", "deleteParam", "/arm")
    await until(lambda: pad.core.get("/arm") is None)
    assert pad.states() == {"/base/robot_description": "followed", "/arm": "followed"}
    # Who has nothing new to tell sets nothing.
    pad.core.calls.clear()
    await base.look()
    await pad.look()
    assert "setParam" not in {method for method, _ in pad.core.calls}


@pytest.mark.parametrize("size", [10, 9000])
async def test_what_is_set_here_is_put_back(size: int, caplog: pytest.LogCaptureFixture) -> None:
    base, pad = Side("base"), Side("pad", follows(DESCRIPTION))
    base.core.set("/robot_description", "x" * size)
    join(base, pad)
    await until(lambda: pad.core.get("/base/robot_description") == "x" * size)
    await until(lambda: pad.params._working is not None and pad.params._working.done())
    pad.core.set("/base", {"robot_description": "mine"})
    await pad.look()
    assert pad.core.get("/base/robot_description") == "x" * size
    assert "was changed here, and is put back: it belongs to base" in caplog.text
    assert base.core.get("/robot_description") == "x" * size, "one direction"
    # While its owner is away too.
    base.down(1)
    pad.down(1)
    assert pad.states() == {"/base/robot_description": "waiting"}
    pad.core.call("/x", "deleteParam", "/base/robot_description")
    await pad.look()
    assert pad.core.get("/base/robot_description") == "x" * size


async def test_two_of_one_name_are_not_mixed(caplog: pytest.LogCaptureFixture) -> None:
    first, second, pad = Side("base"), Side("base"), Side("pad", follows(DESCRIPTION))
    first.core.set("/robot_description", "first")
    second.core.set("/robot_description", "second")
    join(first, pad, 1)
    join(second, pad, 2)
    await until(lambda: pad.core.get("/base/robot_description") == "first")
    assert "two peers are named base" in caplog.text
    first.down(1)
    pad.down(1)
    await until(lambda: pad.core.get("/base/robot_description") == "second")


async def test_refusals_are_said_and_asked_again(caplog: pytest.LogCaptureFixture) -> None:
    base = Side("base", ParamSettings(remote_get=("/arm/**",)), TimeSettings())
    pad = Side("pad", follows(DESCRIPTION, ARM), TimeSettings(follow="base"))
    base.core.set("/use_sim_time", True)
    base.core.set("/robot_description", "one")
    join(base, pad)
    await until(lambda: list(pad.states().values()).count("refused") == 2)
    problems = {entry.rule.to: entry.problem for entry in pad.params.followed}
    assert "remote_get" in problems["/base/robot_description"]
    assert "does not share its time" in problems["/use_sim_time"]
    assert problems["/base/robot_description"] in caplog.text
    assert pad.core.get("/use_sim_time") is None
    # The owner's rules change: it is followed without a word of ours.
    base.reload(Settings(params=ParamSettings(), time=TimeSettings(share=True)))
    await pad.look()
    await until(lambda: pad.core.get("/use_sim_time") is True)
    await until(lambda: pad.core.get("/base/robot_description") == "one")
    # And back: what is here stays, and is not followed any more.
    base.reload(Settings(params=ParamSettings(), time=TimeSettings()))
    await until(lambda: pad.states()["/use_sim_time"] == "refused")
    base.core.set("/use_sim_time", False)
    await base.look()
    assert pad.core.get("/use_sim_time") is True


async def test_no_chains_and_no_loops() -> None:
    base = Side("base", follows(FollowRule("/arm/p", "pad", "/arm/p")))
    pad = Side("pad", follows(ARM))
    base.core.set("/arm", {"p": 1})
    pad.core.set("/arm", {"p": 2})
    join(base, pad)
    await until(lambda: "refused" in {**base.states(), **pad.states()}.values())
    text = await write_text("", 5)
    with pytest.raises(PeerRefused, match="followed from base:/arm"):
        await base.ask(requests.SET, {"key": "/arm/x", "text": text})


async def test_a_core_that_is_started_anew_gets_all_of_it_again() -> None:
    base, pad = Side("base"), Side("pad", follows(DESCRIPTION, ARM))
    base.core.set("/robot_description", "x" * 9000)
    base.core.set("/arm", 1)
    join(base, pad)
    await until(lambda: pad.core.get("/arm") == 1)
    await until(lambda: pad.core.get("/base/robot_description") == "x" * 9000)
    await pad.look()
    await base.look()
    pad.core.api = MasterApi("http://core/", 1, lambda _: None)
    pad.core.down = True
    await pad.look()
    pad.core.down = False
    pad.core.call("/core", "setParam", "/run_id", "2")
    await pad.look()
    await until(lambda: pad.core.get("/base/robot_description") == "x" * 9000)
    await until(lambda: pad.core.get("/arm") == 1)
    # The owner's: it is subscribed to again, and what it has is told.
    base.core.api = MasterApi("http://core/", 1, lambda _: None)
    base.core.call("/core", "setParam", "/run_id", "2")
    base.core.call("/core", "setParam", "/robot_description", "new")
    await base.look()
    await until(lambda: pad.core.get("/base/robot_description") == "new")
    base.core.set("/arm", 2)
    await until(lambda: pad.core.get("/arm") == 2)


@pytest.mark.parametrize("value", [1, "x" * 9000], ids=["small", "large"])
async def test_what_the_core_did_not_take_at_once_is_not_taken_for_a_change_of_a_node_here(
    caplog: pytest.LogCaptureFixture, value: XmlRpcValue
) -> None:
    base, pad = Side("base"), Side("pad", follows(ARM))
    base.core.set("/arm", value)
    pad.core.down = True
    join(base, pad)
    await until(lambda: pad.states() == {"/arm": "refused"})
    pad.core.down = False
    await pad.look()
    assert pad.core.get("/arm") == value
    assert "put back" not in caplog.text


async def test_a_value_that_gets_another_name_leaves_the_old_one() -> None:
    base, pad = Side("base"), Side("pad", follows(DESCRIPTION, ARM))
    base.core.set("/robot_description", "one")
    base.core.set("/arm", 1)
    join(base, pad)
    await until(lambda: pad.core.get("/base/robot_description") == "one" and pad.core.get("/arm") == 1)
    pad.reload(Settings(params=follows(replace(DESCRIPTION, to="/urdf"), ARM)))
    await until(lambda: pad.core.get("/urdf") == "one")
    await pad.look()
    assert pad.core.get("/base/robot_description") is None
    assert pad.core.get("/arm") == 1
    pad.reload(Settings(params=follows(replace(DESCRIPTION, to="/arm"))))
    await pad.look()
    await until(lambda: pad.core.get("/arm") == "one")
    assert pad.core.get("/urdf") is None


async def test_time_is_followed_although_nothing_may_be_read() -> None:
    simulator = Side("sim", ParamSettings(remote_get=()), TimeSettings(share=True))
    pad = Side("pad", time=TimeSettings(follow="sim"))
    simulator.core.set("/use_sim_time", True)
    join(simulator, pad)
    await until(lambda: pad.core.get("/use_sim_time") is True)


@pytest.mark.parametrize("before", [None, False])
async def test_time_that_is_no_longer_followed_is_as_it_was(before: bool | None) -> None:
    simulator, pad = Side("sim", time=TimeSettings(share=True)), Side("pad", time=TimeSettings(follow="sim"))
    simulator.core.set("/use_sim_time", True)
    if before is not None:
        pad.core.set("/use_sim_time", before)
    join(simulator, pad)
    await until(lambda: pad.core.get("/use_sim_time") is True)
    pad.reload(Settings())
    await pad.look()
    assert pad.core.get("/use_sim_time") is before


async def test_a_namespace_that_may_not_be_read_in_full_is_not_followed() -> None:
    base = Side("base", ParamSettings(remote_get=("/arm", "/arm/p")))
    pad = Side("pad", follows(ARM))
    base.core.set("/arm", {"p": 1, "secret": 2})
    join(base, pad)
    await until(lambda: pad.states() == {"/arm": "refused"})
    assert pad.core.get("/arm") is None
    base.core.call("/x", "deleteParam", "/arm/secret")
    await until(lambda: pad.core.get("/arm") == {"p": 1})


async def test_values_that_do_not_parse_change_nothing(caplog: pytest.LogCaptureFixture) -> None:
    base, pad = Side("base"), Side("pad", follows(ARM))
    base.core.set("/arm", 1)
    join(base, pad)
    await until(lambda: pad.core.get("/arm") == 1)
    await base.ask(requests.VALUE, {"key": "/arm", "text": "<x>"})
    await until(lambda: pad.states() == {"/arm": "refused"})
    assert pad.core.get("/arm") == 1
    assert "/arm cannot be set as its owner has it" in caplog.text


# What the permissions of a secured mesh keep from a peer that asks for a module's parameters.


def denying(*names: str) -> PermissionGate:
    """Permissions by which a peer may have all parameters but these."""
    allow = PermissionRule(("*",), names={"param": ("/**",)})
    deny = PermissionRule(("*",), names={"param": names}, effect=Effect.DENY)
    return PermissionGate(Permissions(TrustSettings(rules=(allow, deny))))


def linked(params: ParamSettings, gate: PermissionGate = OPEN_GATE) -> tuple[Side, Side]:
    """An owner with these rules, and a peer of it."""
    owner, peer = Side("base", params, gate=gate), Side("pad")
    join(owner, peer)
    return owner, peer


ALL = ParamSettings(remote_get=("/**",), remote_set=("/**",))


@pytest.mark.parametrize("denied", ["/motors/limit", "/motors/*", "/**/limit"])
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("/motors/limit", {"": 5}), ("/motors/limit/", {"": 5}), ("/motors", {"limit/": 5}),
        ("/", {"motors/limit": 5}), ("/", {"motors/limit/": 5}),
    ],
)  # fmt: skip
async def test_a_slash_at_the_end_does_not_pass_a_deny(denied: str, key: str, value: XmlRpcValue) -> None:
    owner, peer = linked(ALL, denying(denied))
    owner.core.set("/motors/limit", 1)
    with pytest.raises(PeerRefused, match="do not let pad read or set"):
        await peer.ask(requests.SET, {"key": key, "text": await write_text("", value)})
    assert owner.core.get("/motors/limit") == 1
    await peer.ask(requests.SET, {"key": "/speed", "text": await write_text("", {"max": 2})})
    assert owner.core.get("/speed/max") == 2


async def test_parameters_are_read_and_set_only_with_permission() -> None:
    def rule(module: str, names: str, effect: Effect = Effect.ALLOW) -> PermissionRule:
        return PermissionRule((module,), (), effect, {"param": (names,)})

    rules = (rule("pad", "/arm/**"), rule("yard", "/other"), rule("pad", "/arm/secret", Effect.DENY))
    owner, peer = linked(ALL, PermissionGate(Permissions(TrustSettings(rules=rules)), counters := Counters()))
    arm: XmlRpcValue = {"speed": 1, "secret": 2, "deep": {"x": 3}}
    owner.core.set("/arm", arm)
    owner.core.set("/other", 4)

    async def asks(what: str, key: str, value: XmlRpcValue = None) -> str:
        text = {} if value is None else {"text": await write_text("", value)}
        try:
            return str(await peer.ask(what, {"key": key, **text}))
        except PeerRefused as error:
            return error.reason

    def no(key: str) -> str:
        return f"the permissions there do not let pad read or set {key}"

    names = await asks(requests.NAMES, "")
    assert [name in names for name in ("/arm/speed", "/arm/deep/x", "secret", "/other")] == [True, True, False, False]
    assert "1" in await asks(requests.GET, "/arm/speed")
    for key in ("/arm/secret", "/arm", "/nothing", "/other"):  # of a namespace that holds a secret no name is told
        assert await asks(requests.GET, key) == no(key)
    assert await asks(requests.DELETE, "/arm/") == no("/arm")
    assert await asks(requests.DELETE, "/other") == no("/other")
    assert counters["permission.param"] == 6
    assert "1" in await asks(requests.SET, "/arm/speed", 5)
    changed: XmlRpcValue = {"speed": 6, "secret": 7}
    for key, value in (("/arm/secret", 5), ("/arm", 7), ("/arm/secret/deeper", 7)):  # the secret would be lost
        assert await asks(requests.SET, key, value) == no(key)
    assert await asks(requests.SET, "/arm", changed) == no("/arm/secret"), "a name of its own words"
    assert owner.core.get("/arm") == {"speed": 5, "secret": 2, "deep": {"x": 3}}
    assert await asks(requests.DELETE, "/arm/deep") == "{}"


async def test_an_error_does_not_name_a_parameter_that_the_permissions_hide() -> None:
    """The globs of [params] refuse it as well, and their error names the first parameter that none fits."""
    owner, peer = linked(ParamSettings(remote_get=("/open/**", "/run_id")), denying("/secret/**"))
    owner.core.set("/open", {"a": 1})
    owner.core.set("/secret/door", 1234)
    with pytest.raises(PeerRefused) as caught:
        await peer.ask(requests.GET, {"key": "/"})
    assert "secret" not in str(caught.value)
    text = (await peer.ask(requests.GET, {"key": "/open"}))["text"]
    assert await read_text(text) == {"a": 1}
