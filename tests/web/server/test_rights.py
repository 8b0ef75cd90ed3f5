"""What web clients may do by the settings, and their node by the rules of ``[[permission]]``."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing, nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import aiohttp
import msgspec
import pytest

from rmpa.config.peer_rules import Access, Effect, PermissionRule
from rmpa.config.settings import Settings, TrustSettings, WebSettings
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.observe.snapshot import Snapshot
from rmpa.resource import Resource
from rmpa.resource.runtime import describe
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.master.parameters import Parameters
from rmpa.ros.node.node import Node
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.xmlrpc import XmlRpcValue
from rmpa.trust.permissions import InviteReply, TrustStatus
from rmpa.web.hub.hub import Hub
from rmpa.web.hub.node_link import EVERYTHING, FULL, READ_ONLY, NodeRules, ParamValue, Rights
from rmpa.web.monitor import questions
from rmpa.web.monitor.diagnostics import DiagnosticsFeed
from rmpa.web.monitor.questions import Answers
from rmpa.web.monitor.resources import ResourceWatch
from rmpa.web.server.process import CertificateFiles, TokenAccess, WebSetup
from tests.waiting import DEADLINE, until
from tests.web import snapshots
from tests.web.hub.client import FakeClient, running_hub
from tests.web.server.test_upgrades import running

RULES = (
    PermissionRule(("*",), effect=Effect.DENY, names={"call": ("/motors/**",), "param": ("/motors/**",)}),
    PermissionRule(("web",), effect=Effect.DENY, names={"subscribe": ("/camera/**",), "publish": ("/odom",)}),
    PermissionRule(("tablet",), effect=Effect.DENY, names={"publish": ("/cmd_vel",)}),
)
SETTINGS = Settings(web=WebSettings(control=True), trust=TrustSettings(default="allow", rules=RULES))
TOKEN = TokenAccess("secret-" * 6)


def setup(settings: Settings = SETTINGS, access: TokenAccess = TOKEN, *, trusted: bool = True) -> WebSetup:
    return WebSetup(settings, access, CertificateFiles(), trusted)


def denying(**names: tuple[str, ...]) -> NodeRules:
    """The rules of a node that may do everything but what ``names`` say."""
    rule = PermissionRule(("*",), effect=Effect.DENY, names=names)
    return setup(replace(SETTINGS, trust=TrustSettings(default="allow", rules=(rule,)))).rules


RULED = setup().rules
# May change every parameter but one, not the namespace around it.
CAREFUL = denying(param=("/motors/limit",))
TEXT = MessageType("std_msgs/String")
TREE: dict[str, ParamValue] = {"speed": {"max": 1.5}, "motors": {"pid": {"p": 3}}, "name": "base"}


PARAMETERS = Parameters()
PARAMETERS.set("/", cast("XmlRpcValue", TREE))


def value_of(name: str) -> ParamValue:
    try:
        return cast("ParamValue", PARAMETERS.get(name))
    except KeyError:
        return None


@pytest.mark.parametrize(
    ("access", "name", "allowed"),
    [
        (Access.PUBLISH, "/cmd_vel", True),
        (Access.PUBLISH, "/odom", False),
        (Access.PUBLISH, "//odom/", False),
        (Access.CALL, "/arm/stop", True),
        (Access.CALL, "/motors/enable", False),
        (Access.CALL, "/motors//enable", False),
        (Access.CALL, "motors/enable", False),
        (Access.SERVE, "/map", True),
        (Access.SUBSCRIBE, "/odom", True),
        (Access.SUBSCRIBE, "/camera/image", False),
    ],
)
def test_in_a_secured_mesh_the_rules_bound_what_the_node_may(access: Access, name: str, allowed: bool) -> None:
    EVERYTHING.check(access, name)
    setup(trusted=False).rules.check(access, name)
    if allowed:
        RULED.check(access, name)
    else:
        with pytest.raises(PeerRefused, match=rf"web may not {access} {name}; .*permission.* denies"):
            RULED.check(access, name)


@pytest.mark.parametrize(
    ("name", "after", "refused"),
    [
        ("/speed/max", 2.0, ""),
        ("/speed", {"max": 1.0, "min": 0.1}, ""),
        ("/speed/new", 1, ""),
        ("/motors/pid/p", 9, "/motors/pid/p"),
        ("/motors", {"pid": {"p": 9}}, "/motors/pid/p"),
        ("/motors", None, "/motors/pid/p"),  # deleting a namespace deletes what is below
        ("/motors/pid/p/x", 1, "/motors/pid/p"),  # and a parameter gives way to a namespace
        ("motors//pid/p", 9, "/motors/pid/p"),
        ("/", {"speed": {"max": 2.0}}, "/motors/pid/p"),
        ("/", {"motors": {"new": 1}}, "/motors/new"),
        ("/name", "arm", ""),
    ],
)
def test_a_denied_parameter_cannot_be_changed_by_its_namespace(name: str, after: ParamValue, refused: str) -> None:
    if not refused:
        RULED.check_param_change(name, value_of, after)
        return
    with pytest.raises(PeerRefused, match=f"may not param {refused};") as caught:
        RULED.check_param_change(name, value_of, after)
    assert "[[permission]] 1 denies param of '/motors/**' to '*'" in str(caught.value)


@pytest.mark.parametrize("key", ["", "/", "/motors/pid/p", "max/", "a/b"])
def test_a_key_that_a_core_takes_for_another_name_is_refused(key: str) -> None:
    values: tuple[ParamValue, ...] = ({key: 99}, {"inner": {key: 99}})
    for value in values:
        with pytest.raises(PeerRefused, match="is not one part of a name"):
            RULED.check_param_change("/speed", value_of, value)
    EVERYTHING.check_param_change("/speed", value_of, {key: 99})


def test_denied_parameters_are_not_shown() -> None:
    assert RULED.visible_tree(TREE) == {"speed": {"max": 1.5}, "name": "base"}
    assert RULED.visible({"/motors/pid/p": 3, "/name": "base"}) == {"/name": "base"}
    assert EVERYTHING.visible_tree(TREE) is TREE


def test_clients_may_what_the_settings_say() -> None:
    def rights(access: TokenAccess = TOKEN, *, control: bool, drive: bool = False) -> Rights:
        return setup(Settings(web=WebSettings(control=control, drive=drive)), access).rights

    assert rights(TokenAccess(), control=True) is READ_ONLY
    assert rights(control=True) == FULL
    assert rights(control=False) == Rights(view=True)
    assert rights(control=False, drive=True).drive
    assert not rights(TokenAccess(), control=True, drive=True).drive


def test_a_server_is_made_anew_for_other_rights_rules_or_another_token_alone() -> None:
    assert setup().serves_as(setup(replace(SETTINGS, log_level="debug")))
    assert not setup().serves_as(setup(replace(SETTINGS, web=WebSettings())))
    assert not setup().serves_as(setup(replace(SETTINGS, trust=TrustSettings())))
    assert not setup().serves_as(setup(access=TokenAccess("another" * 6)))
    assert not setup(trusted=False).serves_as(setup())


@pytest.mark.parametrize(
    ("module", "folder", "fits"), [("base", "/a", True), ("arm", "/a", False), ("base", "/b", False)]
)
def test_a_server_fits_the_agent_whose_keys_it_has(module: str, folder: str, fits: bool) -> None:
    status = TrustStatus(on=True, module=module, folder=folder)
    for trusted in (True, False):
        made = WebSetup(SETTINGS, TOKEN, CertificateFiles(), trusted, "base", "/a")
        assert (made.fits(None), made.fits(status)) == (True, fits and trusted)


# --- over sockets -----------------------------------------------------------------------------------------------


@asynccontextmanager
async def connected() -> AsyncIterator[tuple[Any, Any]]:
    """A rosbridge client of a ruled server, and the core."""
    async with (
        running(TOKEN.token, RULED) as (server, core),
        aiohttp.ClientSession() as session,
        session.ws_connect(f"ws://127.0.0.1:{server.port}/rosbridge?token={TOKEN.token}") as client,
    ):
        yield client, core


async def asked(socket: Any, **request: object) -> dict[str, Any]:
    """The first answer to a request."""
    await socket.send_json(request)
    async with asyncio.timeout(DEADLINE):
        values: dict[str, Any] = json.loads((await socket.receive()).data)
        return values


TWIST = {"op": "advertise", "type": "geometry_msgs/Twist"}


async def test_a_client_hears_the_rule_of_what_it_may_not() -> None:
    async with connected() as (client, core):
        await client.send_json({**TWIST, "topic": "/cmd_vel"})
        await until(lambda: core.publishers("/cmd_vel"))
        refused = await asked(client, **{**TWIST, "topic": "/odom"})
        assert "web may not publish /odom; [[permission]] 2 denies" in refused["msg"]
        assert not core.publishers("/odom")
        said = await asked(client, op="subscribe", topic="/camera/image", type="std_msgs/String")
        assert "[[permission]] 2 denies subscribe of '/camera/**' to 'web'" in said["msg"]
        called = await asked(client, op="call_service", service="/motors/enable", type="std_srvs/Empty")
        assert called["result"] is False
        assert "web may not call /motors/enable" in called["values"]


async def test_a_parameter_is_found_and_read_where_the_rules_let_that_one_be_read() -> None:
    rule = PermissionRule(("web",), names={"param": ("/ours/**",)})
    rules = setup(replace(SETTINGS, trust=TrustSettings(rules=(rule,)))).rules
    async with (
        running(TOKEN.token, rules) as (server, core),
        aiohttp.ClientSession() as session,
        session.ws_connect(f"ws://127.0.0.1:{server.port}/rosbridge?token={TOKEN.token}") as client,
    ):
        core.call("setParam", "/setter", "/ours/speed", 3)
        core.call("setParam", "/setter", "/theirs", 4)

        async def ask(service: str, name: str) -> Any:
            answer = await asked(client, op="call_service", service=f"/rosapi/{service}", args={"name": name})
            return answer["values"]

        async with asyncio.timeout(DEADLINE):
            while await ask("get_param", "/ours") != {"value": '{"speed": 3}'}:
                pass
        assert await ask("search_param", "ours/speed") == {"global_name": "/ours/speed"}
        assert await ask("has_param", "/ours/none") == {"exists": False}
        for service, name in (("search_param", "theirs"), ("get_param", "/"), ("has_param", "/none")):
            assert "no [[permission]] lets web read or set" in await ask(service, name)


async def test_rosapi_shows_no_parameter_that_is_denied_and_changes_none() -> None:
    async with connected() as (boss, core):
        for name, value in (("/motors/pid", 3), ("/name", "base")):
            core.call("setParam", "/setter", name, value)

        async def ask(service: str, **args: str) -> Any:
            answer = await asked(boss, op="call_service", service=f"/rosapi/{service}", args=args)
            return answer["values"]

        async with asyncio.timeout(DEADLINE):
            while "/name" not in (names := (await ask("get_param_names"))["names"]):
                pass
        assert "/motors/pid" not in names
        assert "web may not param /motors/pid" in await ask("set_param", name="/motors/pid", value="9")
        assert core.call("getParam", "/setter", "/motors/pid").value == 3


@pytest.fixture
async def ruled(core: RosCore, request: pytest.FixtureRequest) -> AsyncIterator[Hub]:
    """A hub whose node has the rules of the test's parameter."""
    async with running_hub(core, request.param) as hub:
        yield hub


def answers_of(hub: Hub) -> Answers:
    return Answers(hub, ResourceWatch(hub), DiagnosticsFeed(hub, lambda: None), str, {})


@pytest.mark.parametrize("ruled", [RULED], indirect=True)
async def test_a_page_of_the_monitor_gets_no_denied_parameter_and_changes_none(ruled: Hub, talker: Node) -> None:
    await talker.set_param("/motors/pid", 3)
    await talker.set_param("/name", "base")
    await talker.advertise_service("/motors/enable", "std_srvs/Empty", lambda _: {})
    await until(lambda: ruled.params.value("/name") and ruled.params.value("/motors/pid"))
    await until(lambda: "/motors/enable" in ruled.graph.services)
    with closing(answers_of(ruled)) as answers:
        shown = await answers.answer("params", {})
        assert shown["values"]["name"] == "base"
        assert "motors" not in shown["values"]
        assert "/motors/pid" not in (await answers.answer("param_names", {}))["names"]
        for what, args in (
            ("set_param", {"name": "/motors/pid", "value": 4}),
            ("delete_param", {"name": "/motors"}),
            ("call", {"service": "/motors/enable"}),
        ):
            with pytest.raises(PeerRefused, match="web may not"):
                await answers.answer(what, args)
    assert await talker.get_param("/motors/pid") == 3


@pytest.mark.parametrize("ruled", [denying(subscribe=("/arm/**",))], indirect=True)
async def test_a_page_sees_nothing_of_topics_that_are_denied(ruled: Hub, talker: Node) -> None:
    with closing(ResourceWatch(ruled)) as resources:
        resources.start()
        for name in ("arm", "base"):
            publisher = await talker.advertise(f"/{name}/descriptor", TEXT, latch=True)
            descriptor = msgspec.json.encode(describe(Resource(name, role="acting"), talker.name)).decode()
            publisher.publish(TEXT.make({"data": descriptor}))
        await until(lambda: "/base" in resources.facts)
        assert "/arm" not in resources.facts


@pytest.mark.parametrize("ruled", [denying(log=("/arm/**",))], indirect=True)
async def test_a_page_sees_no_log_of_nodes_that_are_denied(ruled: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    async def agent(_self: Answers, op: str, **args: Any) -> Any:
        asked.append(f"{op} {args.get('node', '')}")
        lines = [
            {"n": n, "at": 1.0, "level": "info", "node": node, "text": "x"}
            for n, node in enumerate(("/driver", "/arm/hand"))
        ]
        return [{"module": "base", "lines": lines, "next": 9}, {"module": "arm", "lines": lines[1:], "next": 9}]

    monkeypatch.setattr(Answers, "ask_agent", agent)
    with closing(answers_of(ruled)) as answers:
        base, arm = await answers.answer("log", {"level": "info"})
        assert [line["node"] for line in base["lines"]] == ["/driver"]
        assert arm["lines"] == []
        assert "web may not log /arm/hand" in arm["problem"]
        for what in ("log_levels", "set_log_level"):
            with pytest.raises(PeerRefused, match="web may not log /arm/hand"):
                await answers.answer(what, {"name": "/arm/hand", "logger": "ros", "level": "debug"})
    assert asked == ["log "]


async def test_a_change_is_judged_by_the_cores_parameters_that_are_still_being_read(
    core: RosCore, talker: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, reading, go_on = Node.follow_param, asyncio.Event(), asyncio.Event()

    async def slow(self: Node, key: str) -> Any:
        reading.set()
        await go_on.wait()
        return await read(self, key)

    monkeypatch.setattr(Node, "follow_param", slow)
    await talker.set_param("/motors/limit", 3)
    async with running_hub(core, CAREFUL, until_known=False) as hub:
        await until(reading.is_set)
        boss, answers = FakeClient(hub), answers_of(hub)
        page = asyncio.ensure_future(answers.answer("delete_param", {"name": "/motors"}))
        for work in (boss.set_param("/motors", 5), boss.delete_param("/motors"), boss.set_param("/speed", 1)):
            boss.start(work)
        go_on.set()
        await until(lambda: len(boss.errors) == 2)
        assert all("web may not param /motors/limit" in str(error) for error in boss.errors)
        with pytest.raises(PeerRefused, match="web may not param /motors/limit"):
            await page
        await until(lambda: boss.results == [None])
        assert await talker.get_param("/motors") == {"limit": 3}
        answers.close()


@pytest.mark.parametrize("ruled", [CAREFUL], indirect=True)
async def test_a_peers_parameters_are_judged_by_what_the_peer_has(
    ruled: Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer = Parameters()
    peer.set("/", {"motors": {"limit": 3}, "speed": {"max": 1.5}})
    monkeypatch.setattr(questions, "PeerParams", lambda _client, _peer: peer)
    monkeypatch.setattr(questions, "choose_agent", lambda *_: SimpleNamespace(path=""))
    monkeypatch.setattr(questions, "ControlClient", lambda *_: nullcontext())
    with closing(answers_of(ruled)) as answers:

        async def ask(what: str, **args: object) -> Any:
            return await answers.answer(what, {"peer": "arm", **args})

        for what, args in (
            ("delete_param", {"name": "/motors"}),
            ("set_param", {"name": "/motors", "value": 5}),
            ("set_param", {"name": "/motors", "value": {"pid": 1}}),
            ("set_param", {"name": "/motors/limit/x", "value": 1}),
        ):
            with pytest.raises(PeerRefused, match="web may not param /motors/limit;"):
                await ask(what, **args)
        assert peer.get("/motors") == {"limit": 3}
        await ask("set_param", name="/speed/max", value=2)
        assert peer.get("/speed/max") == 2.0
        await ask("delete_param", name="/speed")
        assert [*peer.names()] == ["/motors/limit"]


class Authority:
    """The control socket of an authority at which ``arm`` is pending."""

    def __init__(self) -> None:
        self.asked: list[dict[str, Any]] = []

    def snapshot(self, **_: object) -> Snapshot:
        arm = snapshots.peer("arm", state="pending", link=None, invite="rmpa trust invite --module arm")
        return msgspec.structs.replace(
            snapshots.FULL, strangers=(arm, snapshots.peer("pc", state="foreign", link=None))
        )

    def call(self, _op: str, _kind: object, **args: Any) -> InviteReply:
        self.asked.append(args)
        return InviteReply(token=f"rmpa1-{len(self.asked)}", id=f"id{len(self.asked)}", expires=9)


@pytest.mark.parametrize("ruled", [RULED], indirect=True)
async def test_a_page_invites_pending_modules_alone_and_tells_no_log_the_token(
    ruled: Hub, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("DEBUG")
    authority = Authority()
    monkeypatch.setattr(questions, "choose_agent", lambda *_: SimpleNamespace(path=""))
    monkeypatch.setattr(questions, "ControlClient", lambda *_: nullcontext(authority))
    with closing(answers_of(ruled)) as answers:
        for name in ("pc", "base", "*", ""):
            with pytest.raises(RmpaError, match="is pending"):
                await answers.answer("invite", {"name": name})
        for number in (1, 2):
            told = await answers.answer("invite", {"name": "arm"})
            assert told == {"line": f"rmpa trust join rmpa1-{number}", "until": 9}
    assert authority.asked == [{"what": "invite", "name": "arm"}] * 2  # the authority replaces the open token
    assert questions.QUESTIONS["invite"] == "control"
    assert "rmpa1-" not in caplog.text
