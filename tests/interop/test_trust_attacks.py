"""Attacks on a secured mesh, from a network namespace of its own; docs/reference/security.md lists them."""

from __future__ import annotations

import functools
import re
from typing import Any

import pytest

pytest.importorskip("cryptography")

from pathlib import Path

from lab.bed.agents import Agent
from lab.bed.namespaces import Lab
from lab.bed.processes import Event, eventually
from rmpa.discovery.limits import STRANGERS_SHOWN
from rmpa.trust.store import CERTIFICATE, KEY, TrustStore
from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory
from tests.interop.modules import Module, flows
from tests.interop.secured import (
    GROUP,
    UDP_PORT,
    SecuredMesh,
    attack,
    control,
    counter,
    foreign_files,
    place,
    start_attack,
)

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]

# Every member may do everything: what is refused is refused for another reason.
OPEN = '[trust]\ndefault = "allow"\n'
REASONS = {"plain": 11, "foreign": 15, "expired": 16, "name": 18}


class Fortress:
    """Two secured modules, and an attacker on a host of its own in their network."""

    def __init__(self, home: Path, modules: ModuleFactory, lab: Lab, config: str = OPEN) -> None:
        self.home = home
        self.mesh = SecuredMesh(home, "a")
        self.mesh.add("b")
        self.a, self.b = modules("a", "b", config=config, log_level="info")
        self.eve = lab.host("eve", 0)

    @property
    def target(self) -> dict[str, Any]:
        """Where the authority is reached."""
        return place(self.a.agent)

    def attack(self, mode: str, **arguments: object) -> Event:
        """Let the attacker do something."""
        return attack(self.eve, mode, **arguments)

    def insider(self, store: TrustStore | None = None, name: str = "eve", **more: object) -> Event:
        """Dial ``a`` with the certificate of some files."""
        files = {"cert": str(store.path(CERTIFICATE)), "private": str(store.path(KEY))} if store is not None else {}
        return self.attack("insider", **self.target, name=name, here=self.eve.address, **files, **more)

    def held(self) -> None:
        """Fail unless the two modules are as before, and linked with each other alone."""
        for module, other in ((self.a, "b"), (self.b, "a")):
            assert module.agent.process.returncode is None
            linked = {name for name, row in module.agent.peers().items() if row["state"] == "linked"}
            assert linked == {other}
            assert "Traceback" not in module.agent.process.output


@pytest.fixture
def fortress(tmp_path: Path, modules: ModuleFactory, lab: Lab) -> Fortress:
    return Fortress(tmp_path, modules, lab)


# --- from outside -----------------------------------------------------------------------------------------------


def test_a_module_without_trust_is_told_so_and_stays_outside(fortress: Fortress, agent: AgentFactory) -> None:
    fortress.a.agent.rmpa("doctor")
    answer = fortress.attack("plain", **fortress.target, here=fortress.eve.address)
    assert (answer["answer"], answer["code"]) == ("refused", REASONS["plain"])
    assert counter(fortress.a.agent, "link.refused.plain") == 1
    seed = f"{fortress.target['address']}:{fortress.target['port']}"
    outsider = agent(fortress.eve, name="eve", flags=("--seed", seed))
    eventually(lambda: counter(fortress.a.agent, "beacon.untagged") > 0, what="beacons of eve are refused")
    assert not any(row["state"] == "linked" for row in outsider.peers().values())
    for agent_, other in ((fortress.a.agent, "eve"), (outsider, "a")):
        line = functools.partial(_line_of, agent_, other)
        assert "pending" in eventually(line, what=f"{other} is told as a stranger")
        assert "rmpa trust invite --module eve" in line()
        code, why = agent_.rmpa("why", "--module", other)
        assert code == 1
        assert f"{other} is pending" in why
    told = [line for line in fortress.a.agent.process.output.splitlines() if "not of this mesh" in line]
    assert told
    assert all("eve at " in line for line in told), "a packet of rmpa doctor is no module"
    fortress.held()


def _line_of(agent: Agent, other: str) -> str:
    """What `rmpa peer list` says below its table of one module."""
    _, out = agent.rmpa("peer", "list")
    return next((line for line in out.splitlines() if re.match(rf"! {other}\b.*: pending", line)), "")


def test_knocks_of_an_outsider_flood_nothing_and_take_no_name(fortress: Fortress) -> None:
    here, members = fortress.eve.address, ["a", "b", "B"]
    fortress.attack("knock", group=GROUP, udp=UDP_PORT, here=here, names=members, invented=200)
    shown = fortress.a.agent.snapshot().strangers
    assert len(shown) == STRANGERS_SHOWN
    taken = [one for one in shown if one.name.startswith(f"{here}:")]
    assert [(one.state, one.invite) for one in taken] == [("foreign", "")] * 3, "they go by their addresses"
    assert all("do not invite it" in one.last_error for one in taken)
    assert {(one.name[:3], one.state) for one in shown if one not in taken} == {("arm", "pending")}
    lines = [line for line in fortress.a.agent.process.output.splitlines() if "not of this mesh" in line]
    assert len(lines) <= 20
    _, info = fortress.a.agent.rmpa("peer", "info", "b")
    assert "linked for" in info
    fortress.held()


def test_a_secured_agent_never_goes_back_to_plain(fortress: Fortress) -> None:
    with start_attack(fortress.eve, "lure", listen=40999, seconds=12) as lure:
        lure.wait_event("ready", 20.0)
        fortress.attack(
            "tell_beacon", key=fortress.mesh.group_key, group=GROUP, udp=UDP_PORT, here=fortress.eve.address,
            listen=40999, name="eve",
        )  # fmt: skip
        first = lure.wait_event("done", 60.0)["first"]
    assert isinstance(first, list)
    assert first, "the agents dialled what a member's beacon names"
    assert {begin[:4] for begin in first} == {"1603"}, "TLS alone"
    fortress.held()


def test_recorded_beacons_and_dials_do_nothing(fortress: Fortress, tmp_path: Path) -> None:
    wire = fortress.b.host.cables[0]
    tape = tmp_path / "tape.json"
    tap = ["ip", "netns", "exec", wire.switch]
    host = type("Wire", (), {"command": staticmethod(lambda argv: [*tap, *argv])})()
    with start_attack(host, "record", interface=wire.port, file=str(tape), beacons=6, hellos=1) as recording:
        recording.wait_event("ready", 20.0)
        fortress.b.agent.kill()
        fortress.b.agent.restart()  # and dials, or is dialled
        recording.wait_event("done", 60.0)
    fortress.b.agent.wait_peer("a")
    before = counter(fortress.a.agent, "beacon.in")
    refused = fortress.attack("replay", file=str(tape), times=50)
    assert isinstance(refused["answers"], list)
    assert set(refused["answers"]) == {"16"}, "TLS answers, and goes on with the holder of the first key alone"
    told = sum(counter(module.agent, f"beacon.{kind}") for module in (fortress.a, fortress.b)
               for kind in ("replayed", "repeated"))  # fmt: skip
    assert told >= 100, told
    assert counter(fortress.a.agent, "beacon.in") - before < 50
    fortress.held()


# --- with a stolen group key ------------------------------------------------------------------------------------


def test_a_dial_without_a_valid_certificate_of_its_own_name_and_protocol_opens_nothing(fortress: Fortress) -> None:
    fortress.mesh.add("eve")
    eve = fortress.mesh.store("eve")
    for store, name, reason in (
        (None, "eve", "foreign"),
        (fortress.mesh.expired("old"), "old", "expired"),
        (eve, "b", "name"),
    ):
        answer = fortress.insider(store, name)
        assert (answer["answer"], answer["code"]) == ("refused", REASONS[reason]), answer
        assert counter(fortress.a.agent, f"link.refused.{reason}") == 1
    answer = fortress.insider(foreign_files(fortress.home, "b"), "b")
    assert (answer["answer"], "UNKNOWN_CA" in str(answer.get("alert", ""))) == ("alert", True), answer
    assert counter(fortress.a.agent, "link.refused.foreign") == 2
    downgrades: list[dict[str, Any]] = [{"old": True}, {"alpn": ""}, {"alpn": "http/1.1"}]
    for number, downgrade in enumerate(downgrades, 1):
        answer = fortress.insider(eve, **downgrade)
        assert answer["answer"] in ("alert", "closed"), answer
        assert counter(fortress.a.agent, "link.refused.downgrade") == number
    fortress.held()


# --- joins ------------------------------------------------------------------------------------------------------


# --- floods -----------------------------------------------------------------------------------------------------


class Traffic:
    """Messages from one module to the other, each of which is counted."""

    def __init__(self, fortress: Fortress) -> None:
        self.heard = fortress.a.ros.roscpp("listener", topic="/to_a")
        fortress.b.ros.roscpp("talker", topic="/to_a", rate=100)
        flows(self.heard)

    def held(self) -> None:
        """Fail unless every message arrived, each byte of it."""
        report = flows(self.heard, 100)
        assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0)


def test_a_flood_costs_a_link_no_message(fortress: Fortress) -> None:
    traffic = Traffic(fortress)
    target = {**fortress.target, "group": GROUP, "udp": UDP_PORT}
    for kind, counted in (
        ("beacons", ("beacon.unknown_key", "beacon.forged")),
        ("half", ("link.unfinished", "link.pending_full")),
        ("garbage", ("link.refused.plain",)),
    ):
        done = fortress.attack("flood", kind=kind, **target, rate=3000, seconds=4)
        assert int(str(done["sent"])) > 500
        assert sum(counter(fortress.a.agent, name) for name in counted) > 0
        traffic.held()
    fortress.held()


def test_slow_handshakes_are_ended_and_hold_no_member_out(fortress: Fortress) -> None:
    with start_attack(fortress.eve, "slow", **fortress.target, count=60) as slow:
        fortress.b.agent.kill()
        fortress.b.agent.restart()
        fortress.b.agent.wait_peer("a")
        done = slow.wait_event("done", 60.0)
    assert done["open"] == 0
    assert isinstance(done["lived"], list)
    assert max(done["lived"]) < 5.0
    fortress.held()


# --- members that do what they may not --------------------------------------------------------------------------


def test_a_former_member_holds_no_module_out_and_is_believed_nothing(
    tmp_path: Path, modules: ModuleFactory, lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    """It has all group keys up to the last one, and its certificate."""
    fortress = Fortress(tmp_path, modules, lab)
    traffic = Traffic(fortress)
    fortress.mesh.add("eve")
    store, old_key = fortress.mesh.store("eve"), fortress.mesh.group_key
    away = lab.host("away", 0)
    fortress.mesh.add("away")  # has the group key before, and no fault
    control(fortress.a.agent, "revoke", name="eve", force=True)
    addresses = [fortress.eve.address]
    for octet in range(201, 213):
        addresses.append(f"{fortress.eve.address.rsplit('.', 1)[0]}.{octet}")
        fortress.eve.ip("address", "add", f"{addresses[-1]}/24", "dev", "eth0")
    files = {"cert": str(store.path(CERTIFICATE)), "private": str(store.path(KEY))}
    with start_attack(
        fortress.eve, "former", **fortress.target, **files, key=old_key, group=GROUP, udp=UDP_PORT,
        here=fortress.eve.address, addresses=addresses, seconds=25,
    ) as attacking:  # fmt: skip
        attacking.wait_event("ready", 20.0)
        eventually(lambda: counter(fortress.a.agent, "beacon.old_key") > 50, what="the lies arrive")
        for module in (fortress.a, fortress.b):
            assert len(module.agent.snapshot().peers) == 1, [peer.name for peer in module.agent.snapshot().peers]
        traffic.held()
        fortress.b.agent.kill()
        fortress.b.agent.restart()
        fortress.b.agent.wait_peer("a", 10.0)
        late = Module(away, agent(away, name="away", config=OPEN, log_level="info"), shell(away))
        late.agent.wait_peer("a")  # in time, with so many others that have its key
        done = attacking.wait_event("done", 60.0)
    assert int(str(done["heard"])) >= 2
    assert counter(fortress.a.agent, "link.refused.revoked") > 0
    for module in (fortress.a, fortress.b):
        assert {peer.name for peer in module.agent.snapshot().peers} <= {"a", "b", "away"}
        assert "Traceback" not in module.agent.process.output
