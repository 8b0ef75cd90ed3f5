"""Permissions between whole agents: what crosses, what is refused, and what each side is told of it.

The links are plain: what makes a mesh secured has tests of its own. Here each agent is given its permissions as one
of a secured mesh is.
"""

from __future__ import annotations

from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING
from unittest import mock

import pytest

from rmpa.agent.agent import Agent, permission_notes
from rmpa.bridge.nodes import KILL, LIST, NODE_INFO, PING
from rmpa.config.peer_rules import Effect, PermissionRule
from rmpa.config.settings import NodeSettings, ServiceSettings, Settings, TrustSettings
from rmpa.core.contract import ContractRule, Transport
from rmpa.core.errors import PeerRefused
from rmpa.observe import limits as observe_limits
from rmpa.trust.permissions import Permissions
from tests.agent.test_agent import node, running, until
from tests.agent.test_services import serving
from tests.agent.test_why import ask, stopped_at

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.observe.why.diagnosis import Diagnosis


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observe_limits, "WHY_WINDOW", 0.2)


class SecuredAgent(Agent):
    """An agent whose permissions hold."""

    def __init__(self, its: Settings) -> None:
        super().__init__(its)
        self.bridge.gate.permissions = Permissions(its.trust)


@asynccontextmanager
async def secured(*all_settings: Settings) -> AsyncIterator[list[Agent]]:
    with mock.patch("tests.agent.test_agent.Agent", SecuredAgent):
        async with running(*all_settings) as agents:
            yield agents


def allow(modules: str, **names: str) -> PermissionRule:
    return PermissionRule(tuple(modules.split()), names={key: tuple(globs.split()) for key, globs in names.items()})


def deny(modules: str, **names: str) -> PermissionRule:
    return replace(allow(modules, **names), effect=Effect.DENY)


def with_rules(made: Settings, *rules: PermissionRule) -> Settings:
    return replace(made, trust=TrustSettings(rules=rules))


def stage(found: tuple[Diagnosis, ...], name: str) -> str:
    return next(stage.text for one in found for stage in one.stages if stage.name == name)


async def test_why_tells_nothing_of_topics_and_services_that_the_asker_may_not_have(
    settings: Callable[..., Settings],
) -> None:
    a_settings = with_rules(settings("a"), allow("b", subscribe="/odom", call="/stop"))
    async with secured(a_settings, with_rules(settings("b"))) as (a, b), node("talker", a) as talker:
        await talker.advertise("/secret", "std_msgs/String")
        async with serving(a, "/open_door"):
            for real, made_up in (("/secret", "/secrex"), ("/open_door", "/open_doox")):
                for peer in ("a", None):
                    answers = [
                        [
                            (one.kind, one.node, str(one.failed).replace(name, "NAME"))
                            for one in await ask(b, name, peer)
                        ]
                        for name in (real, made_up)
                    ]
                    assert answers[0] == answers[1]
                    said = str(answers[0])
                    assert "the permissions of a do not let b" in said
                    assert "talker" not in said
                    assert "adder" not in said


async def test_services_are_shown_and_called_only_as_both_sides_permit(
    settings: Callable[..., Settings],
) -> None:
    a_settings = with_rules(settings("a"), allow("b", call="/add"))
    b_settings = with_rules(settings("b"), allow("a", serve="/add"))
    async with secured(a_settings, b_settings) as (a, b), serving(a, "/add"), serving(a, "/other", "/other_node"):

        def here(service: str) -> bool:
            return service in b.core.state().services

        await until(lambda: here("/add"))
        assert not here("/other")
        assert stage(await ask(b, "/add", "a"), "permission there") == "a lets b call it"
        a.apply_settings(with_rules(a_settings, allow("b", call="/other")))
        await until(lambda: not here("/add"))
        texts = [d.failed.text for d in await ask(b, "/add", "a") if d.failed is not None]
        assert texts == ["the permissions of a do not let b subscribe to /add, nor call it if it is a service"]
        peer = next(iter(b.bridge.sessions.linked())).peer
        await until(lambda: b.services.imports.get(peer, "/other"))
        assert not here("/other")
        assert stopped_at(await ask(b, "/other", "a")) == (
            "permission here",
            "a may not serve /other here: no [[permission]] lets a serve /other",
        )
        assert b.bridge.counters["permission.serve"] == 1
        b.apply_settings(with_rules(b_settings, allow("a", serve="/**")))
        await until(lambda: here("/other"))


async def test_nodes_and_names_of_which_a_module_may_have_nothing_are_not_there_for_it(
    settings: Callable[..., Settings],
) -> None:
    a_settings = with_rules(settings("a"), allow("b", subscribe="/odom", publish="/cmd_vel"))
    async with (
        secured(a_settings, with_rules(settings("b"))) as (a, b),
        node("base", a) as base,
        node("secret_driver", a) as secret,
    ):
        for topic in ("/odom", "/secret"):
            await base.advertise(topic, "std_msgs/String")
        for topic in ("/cmd_vel", "/hidden"):
            await base.subscribe(topic, "std_msgs/String", lambda _: None)
        await secret.advertise("/secret", "std_msgs/String")
        link = next(iter(b.bridge.sessions.linked()))
        (line,) = await b.bridge.rpc.request(link, LIST, {})
        assert (line["name"], line["publications"], line["subscriptions"]) == ("/base", 1, 1)
        assert (await b.bridge.rpc.request(link, PING, {"node": "/base"}))["pid"]
        facts = await b.bridge.rpc.request(link, NODE_INFO, {"node": "/base"})
        assert (list(facts["publications"]), list(facts["subscriptions"])) == (["/odom"], ["/cmd_vel"])
        assert facts["services"] == []
        for what in (PING, NODE_INFO):
            said = []
            for name in ("/secret_driver", "/secret_drivex"):
                with pytest.raises(PeerRefused) as refused:
                    await b.bridge.rpc.request(link, what, {"node": name})
                said.append(refused.value.reason.replace(name, "NAME"))
            assert said == ["a has no node NAME"] * 2


async def test_nodes_are_ended_only_with_permission(settings: Callable[..., Settings]) -> None:
    nodes = NodeSettings(kill=("/**",))
    a_settings = replace(with_rules(settings("a"), allow("b", kill="/demo/**")), nodes=nodes)
    async with secured(a_settings, with_rules(settings("b"))) as (a, b), node("vital", a) as vital:
        await vital.advertise("/x", "std_msgs/String")
        link = next(iter(b.bridge.sessions.linked()))
        with pytest.raises(PeerRefused, match="the permissions there do not let b end /vital"):
            await b.bridge.rpc.request(link, KILL, {"node": "/vital"})
        assert a.bridge.counters["permission.kill"] == 1
        assert "/vital" in a.core.state().nodes


def test_the_start_says_that_permissions_without_trust_have_no_effect_and_what_is_relayed_with_it() -> None:
    ruled = with_rules(Settings(name="a"), allow("b", publish="/x"))
    direct = replace(
        Settings(name="a"),
        contracts=(ContractRule(("/a",), (), {"transport": Transport.DIRECT}),),
        services=ServiceSettings(transport=Transport.DIRECT),
    )
    (note,) = permission_notes(ruled, secured=False)
    assert note.startswith("[[permission]] has no effect: this module has not joined a secured mesh")
    (note,) = permission_notes(direct, secured=True)
    assert note.startswith('[[contract]] and [services] ask for transport "direct"')
    assert not list(permission_notes(replace(direct, trust=TrustSettings(direct=True)), secured=True))
    for secure in (False, True):
        assert not list(permission_notes(Settings(name="a"), secured=secure))
    assert not list(permission_notes(ruled, secured=True))
