"""Roles of web clients: what a token may do by its role and by the rules of ``[[permission]]``."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager, nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import aiohttp
import msgspec
import pytest

from rmpa.config.permission_rules import Access, Effect, ModuleGroup, PermissionRule
from rmpa.config.settings import Settings, TrustSettings, WebSettings
from rmpa.config.web_tokens import WebRole, WebToken
from rmpa.core.errors import PeerRefused
from rmpa.ros.environment import RosEnvironment
from rmpa.ros.master.parameters import Parameters
from rmpa.ros.node.node import Node
from rmpa.trust.permissions import Permissions
from rmpa.web.gateways.frame_writer import FrameSocket
from rmpa.web.gateways.gateways import Gateways
from rmpa.web.hub.hub import Hub
from rmpa.web.hub.requests import DeleteParam, ParamsChanged, SetParam
from rmpa.web.hub.rights import FULL, READ_ONLY, ClientRules, Rights
from rmpa.web.monitor.io import questions
from rmpa.web.monitor.io.questions import Answers
from rmpa.web.monitor.io.resource_watch import ResourceWatch
from rmpa.web.monitor.io.values import MessageValues
from rmpa.web.monitor.session import Question
from rmpa.web.server.agent_watch import AgentWatch
from rmpa.web.server.app import CLIENT
from rmpa.web.server.auth import AccessPolicy, own_names
from rmpa.web.server.hub_setup import make_hub
from rmpa.web.server.roles import WebRoles
from rmpa.web.server.server import WebServer
from tests.ros.node.peers import DEADLINE, until
from tests.web.hub.client import FakeClient, local_core, node, running_hub
from tests.web.snapshots import FULL as SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.web.hub.requests import ParamValue

RULES = (
    PermissionRule(groups=("operators",), names={"publish": ("/cmd_vel",), "param": ("/speed/**",)}),
    PermissionRule(groups=("operators",), names={"call": ("/arm/**",), "serve": ("/map",)}),
    PermissionRule(("*",), effect=Effect.DENY, names={"call": ("/motors/**",), "param": ("/motors/**",)}),
    PermissionRule(("wall",), effect=Effect.DENY, names={"subscribe": ("/camera/**",)}),
)
TOKENS = (
    WebToken("wall"),
    WebToken("tablet", WebRole.OPERATOR, ("operators",)),
    WebToken("laptop2", WebRole.OPERATOR),
    WebToken("guest", WebRole.OPERATOR),
    WebToken("boss", WebRole.ADMIN),
)
SETTINGS = Settings(
    web_tokens=TOKENS, trust=TrustSettings(groups=(ModuleGroup("operators", ("laptop*",)),), rules=RULES)
)
ROLES = WebRoles(SETTINGS, has_token=True, trusted=True)
_LIMIT = PermissionRule(("*",), effect=Effect.DENY, names={"param": ("/motors/limit",)})
_ALL_BUT_LIMIT = ClientRules("careful", Permissions(TrustSettings(default="allow", rules=(_LIMIT,))))
CAREFUL = replace(FULL, look=_ALL_BUT_LIMIT, change=_ALL_BUT_LIMIT)
"""May change every parameter but one, not the namespace around it."""
TREE: dict[str, ParamValue] = {"speed": {"max": 1.5}, "motors": {"pid": {"p": 3}}, "name": "base"}


def value_of(name: str) -> ParamValue:
    value: ParamValue = TREE
    for part in filter(None, name.split("/")):
        if not isinstance(value, dict) or part not in value:
            return None
        value = value[part]
    return value


def may(client: str, access: Access, name: str) -> bool:
    """Whether a client may do something, by its role's kind of act and by the rules."""
    rights = ROLES.of(client)
    kind = {Access.PUBLISH: rights.publish, Access.CALL: rights.call_services, Access.SERVE: rights.serve_services}
    try:
        (rights.check_look if access is Access.SUBSCRIBE else rights.check_change)(access, name)
    except PeerRefused:
        return False
    return access is Access.SUBSCRIBE or kind[access]


@pytest.mark.parametrize(
    ("access", "name", "allowed"),
    [
        (Access.PUBLISH, "/cmd_vel", {"tablet", "laptop2", "boss"}),
        (Access.PUBLISH, "//cmd_vel/", {"tablet", "laptop2", "boss"}),
        (Access.PUBLISH, "/odom", {"boss"}),
        (Access.CALL, "/arm/stop", {"tablet", "laptop2", "boss"}),
        (Access.CALL, "/motors/enable", set()),
        (Access.CALL, "/motors//enable", set()),
        (Access.CALL, "motors/enable", set()),
        (Access.SERVE, "/map", {"tablet", "laptop2", "boss"}),
        (Access.SUBSCRIBE, "/odom", {"wall", "tablet", "laptop2", "guest", "boss"}),
        (Access.SUBSCRIBE, "/camera/image", {"tablet", "laptop2", "guest", "boss"}),
    ],
)
def test_the_rules_decide_what_a_token_may(access: Access, name: str, allowed: set[str]) -> None:
    assert {token.name for token in TOKENS if may(token.name, access, name)} == allowed


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
    rights = ROLES.of("boss")
    if not refused:
        rights.check_param_change(name, value_of, after)
        return
    with pytest.raises(PeerRefused, match=f"may not param {refused};") as caught:
        rights.check_param_change(name, value_of, after)
    assert "[[permission]] 3 denies param of '/motors/**' to '*'" in str(caught.value)


@pytest.mark.parametrize("key", ["", "/", "/motors/pid/p", "max/", "a/b"])
def test_a_key_that_a_core_takes_for_another_name_is_refused(key: str) -> None:
    for client in ("boss", "tablet"):
        values: tuple[ParamValue, ...] = ({key: 99}, {"inner": {key: 99}})
        for value in values:
            with pytest.raises(PeerRefused, match="is not one part of a name"):
                ROLES.of(client).check_param_change("/speed", value_of, value)
    Rights().check_param_change("/speed", value_of, {key: 99})


def test_an_operator_changes_only_parameters_that_a_rule_allows() -> None:
    ROLES.of("tablet").check_param_change("/speed/max", value_of, 2.0)
    with pytest.raises(PeerRefused, match=r"no .*permission.* lets tablet"):
        ROLES.of("tablet").check_param_change("/name", value_of, "arm")
    assert not ROLES.of("wall").set_parameters


def test_denied_parameters_are_not_shown() -> None:
    for client in ("wall", "tablet", "boss"):
        rights = ROLES.of(client)
        assert rights.visible_tree(TREE) == {"speed": {"max": 1.5}, "name": "base"}
        assert rights.visible({"/motors/pid/p": 3, "/name": "base"}) == {"/name": "base"}
    assert Rights().visible_tree(TREE) is TREE


def test_an_unknown_client_only_looks() -> None:
    assert ROLES.of("gone") is READ_ONLY


def test_the_servers_own_token_may_what_the_settings_say() -> None:
    def own(*, has_token: bool, control: bool, drive: bool = False) -> Rights:
        settings = Settings(web=WebSettings(control=control, drive=drive))
        return WebRoles(settings, has_token=has_token, trusted=False).of("")

    assert own(has_token=False, control=True) is READ_ONLY
    assert own(has_token=True, control=True) == FULL
    readers = own(has_token=True, control=False)
    assert readers.read_parameters
    assert (readers.publish, readers.call_services, readers.set_parameters, readers.serve_services) == (False,) * 4
    assert not readers.drive
    assert own(has_token=True, control=False, drive=True).drive
    assert not own(has_token=False, control=True, drive=True).drive


def test_in_a_secured_mesh_a_denial_holds_for_the_servers_own_token_too() -> None:
    settings = replace(SETTINGS, web=WebSettings(control=True))
    rights = WebRoles(settings, has_token=True, trusted=True).of("")
    rights.check_change(Access.PUBLISH, "/odom")
    with pytest.raises(PeerRefused, match="the client web may not call /motors/enable"):
        rights.check_change(Access.CALL, "/motors/enable")
    WebRoles(settings, has_token=True, trusted=False).of("").check_change(Access.CALL, "/motors/enable")


# --- over sockets -----------------------------------------------------------------------------------------------


class Site:
    """A server whose clients have tokens ``NAME-secret``."""

    def __init__(self) -> None:
        self.roles = ROLES


@asynccontextmanager
async def running(site: Site) -> AsyncIterator[tuple[WebServer, Gateways, Any]]:
    async with local_core() as core:
        agent = msgspec.structs.replace(SNAPSHOT.agent, core_uri=core.uri)
        watch = AgentWatch(lambda: msgspec.structs.replace(SNAPSHOT, agent=agent))
        hub = make_hub(watch, 8480)
        gateways = Gateways(hub, "test", lambda request: site.roles.of(request[CLIENT]))
        clients = tuple((token.name, f"{token.name}-secret") for token in TOKENS)
        policy = AccessPolicy(0, own_names(("base",)), "the-servers-own", clients=clients)
        server = WebServer(watch, policy, "127.0.0.1", gateways)
        try:
            async with hub:
                await server.start()
                yield server, gateways, core
                await gateways.close()
        finally:
            await server.close()


async def asked(socket: Any, **request: object) -> dict[str, Any]:
    """The first answer to a request."""
    await socket.send_json(request)
    async with asyncio.timeout(DEADLINE):
        values: dict[str, Any] = json.loads((await socket.receive()).data)
        return values


def connect(session: aiohttp.ClientSession, server: WebServer, client: str) -> Any:
    headers = {"Authorization": f"Bearer {client}-secret"}
    return session.ws_connect(f"ws://127.0.0.1:{server.port}/rosbridge", headers=headers)


TWIST = {"op": "advertise", "type": "geometry_msgs/Twist"}


async def test_a_client_does_what_its_token_may_and_hears_the_rule_of_what_it_may_not() -> None:
    async with running(Site()) as (server, _, core), aiohttp.ClientSession() as session:
        async with connect(session, server, "tablet") as tablet:
            await tablet.send_json({**TWIST, "topic": "/cmd_vel"})
            await until(lambda: core.publishers("/cmd_vel"))
            refused = await asked(tablet, **{**TWIST, "topic": "/odom"})
            assert "the client tablet may not publish /odom; no [[permission]] lets tablet" in refused["msg"]
            assert not core.publishers("/odom")
        async with connect(session, server, "wall") as wall:
            assert "may not publish" in (await asked(wall, **{**TWIST, "topic": "/cmd_vel"}))["msg"]
            said = await asked(wall, op="subscribe", topic="/camera/image", type="std_msgs/String")
            assert "[[permission]] 4 denies subscribe of '/camera/**' to 'wall'" in said["msg"]


async def test_rosapi_shows_no_parameter_that_is_denied() -> None:
    async with (
        running(Site()) as (server, _, core),
        node(core, "setter") as setter,
        aiohttp.ClientSession() as session,
        connect(session, server, "boss") as boss,
    ):
        await setter.set_param("/motors/pid", 3)
        await setter.set_param("/name", "base")

        async def names() -> list[str]:
            found = await asked(boss, op="call_service", service="/rosapi/get_param_names", args={})
            listed: list[str] = found["values"]["names"]
            return listed

        async with asyncio.timeout(DEADLINE):
            while "/name" not in await names():
                pass
        assert "/motors/pid" not in await names()
        await boss.send_json(
            {"op": "call_service", "service": "/rosapi/set_param", "args": {"name": "/motors/pid", "value": "9"}}
        )
        async with asyncio.timeout(DEADLINE):
            answer = (await boss.receive()).data
        assert "the client boss may not param /motors/pid" in answer
        assert await setter.get_param("/motors/pid") == 3


async def test_a_page_of_the_monitor_gets_no_denied_parameter_and_changes_none() -> None:
    async with local_core() as core, running_hub(core) as hub, node(core, "setter") as setter:
        await setter.set_param("/motors/pid", 3)
        await setter.set_param("/name", "base")
        await until(lambda: hub.params.value("/name") and hub.params.value("/motors/pid"))
        resources = ResourceWatch(hub, MessageValues(hub))
        answers = Answers(hub, resources, {}, lambda: "")

        async def ask(what: str, client: str, **args: object) -> Any:
            return await answers.answer(Question(1, what, args), ROLES.of(client))

        shown = await ask("params", "boss")
        assert shown["values"] == {"name": "base"} | {k: v for k, v in shown["values"].items() if k != "name"}
        assert "motors" not in shown["values"]
        assert await ask("params", "boss", has=shown["digest"]) == {"digest": shown["digest"]}
        assert "/motors/pid" not in (await ask("param_names", "boss"))["names"]
        resources.record("WARN", "the lens is hot", 1.0, resource="/camera")
        assert [each["text"] for each in await ask("history", "boss")] == ["the lens is hot"]
        assert await ask("history", "wall") == []
        for what, args in (
            ("set_param", {"name": "/motors/pid", "value": 4}),
            ("delete_param", {"name": "/motors"}),
            ("call", {"service": "/motors/enable"}),
            ("profile", {"resource": "/motors", "choice": "fast"}),
        ):
            with pytest.raises(PeerRefused, match="the client boss may not"):
                await ask(what, "boss", **args)
        assert await setter.get_param("/motors/pid") == 3
        answers.close()


async def test_a_change_is_judged_by_the_cores_parameters_that_are_still_being_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    read, reading, go_on = Node.follow_param, asyncio.Event(), asyncio.Event()

    async def slow(self: Node, key: str) -> Any:
        reading.set()
        await go_on.wait()
        return await read(self, key)

    async def where() -> str:
        return core.uri

    def made(uri: str, updated: Any) -> Node:
        return Node("rmpa_web", master_uri=uri, environment=RosEnvironment(), on_param_update=updated)

    monkeypatch.setattr(Node, "follow_param", slow)
    async with local_core() as core, node(core, "setter") as setter, Hub(where, made) as hub:
        await setter.set_param("/motors/limit", 3)
        hub.start()
        await until(reading.is_set)
        boss = FakeClient(hub, CAREFUL)
        answers = Answers(hub, ResourceWatch(hub, MessageValues(hub)), {}, lambda: "")
        question = Question(1, "delete_param", {"name": "/motors"})
        page = asyncio.ensure_future(answers.answer(question, CAREFUL))
        for request in (SetParam(1, "/motors", 5), DeleteParam(2, "/motors"), SetParam(3, "/speed", 1)):
            boss.ask(request)
        go_on.set()
        for handle in (1, 2):
            assert "the client careful may not param /motors/limit" in (await boss.failure(handle)).error
        with pytest.raises(PeerRefused, match="the client careful may not param /motors/limit"):
            await page
        await boss.answer(ParamsChanged, 3)
        assert await setter.get_param("/motors") == {"limit": 3}
        boss.close()
        answers.close()


class Peer:
    """The parameters of a peer, in the place of ``PeerParams``."""

    def __init__(self) -> None:
        self.tree = Parameters()
        self.tree.set("/", {"motors": {"limit": 3}, "speed": {"max": 1.5}})

    def names(self) -> list[str]:
        return [*self.tree.names()]

    def get(self, key: str) -> Any:
        return self.tree.get(key)

    def set(self, key: str, value: Any) -> None:
        self.tree.set(key, value)

    def delete(self, key: str) -> None:
        self.tree.delete(key)


async def test_a_peers_parameters_are_judged_by_what_the_peer_has(monkeypatch: pytest.MonkeyPatch) -> None:
    peer = Peer()
    monkeypatch.setattr(questions, "PeerParams", lambda _client, _peer: peer)
    monkeypatch.setattr(Answers, "_control", lambda _self: nullcontext())
    async with local_core() as core, running_hub(core) as hub:
        answers = Answers(hub, ResourceWatch(hub, MessageValues(hub)), {}, lambda: "")

        async def ask(what: str, rights: Rights, **args: object) -> Any:
            return await answers.answer(Question(1, what, {"peer": "arm", **args}), rights)

        for what, args in (
            ("delete_param", {"name": "/motors"}),
            ("set_param", {"name": "/motors", "value": 5}),
            ("set_param", {"name": "/motors", "value": {"pid": 1}}),
            ("set_param", {"name": "/motors/limit/x", "value": 1}),
        ):
            with pytest.raises(PeerRefused, match="the client careful may not param /motors/limit;"):
                await ask(what, CAREFUL, **args)
        assert peer.get("/motors") == {"limit": 3}
        await ask("set_param", CAREFUL, name="/speed/max", value=2)
        assert peer.get("/speed/max") == 2.0
        await ask("delete_param", CAREFUL, name="/speed")
        await ask("delete_param", FULL, name="/motors")
        assert peer.names() == []
        answers.close()


@pytest.mark.parametrize("step", ["settling", "handshake"])
async def test_a_client_that_connects_while_rights_change_keeps_none_of_the_old(
    step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting, go_on, settled, prepare = asyncio.Event(), asyncio.Event(), Hub.settled, FrameSocket.prepare

    async def slow_settled(self: Hub, timeout: float) -> bool:
        waiting.set()
        await go_on.wait()
        return await settled(self, timeout)

    async def slow_prepare(self: FrameSocket, request: Any) -> Any:
        waiting.set()
        await go_on.wait()
        return await prepare(self, request)

    if step == "settling":
        monkeypatch.setattr(Hub, "settled", slow_settled)
    else:
        monkeypatch.setattr(FrameSocket, "prepare", slow_prepare)
    site = Site()
    async with running(site) as (server, gateways, core), aiohttp.ClientSession() as session:
        connecting = asyncio.ensure_future(connect(session, server, "tablet"))
        await until(waiting.is_set)
        site.roles = WebRoles(replace(SETTINGS, web_tokens=()), has_token=True, trusted=True)
        await gateways.end_changed()
        go_on.set()
        tablet = await connecting
        await tablet.send_json({**TWIST, "topic": "/cmd_vel"})
        async with asyncio.timeout(DEADLINE):
            message = await tablet.receive()
        if step == "settling":
            assert "may not publish" in json.loads(message.data)["msg"]
        else:
            assert (message.type, tablet.close_code) == (aiohttp.WSMsgType.CLOSE, 1012)
        assert not core.publishers("/cmd_vel")
        await tablet.close()


async def test_clients_whose_rights_change_are_disconnected_and_others_stay() -> None:
    site = Site()
    async with (
        running(site) as (server, gateways, core),
        aiohttp.ClientSession() as session,
        connect(session, server, "tablet") as tablet,
    ):
        await tablet.send_json({**TWIST, "topic": "/cmd_vel"})
        await until(lambda: core.publishers("/cmd_vel"))
        assert await gateways.end_changed() == 0
        site.roles = WebRoles(replace(SETTINGS, web_tokens=()), has_token=True, trusted=True)
        closing = asyncio.ensure_future(gateways.end_changed())
        async with asyncio.timeout(DEADLINE):
            assert (await tablet.receive()).type is aiohttp.WSMsgType.CLOSE
        assert tablet.close_code == 1012
        assert await closing == 1
        async with connect(session, server, "tablet") as again:  # its token is still known to this server's policy
            assert "may not publish" in (await asked(again, **{**TWIST, "topic": "/cmd_vel"}))["msg"]
