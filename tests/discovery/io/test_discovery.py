"""Discovery on real sockets, over loopback with a group and port of its own."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import pytest

from rmpa import __version__
from rmpa.config.settings import Settings
from rmpa.config.values import HostPort, Multicast
from rmpa.core.identity import Guid, Identity
from rmpa.discovery import limits, membership
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.discovery.discovery import Discovery
from rmpa.discovery.membership import PeerEvent
from rmpa.discovery.network import Interface, list_interfaces
from rmpa.trust.packets import GroupKey, KeyRing, PacketTrust

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.discovery.endpoints import PeerView

DEADLINE = 15.0


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("", 0))
        port: int = sock.getsockname()[1]
        return port


class Agent:
    """A Discovery with its socket, and what it told."""

    def __init__(self, name: str, settings: Settings, *, port: int = 0, **options: object) -> None:
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self.sock.bind(("", port))
        self.port = self.sock.getsockname()[1]
        self.identity = Identity(Guid.of("127.0.0.1", self.port), os.urandom(16), name, settings.domain)
        self.events: list[PeerEvent] = []
        self.discovery = Discovery(
            self.identity,
            settings,
            self.sock,
            on_event=self.events.append,
            **options,  # type: ignore[arg-type]
        )

    def names(self) -> set[str]:
        return {view.run.identity.name for view in self.discovery.membership.endpoints.views() if view.present}

    def view(self, name: str) -> PeerView:
        return next(v for v in self.discovery.membership.endpoints.views() if v.run.identity.name == name)

    async def end(self) -> None:
        await self.discovery.close()
        self.sock.close()


@pytest.fixture
def settings() -> Settings:
    return Settings(multicast=Multicast(group="239.255.82.78", port=free_port()), interfaces=("lo",))


@pytest.fixture
async def agents() -> AsyncIterator[list[Agent]]:
    started: list[Agent] = []
    yield started
    for agent in started:
        await agent.end()


async def start(agents: list[Agent], *new: Agent) -> None:
    for agent in new:
        agents.append(agent)
        await agent.discovery.start()


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(DEADLINE):
        while not condition():
            await asyncio.sleep(0.01)


async def test_agents_on_one_machine_find_each_other(agents: list[Agent], settings: Settings) -> None:
    trio = [Agent(name, settings) for name in ("base", "joystick", "pc")]
    await start(agents, *trio)
    for agent in trio:
        others = {"base", "joystick", "pc"} - {agent.identity.name}
        await until(partial(lambda a, o: a.names() == o, agent, others))
    assert all(e.change == "found" for e in trio[0].events)
    await trio[2].discovery.close()
    await until(lambda: trio[0].names() == {"joystick"})
    assert trio[0].events[-1] == PeerEvent("lost", trio[2].identity, reason=membership.GOODBYE)


async def test_heartbeats_of_many_members_wait_to_be_read_together_and_nothing_else_does(
    agents: list[Agent], settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "HEARTBEATS_WAIT_MEMBERS", 1)
    monkeypatch.setattr(limits, "HEARTBEATS_WAIT", 3600.0)
    base = Agent("base", settings)
    await start(agents, base)
    counters, to = base.discovery.counters, (settings.multicast.group, settings.discovery_port)
    other = Identity(Guid.of("127.0.0.1", free_port()), os.urandom(16), "other")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))

        def say(kind: BeaconKind, sequence: int) -> None:
            out.sendto(Beacon(kind, other, 100_000, sequence).serialize(), to)

        say(BeaconKind.HEARTBEAT, 1)  # while there is no member, it is read at once
        await until(lambda: base.names() == {"other"})
        heard = counters["beacon.in"]
        say(BeaconKind.HEARTBEAT, 2)
        for _ in range(20):
            await asyncio.sleep(0)
        assert counters["beacon.in"] == heard
        say(BeaconKind.GOODBYE, 3)  # what waits is older: read afterwards, it would refute the goodbye
        await until(lambda: not base.names())
        assert counters["beacon.in"] == heard + 2
        assert counters["beacon.late"] == 0


async def test_garbage_is_counted_said_once_and_survived(
    agents: list[Agent], settings: Settings, caplog: pytest.LogCaptureFixture
) -> None:
    base = Agent("base", settings)
    await start(agents, base)
    to = ("127.0.0.1", base.port)
    far = Beacon(BeaconKind.ANNOUNCE, Identity(Guid.of("127.0.0.1", 9), os.urandom(16), "far", 7), 1, 1).serialize()
    new = Beacon(BeaconKind.ANNOUNCE, Identity(Guid.of("127.0.0.1", 9), os.urandom(16), "new"), 1, 1)
    newer = bytearray(new.serialize())
    newer[4] = 3
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock, caplog.at_level(logging.WARNING):
        for n in range(30):
            sock.sendto(b"GET / HTTP/1.1 %d" % n, to)
        sock.sendto(b"", to)
        sock.sendto(bytes(5000), to)
        sock.sendto(far, to)
        sock.sendto(newer, to)
        counters = base.discovery.counters
        await until(lambda: counters["beacon.version"])
    assert counters["beacon.malformed"] == 32
    assert counters["beacon.other_domain"] == 1
    lines = [r.getMessage() for r in caplog.records]
    assert len([line for line in lines if "malformed" in line]) == 1
    told = f"speaks beacon protocol 3, we speak 2 (rmpa {__version__}): install the same release of rmpa on both"
    assert f"! the peer at 127.0.0.1 {told} [other-release]" in lines
    assert [(one.identity.name, one.problem) for one in base.discovery.strangers()] == [("new", told)]
    assert len([line for line in lines if "is of domain 7, we are of domain 0" in line]) == 1
    pc = Agent("pc", settings)
    await start(agents, pc)
    await until(lambda: base.names() == {"pc"})


async def test_a_flood_without_proofs_pauses_the_reading_and_members_still_meet(
    agents: list[Agent], settings: Settings, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "rmpa.discovery.discovery")
    rings = [KeyRing([GroupKey(1, bytes(32))], 0.0) for _ in range(2)]
    base, arm = (
        Agent(name, settings, trust=PacketTrust(ring, time.time))
        for name, ring in zip(("base", "arm"), rings, strict=True)
    )
    await start(agents, base)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:

        async def flood() -> None:
            while True:
                for _ in range(100):
                    sock.sendto(bytes(200), ("127.0.0.1", base.port))
                await asyncio.sleep(0)

        flooding = asyncio.create_task(flood())
        try:
            await until(lambda: base.discovery.counters["beacon.paused"] > 1)
            await start(agents, arm)
            await until(lambda: base.names() == {"arm"})
            # The first four may all be lost.
            await until(lambda: caplog.text.count("> group: announce") > 2 * len(membership.BURST_OFFSETS))
        finally:
            flooding.cancel()
    assert base.discovery.counters["beacon.untagged"] >= limits.BEACONS_UNPROVED_BURST


async def test_other_domains_do_not_meet(agents: list[Agent], settings: Settings) -> None:
    base = Agent("base", settings)
    # The port moves with the domain; a wrong setting could still bring both to one port.
    other = Agent(
        "other",
        Settings(
            multicast=replace(settings.multicast, port=settings.multicast.port - 1), domain=1, interfaces=("lo",)
        ),
    )
    await start(agents, base, other)
    await until(lambda: base.discovery.counters["beacon.other_domain"] >= 2)
    assert base.names() == set()


async def test_seeds_without_multicast_and_gossip(agents: list[Agent], settings: Settings) -> None:
    quiet = replace(settings.multicast, enabled=False)
    hub = Agent("hub", Settings(multicast=quiet))
    seeds = (HostPort("127.0.0.1", hub.port),)
    left, right = (Agent(n, Settings(multicast=quiet, seeds=seeds)) for n in ("left", "right"))
    await start(agents, hub, left, right)
    await until(lambda: left.names() == {"hub", "right"} and right.names() == {"hub", "left"})
    assert hub.discovery.counters["beacon.out_multicast"] == 0
    assert "gossip" in {left.view("right").run.found_by, right.view("left").run.found_by}


async def test_a_seed_by_name_and_without_a_port(agents: list[Agent], settings: Settings) -> None:
    quiet = replace(settings.multicast, enabled=False)
    tries: list[str] = []

    def resolve(host: str) -> list[str]:
        tries.append(host)
        if len(tries) == 1:
            raise OSError("no name server yet")
        return ["127.0.0.1"]

    hub = Agent("hub", Settings(multicast=quiet))
    await start(agents, hub)
    # On one machine the last that opened the discovery port gets its unicasts; keep that one the hub.
    left = Agent("left", Settings(multicast=quiet, seeds=(HostPort("robot.local"),)), resolve=resolve)
    left.discovery._open_receiver = lambda *_, **__: None  # type: ignore[method-assign]
    await start(agents, left)
    await until(lambda: left.names() == {"hub"} and hub.names() == {"left"})
    assert tries == ["robot.local"] * 2


async def test_a_seed_that_never_resolves_does_not_hold_up_the_end(settings: Settings) -> None:
    import threading

    stuck = threading.Event()
    agent = Agent(
        "base",
        Settings(multicast=replace(settings.multicast, enabled=False), seeds=(HostPort("nowhere"),)),
        resolve=lambda _: (stuck.wait(DEADLINE) and []) or [],
    )
    await agent.discovery.start()
    async with asyncio.timeout(5):
        await agent.end()
    stuck.set()


async def test_a_link_keeps_and_brings_a_peer(agents: list[Agent], settings: Settings) -> None:
    base = Agent("base", settings)
    await start(agents, base)
    friend = Identity(Guid.of("127.0.0.1", 1), os.urandom(16), "friend")
    base.discovery.link_up(friend)
    assert base.view("friend").run.linked
    base.discovery.link_down(friend.guid)
    assert not base.view("friend").run.linked


async def test_two_of_one_name_are_told(
    agents: list[Agent], settings: Settings, caplog: pytest.LogCaptureFixture
) -> None:
    pair = [Agent("base", settings) for _ in range(2)]
    await start(agents, *pair)
    await until(lambda: all(any(e.change == "conflict" for e in agent.events) for agent in pair))
    assert "rename one: rmpa up --name" in caplog.text


async def test_events_may_call_back(agents: list[Agent], settings: Settings) -> None:
    base, pc = Agent("base", settings), Agent("pc", settings)

    def link(event: PeerEvent) -> None:
        if event.change == "found":
            base.discovery.link_up(event.identity)

    base.discovery.on_event = link
    await start(agents, base, pc)
    await until(lambda: base.names() and base.view("pc").run.linked)


async def test_an_unknown_interface_is_said_and_used_when_it_comes(
    agents: list[Agent], settings: Settings, caplog: pytest.LogCaptureFixture
) -> None:
    there = list_interfaces()
    (loopback,) = (i for i in there if i.name == "lo")
    now_there: list[Interface] = [i for i in there if i.name != "lo"]
    odd = Settings(multicast=settings.multicast, interfaces=("lo", "wlan7"))
    base = Agent("base", odd, look=lambda: tuple(now_there))
    pc = Agent("pc", settings)
    await start(agents, base, pc)
    assert "--interface lo, wlan7: not here; there are" in caplog.text
    assert "other machines are only found by --seed [no-interface]" in caplog.text
    assert "if it comes [no-interface]" in caplog.text
    assert base.discovery.interfaces == ()
    now_there.append(loopback)
    base.discovery._look_again()
    await until(lambda: base.names() == {"pc"} and pc.names() == {"base"})
    now_there.remove(loopback)
    base.discovery._look_again()
    assert base.discovery.interfaces == ()


async def test_an_interface_that_refuses_is_said_once(
    agents: list[Agent], settings: Settings, caplog: pytest.LogCaptureFixture
) -> None:
    (loopback,) = (i for i in list_interfaces() if i.name == "lo")
    gone = Interface("gone0", loopback.networks, 4242)
    both = Settings(multicast=settings.multicast)
    base, pc = Agent("base", both, look=lambda: (loopback, gone)), Agent("pc", settings)
    await start(agents, base, pc)
    await until(lambda: pc.names() == {"base"} and base.discovery.counters["beacon.send_failed"] >= 3)
    said = [r.getMessage() for r in caplog.records if "gone0" in r.getMessage() and r.levelno >= logging.WARNING]
    assert len(said) == 2, said
    assert any("beacons cannot be sent" in line for line in said)
    assert any("cannot be joined" in line for line in said)
    assert all(line.endswith("[no-interface]") for line in said), "it is gone, and nothing blocks it"


async def test_a_discovery_port_that_somebody_keeps_is_said(
    agents: list[Agent], settings: Settings, caplog: pytest.LogCaptureFixture
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as keeper:
        keeper.bind(("", settings.multicast.port))
        base = Agent("base", settings)
        await start(agents, base)
        assert "cannot listen at" in caplog.text
        assert "--multicast" in caplog.text


async def test_the_watcher_looks_by_itself_where_netlink_is_refused(
    monkeypatch: pytest.MonkeyPatch, agents: list[Agent], settings: Settings
) -> None:
    monkeypatch.setattr("rmpa.discovery.network.open_netlink", lambda: None)
    monkeypatch.setattr("rmpa.discovery.network.INTERFACE_LOOK", 0.05)
    there: list[Interface] = []
    base = Agent("base", settings, look=lambda: tuple(there))
    await start(agents, base)
    there += list_interfaces()
    await until(lambda: base.discovery.interfaces)


async def test_close_twice_and_before_start(settings: Settings) -> None:
    agent = Agent("base", settings)
    await agent.discovery.close()
    await agent.discovery.start()
    with contextlib.closing(agent.sock):
        await agent.discovery.close()
        await agent.discovery.close()


async def test_loopback_that_the_user_chose_is_no_trouble(
    agents: list[Agent], settings: Settings, caplog: pytest.LogCaptureFixture
) -> None:
    base = Agent("base", settings)
    await start(agents, base)
    assert base.discovery.notes() == ()
    assert not [r for r in caplog.records if r.levelno >= logging.WARNING]


async def test_what_leaves_by_loopback_comes_from_loopback(agents: list[Agent], settings: Settings) -> None:
    """Linux would take another interface's address, where there is one, which goes when that interface does."""
    base, pc = Agent("base", settings), Agent("pc", settings)
    await start(agents, base, pc)
    await until(lambda: base.names() == {"pc"} and pc.names() == {"base"})
    assert [event.source for event in base.events if event.change == "found"] == [("127.0.0.1", pc.port)]


async def test_an_identity_that_no_longer_fits_is_announced_no_more(agents: list[Agent], settings: Settings) -> None:
    """Peers that heard the old one on the new network dialled an address that is not ours."""
    now_there = [*list_interfaces()]
    asked: list[tuple[Interface, ...]] = []

    def fits(usable: tuple[Interface, ...]) -> bool:
        asked.append(usable)
        return len(asked) > 1

    base = Agent("base", settings, look=lambda: tuple(now_there), on_interfaces=fits)
    await start(agents, base)
    await until(lambda: not base.discovery.membership._burst)
    for times in (1, 2):
        now_there.append(Interface(f"new{times}", index=4242 + times, up=False))
        base.discovery._look_again()
        assert len(asked) == times
        assert bool(base.discovery.membership._burst) == (times == 2)


async def test_seeds_that_do_not_answer_and_another_domain_are_told(
    agents: list[Agent], settings: Settings, caplog: pytest.LogCaptureFixture
) -> None:
    quiet = replace(settings.multicast, enabled=False)
    hub = Agent("hub", Settings(multicast=quiet, domain=1))
    seed = (HostPort("127.0.0.1", hub.port),)
    left = Agent("left", Settings(multicast=quiet, domain=2, seeds=seed))
    await start(agents, hub, left)
    await until(lambda: "is of domain 2, we are of domain 1: start both with the same --domain" in caplog.text)
    assert f"seed 127.0.0.1:{hub.port}: no answer" in left.discovery.notes()[0]
    right = Agent("right", Settings(multicast=quiet, domain=1, seeds=seed))
    await start(agents, right)
    await until(lambda: right.discovery.notes() == ())


def _trust(secret: bytes) -> PacketTrust:
    ring = KeyRing([GroupKey(1, secret * 32)], 0.0)
    return PacketTrust(ring, time.time)


async def test_a_secured_mesh_hears_its_members_alone(agents: list[Agent], settings: Settings) -> None:
    base, pc = (Agent(name, settings, trust=_trust(b"k")) for name in ("base", "pc"))
    plain, foreign = Agent("plain", settings), Agent("foreign", settings, trust=_trust(b"x"))
    await start(agents, plain, foreign, base, pc)
    await until(lambda: base.names() == {"pc"} and pc.names() == {"base"})
    # An agent without trust hears all: it ignores the proof.
    await until(lambda: plain.names() == {"base", "pc", "foreign"})
    for agent in (base, pc):
        await until(partial(lambda each: each.discovery.counters["beacon.untagged"], agent))
        await until(partial(lambda each: each.discovery.counters["beacon.forged"], agent))
    assert base.names() == {"pc"}
    assert foreign.names() == set()
