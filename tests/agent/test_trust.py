"""Secured modules, as whole agents on loopback: joined, linked over TLS, renewed, revoked."""

from __future__ import annotations

import asyncio
import os
import time
from contextlib import AsyncExitStack
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import pytest

pytest.importorskip("cryptography")

from rmpa.agent.agent import Agent
from rmpa.agent.trust import RENEW, AgentTrust, trust_store
from rmpa.config.settings import Settings, TrustSettings, WebSettings
from rmpa.config.values import Multicast
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, StartError
from rmpa.ros.node.node import Node
from rmpa.trust import limits
from rmpa.trust import store as files_of
from rmpa.trust.joining import join_mesh
from rmpa.trust.membership import found_mesh
from rmpa.trust.permissions import HAVE, page_hosts
from rmpa.trust.tokens import Token
from tests.agent.test_agent import DEADLINE, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from rmpa.trust.store import MemberFiles


def trust_of(agent: Agent) -> AgentTrust:
    assert agent.trust is not None
    return agent.trust


def peers_of(agent: Agent) -> set[str]:
    return {session.link.name for session in agent.bridge.sessions.linked()}


@dataclass
class Fleet:
    """Modules of one test: their settings, and those that run."""

    folder: Path
    agents: dict[str, Agent] = field(default_factory=dict)

    def settings(self, name: str, **parts: object) -> Settings:
        common = Settings(
            name=name,
            core_port=0,
            interfaces=("lo",),
            multicast=Multicast(port=20000 + os.getpid() % 20000),
            runtime_dir=str(self.folder / "run"),
            state_dir=str(self.folder / "state"),
            trust=TrustSettings(default="allow"),
        )
        return replace(common, **parts)  # type: ignore[arg-type]

    def found(self, name: str = "base") -> None:
        store = trust_store(self.settings(name))
        assert store is not None
        found_mesh(store, name, "lab", time.time())

    async def start(self, name: str, **parts: object) -> Agent:
        agent = Agent(self.settings(name, **parts))
        await agent.start()
        self.agents[name] = agent
        return agent

    async def stop(self, name: str) -> None:
        await self.agents.pop(name).close()

    async def command(self, agent: str, what: str, **args: object) -> object:
        return await self.agents[agent].trust_commands.answer_command({"what": what, **args})

    async def token(self, **args: object) -> Token:
        reply = await self.command("base", "invite", **args)
        return Token.parse(reply.token)  # type: ignore[attr-defined]

    async def join(self, name: str, token: Token | None = None) -> MemberFiles:
        token = token or await self.token()
        files = await join_mesh(token, name)
        store = trust_store(self.settings(name))
        assert store is not None
        store.save(files)
        return files

    async def add(self, name: str, **parts: object) -> Agent:
        """A module that joins and runs."""
        await self.join(name)
        return await self.start(name, **parts)

    async def linked(self, *names: str) -> None:
        """Wait until these modules are linked with each other, and with no other one."""
        await until(lambda: all(peers_of(self.agents[name]) == set(names) - {name} for name in names))


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[Fleet]:
    """Modules of which the first one, base, is the authority and runs."""
    fleet = Fleet(tmp_path)
    fleet.found()
    try:
        await fleet.start("base")
        yield fleet
    finally:
        for name in list(fleet.agents):
            await fleet.stop(name)


async def test_modules_that_joined_are_linked_over_tls_also_while_the_group_key_changes(fleet: Fleet) -> None:
    async with AsyncExitStack() as stack:
        arm = await fleet.add("arm")
        await fleet.linked("base", "arm")
        base = fleet.agents["base"]
        for agent in (base, arm):
            [session] = agent.bridge.sessions.linked()
            assert session.link.connection.certificate is not None
        talker = await stack.enter_async_context(Node("talker", master_uri=arm.core.uri))
        hearer = await stack.enter_async_context(Node("hearer", master_uri=base.core.uri))
        heard: list[str] = []
        publisher = await talker.advertise("/chatter", "std_msgs/String")
        await hearer.subscribe("/chatter", "std_msgs/String", lambda got: heard.append(got.message.data))
        await until(lambda: publisher.subscribers)
        publisher.publish(publisher.make({"data": "over TLS"}))
        await until(lambda: heard == ["over TLS"])
        links = [session.link for session in arm.bridge.sessions.linked()]
        await fleet.command("base", "rotate")
        member = trust_of(arm).membership
        await until(lambda: member.ring.newest.number == 2)
        assert [session.link for session in arm.bridge.sessions.linked()] == links


async def test_a_revoked_module_is_gone_everywhere_at_once_until_it_has_a_new_token(fleet: Fleet) -> None:
    async with AsyncExitStack() as stack:
        for name in ("arm", "stick", "thief"):
            await fleet.add(name)
        await fleet.linked("base", "arm", "stick", "thief")
        thief = await stack.enter_async_context(Node("talker", master_uri=fleet.agents["thief"].core.uri))
        await thief.advertise("/cmd_vel", "std_msgs/String")
        honest = [fleet.agents[name] for name in ("base", "arm", "stick")]
        await until(lambda: all("/cmd_vel" in agent.core.state().publishers for agent in honest))
        began = time.monotonic()
        await fleet.command("base", "revoke", name="thief")
        await until(lambda: all("thief" not in peers_of(agent) for agent in honest))
        await until(lambda: not any("/cmd_vel" in agent.core.state().publishers for agent in honest))
        assert time.monotonic() - began < 5.0  # some 50 ms, but for a busy machine; without the notice it is hours
        await fleet.linked("base", "arm", "stick")  # … and nothing else has fallen
        await until(lambda: all(trust_of(agent).membership.keys.number == 2 for agent in honest))
        assert trust_of(fleet.agents["thief"]).membership.keys.number == 1  # it did not get the new key
        again = Agent(fleet.settings("thief"))
        await fleet.stop("thief")
        await again.start()
        try:
            await until(lambda: _refusals(fleet.agents["base"], "revoked") or _refusals(again, "revoked"))
            assert not peers_of(again)
        finally:
            await again.close()
        await fleet.add("thief")
        await fleet.linked("base", "arm", "stick", "thief")


def _refusals(agent: Agent, word: str) -> int:
    return agent.snapshots.build().counters.get(f"link.refused.{word}", 0)


async def test_a_module_that_was_away_learns_of_a_revocation_from_any_member(fleet: Fleet) -> None:
    for name in ("arm", "stick", "thief"):
        await fleet.add(name)
    await fleet.linked("base", "arm", "stick", "thief")
    await fleet.stop("stick")
    await fleet.command("base", "revoke", name="thief")
    await fleet.linked("base", "arm")
    await fleet.stop("base")  # the authority is off: arm tells stick
    stick = await fleet.start("stick")
    await until(lambda: "arm" in peers_of(stick))
    member = trust_of(stick).membership
    await until(lambda: member.deny.number == 1)
    await until(lambda: "thief" not in peers_of(stick))
    assert member.ring.newest.number == 2


async def test_a_certificate_is_renewed_over_the_link_by_itself_in_time_and_not_too_often(fleet: Fleet) -> None:
    arm = await fleet.add("arm")
    await fleet.linked("base", "arm")
    trust = trust_of(arm)
    await until(lambda: trust.authority_name() == "base")
    before = trust.membership.certificate
    await fleet.command("arm", "renew")
    assert trust.membership.certificate.serial != before.serial
    await fleet.command("base", "renew")
    # After half of its time it is renewed without a command.
    serial = trust.membership.certificate.serial
    past = {"issued": before.issued - 4 * 86_400, "expires": before.expires - 4 * 86_400}
    trust.membership.certificate = replace(trust.membership.certificate, **past)  # type: ignore[arg-type]
    trust.look_now()
    await until(lambda: trust.membership.certificate.serial not in (serial, before.serial))
    assert peers_of(arm) == {"base"}

    async def renew_often() -> None:
        for _ in range(limits.RENEWALS_BURST + 1):
            await fleet.command("arm", "renew")

    with pytest.raises(RmpaError, match="asks for certificates too often"):
        await renew_often()


async def test_a_member_that_says_it_is_the_authority_is_not_believed_and_does_not_fill_the_log(
    fleet: Fleet, caplog: pytest.LogCaptureFixture
) -> None:
    arm, thief = await fleet.add("arm"), await fleet.add("thief")
    await fleet.linked("base", "arm", "thief")
    trust = trust_of(arm)
    await until(lambda: trust.authority_name() == "base")
    await fleet.stop("base")
    await fleet.linked("arm", "thief")
    [session] = [each for each in thief.bridge.sessions.linked() if each.link.name == "arm"]
    for _ in range(50):
        thief.bridge.rpc.notify(session, "trust.deny", {"document": "{}"})
        thief.bridge.rpc.notify(session, HAVE, {"deny": 0, "keys": 1, "authority": True})
    with pytest.raises(RmpaError, match="not the authority"):  # behind this answer the lie was heard
        await thief.bridge.rpc.request(session, RENEW, {"request": ""}, DEADLINE)
    assert trust.authority_name() == ""
    place = trust.membership.store.load_authority()
    assert place is not None
    assert place.name == "base"
    counted = (arm.bridge.counters["trust.no_authority"], arm.bridge.counters["trust.document_refused"])
    assert counted == (50, 50)
    lines = [text for text in caplog.messages if "does not hold" in text or "it is not" in text]
    assert 2 <= len(lines) < 20


async def test_a_module_that_missed_changes_of_the_group_key_is_linked_again(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    await fleet.add("arm")
    await fleet.linked("base", "arm")
    await fleet.stop("arm")
    monkeypatch.setattr(limits, "KEY_SPREAD", 0.0)
    monkeypatch.setattr(limits, "KEY_OVERLAP", 0.0)
    for _ in range(3):
        await fleet.command("base", "rotate")
    arm = await fleet.start("arm")  # it does not know the key that base signs with
    await fleet.linked("base", "arm")
    member = trust_of(arm).membership
    await until(lambda: member.ring.newest.number == 4)


async def test_the_user_who_invites_is_told_what_came_of_the_token(fleet: Fleet) -> None:
    token = await fleet.token(name="arm")
    asked = asyncio.ensure_future(fleet.command("base", "step", id=token.token_id.hex(), after=0))
    with pytest.raises(PeerRefused, match=r"\(name\); join with the --name that it is for"):
        await join_mesh(token, "leg")
    step = await asked
    assert (step.step, step.state, step.module, step.reason) == (1, "refused", "leg", "name")  # type: ignore[attr-defined]
    await join_mesh(token, "arm")
    step = await fleet.command("base", "step", id=token.token_id.hex(), after=1)
    assert (step.step, step.state, step.module) == (2, "joined", "arm")  # type: ignore[attr-defined]


async def test_only_the_authority_invites_and_revokes_and_the_snapshot_shows_who_it_is(fleet: Fleet) -> None:
    arm = await fleet.add("arm")
    await fleet.linked("base", "arm")
    await until(trust_of(arm).authority_name)
    for what in ("invite", "revoke", "rotate", "sign"):
        with pytest.raises(PeerRefused, match="not the authority of its mesh; do it at base"):
            await fleet.command("arm", what, name="base")
    for name, words in (("base", "is the authority itself"), ("amr", "did you mean arm?")):
        with pytest.raises(ConfigError, match=words):
            await fleet.command("base", "revoke", name=name)
    base = fleet.agents["base"]
    shown = base.snapshots.build()
    assert shown.trust is not None
    assert (shown.trust.module, shown.trust.is_authority, shown.trust.clock_set) == ("base", True, True)
    assert {member.name: member.linked for member in shown.trust.members} == {"arm": True, "base": True}
    assert shown.notes == ()
    member = trust_of(base).membership
    for changed, note in (
        ({"expires": time.time() + 3600}, "ends in 1 h, and could not be renewed"),
        ({"issued": time.time() + 86_400}, "clock is not set"),
    ):
        member.certificate = replace(member.certificate, **changed)  # type: ignore[arg-type]
        assert note in " ".join(base.snapshots.build().notes)


def test_an_agent_never_starts_without_trust_because_its_files_are_broken(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    fleet.found("arm")
    store = trust_store(fleet.settings("arm"))
    assert store is not None
    store.write(files_of.KEYS, b"{}")
    with pytest.raises(StartError, match=r"keys\.json: is broken"):
        Agent(fleet.settings("arm"))
    store.remove()
    with pytest.raises(StartError, match=r"trust\.require: the module arm has joined no secured mesh; join one"):
        Agent(fleet.settings("arm", trust=TrustSettings(require=True)))
    fleet.found("leg")
    (tmp_path / "state" / "leg").rename(tmp_path / "state" / "gripper")
    with pytest.raises(StartError, match=r"is of leg, but this agent is named gripper; start it with --name leg"):
        Agent(fleet.settings("gripper"))


async def test_the_certificate_is_for_the_hosts_of_the_page_and_for_no_other_modules(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    addresses = {"base": "10.1.1.1", "arm": "10.1.1.2"}
    web = WebSettings(hosts=("Panel.local", "www.example.com", "base"))

    def hosts(trust: AgentTrust) -> tuple[str, ...]:
        settings = trust._settings
        return page_hosts((addresses[settings.name], "10.9.9.9", *settings.web.hosts))

    monkeypatch.setattr(AgentTrust, "page_hosts", hosts)
    trust_of(fleet.agents["base"]).look_now()
    await until(lambda: _hosts(fleet.agents["base"]) >= {"10.1.1.1", "10.9.9.9"})
    arm = await fleet.add("arm", web=web)
    await fleet.linked("base", "arm")
    await until(lambda: "10.1.1.2" in _hosts(arm))
    own = {"arm", "arm.local", "localhost", "127.0.0.1", "10.1.1.2", "panel.local"}
    assert _hosts(arm) == own, "neither a host of the Internet nor one of base"
    # An address that changes is in it when the agent looks next.
    addresses["arm"] = "10.1.1.3"
    trust_of(arm).look_now()
    await until(lambda: "10.1.1.3" in _hosts(arm))
    assert "10.1.1.2" not in _hosts(arm)


def _hosts(agent: Agent) -> frozenset[str]:
    return trust_of(agent).membership.certificate.hosts
