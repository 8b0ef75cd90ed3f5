"""Heartbeats that wait in the kernel's buffer: what they may be late for, and what they may not."""

from __future__ import annotations

import asyncio
import os
import socket
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from rmpa.config.settings import Multicast, Settings
from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.discovery import limits
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.discovery.events import Event, LossReason, PeerChanged, PeerFound, PeerLost
from rmpa.discovery.io import kernel_filter, sockets
from rmpa.discovery.io.discovery import Discovery
from rmpa.discovery.io.kernel_filter import PacketSelection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

DEADLINE = 15.0
NEVER = 3600.0
PAD = Identity(Guid.of("127.0.0.1", 40001, 1), b"pad first run...", "pad")
ARM = Identity(Guid.of("127.0.0.1", 40002, 1), b"arm first run...", "arm")


class Listener:
    """A Discovery whose one member's heartbeats wait, and a socket that plays the other agents of the group."""

    def __init__(self) -> None:
        self.own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self.own.bind(("127.0.0.1", 0))
        self.group = ("239.255.82.79", self.own.getsockname()[1])
        self.settings = Settings(multicast=Multicast(group=self.group[0], port=self.group[1]), interfaces=("lo",))
        identity = Identity(Guid.of("127.0.0.1", self.group[1]), os.urandom(16), "base")
        self.events: list[Event] = []
        self.discovery = Discovery(identity, self.settings, self.own, on_event=self.events.append)
        self._others = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._others.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        self._sequence = 0

    def say(self, kind: BeaconKind, identity: Identity) -> None:
        """Send a beacon to the group; it is in the receivers' buffers when this returns."""
        self._sequence += 1
        self._others.sendto(Beacon(kind, identity, 100_000, self._sequence).serialize(), self.group)

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(DEADLINE):
            while not condition():
                await asyncio.sleep(0.005)

    async def settled(self, identity: Identity) -> None:
        """Until this agent is a member, and its heartbeats wait."""
        self.say(BeaconKind.ANNOUNCE, identity)
        await self.until(lambda: any(isinstance(e, PeerFound) and e.identity == identity for e in self.events))
        self.say(BeaconKind.HEARTBEAT, identity)
        reader = self.discovery._heartbeats
        assert reader is not None
        await self.until(lambda: reader._tick is not None)

    async def turns(self) -> None:
        """Let the event loop look at its sockets: what does not wait is handled now."""
        for _ in range(5):
            await asyncio.sleep(0)

    def heard(self) -> int:
        return self.discovery.counters["beacon.in"]

    async def close(self) -> None:
        await self.discovery.close()
        self.own.close()
        self._others.close()


@pytest.fixture
async def listener(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Listener]:
    monkeypatch.setattr(limits, "HEARTBEATS_READ_MEMBERS", 1)
    monkeypatch.setattr(limits, "HEARTBEATS_READ_SETTLED", 0.0)
    monkeypatch.setattr(limits, "HEARTBEATS_READ_INTERVAL", NEVER)
    monkeypatch.setattr(limits, "BURST_OFFSETS", (0.0,))  # each timer of the listener reads what waits
    monkeypatch.setattr(limits, "HEARTBEAT_INTERVAL", NEVER)
    monkeypatch.setattr(limits, "DISSEMINATION_INTERVAL", NEVER)
    made = Listener()
    await made.discovery.start()
    yield made
    await made.close()


async def test_an_unchanged_heartbeat_wakes_nothing(listener: Listener) -> None:
    await listener.settled(PAD)
    before = listener.heard()
    listener.say(BeaconKind.HEARTBEAT, PAD)
    await listener.turns()
    assert listener.heard() == before


async def test_they_are_read_at_the_common_time(listener: Listener, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "HEARTBEATS_READ_INTERVAL", 0.05)
    await listener.settled(PAD)
    for _ in range(3):
        before = listener.heard()
        listener.say(BeaconKind.HEARTBEAT, PAD)
        await listener.until(lambda before=before: listener.heard() > before)  # type: ignore[misc]


@pytest.mark.parametrize("kind", [BeaconKind.ANNOUNCE, BeaconKind.GOODBYE])
async def test_other_beacons_do_not_wait(listener: Listener, kind: BeaconKind) -> None:
    await listener.settled(PAD)
    before = listener.heard()
    listener.say(kind, PAD)
    await listener.until(lambda: listener.heard() > before)


async def test_a_new_module_ends_the_waiting(listener: Listener, monkeypatch: pytest.MonkeyPatch) -> None:
    await listener.settled(PAD)
    monkeypatch.setattr(limits, "HEARTBEATS_READ_SETTLED", NEVER)
    listener.say(BeaconKind.ANNOUNCE, ARM)
    await listener.until(lambda: isinstance(listener.events[-1], PeerFound) and listener.events[-1].identity == ARM)
    before = listener.heard()
    listener.say(BeaconKind.HEARTBEAT, PAD)
    await listener.until(lambda: listener.heard() > before)


async def test_what_came_first_is_handled_first(listener: Listener) -> None:
    """A module was killed, and starts again at another port: its last heartbeat must not bring the dead run back."""
    await listener.settled(PAD)
    again = replace(PAD, guid=Guid.of("127.0.0.1", 40009, 2), instance=b"pad second run..")
    listener.say(BeaconKind.HEARTBEAT, PAD)
    listener.say(BeaconKind.ANNOUNCE, again)
    await listener.until(lambda: isinstance(listener.events[-1], PeerLost))
    assert listener.events[-2:] == [
        PeerFound(again, listener.events[-2].source, listener.events[-2].heard),  # type: ignore[union-attr]
        PeerLost(PAD, LossReason.MOVED),
    ]
    await listener.turns()
    assert [view.identity for view in listener.discovery.peers() if view.present] == [again]


async def test_a_link_is_handled_after_the_heartbeats_before_it(listener: Listener) -> None:
    await listener.settled(PAD)
    moved = replace(PAD, name="pad_two")
    listener.say(BeaconKind.HEARTBEAT, moved)
    listener.discovery.link_up(ARM)
    assert [type(event) for event in listener.events[-2:]] == [PeerChanged, PeerFound]


async def test_many_that_wait_are_all_read(listener: Listener) -> None:
    await listener.settled(PAD)
    before, count = listener.heard(), 3 * limits.BEACONS_PER_WAKE
    for _ in range(count):
        listener.say(BeaconKind.HEARTBEAT, PAD)
    listener.discovery._read_heartbeats()
    assert listener.heard() == before + limits.BEACONS_PER_WAKE, "the rest must not delay data"
    await listener.until(lambda: listener.heard() + listener.discovery.counters["beacon.flood"] >= before + count)


async def test_without_the_kernels_filter_all_come_by_one_socket(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(92, "Protocol not available")

    monkeypatch.setattr(kernel_filter, "select", refuse)
    listener = Listener()
    await listener.discovery.start()
    try:
        assert listener.discovery._heartbeats is None
        listener.say(BeaconKind.HEARTBEAT, PAD)
        await listener.until(lambda: listener.events)
        assert isinstance(listener.events[0], PeerFound)
    finally:
        await listener.close()


def test_the_kernel_gives_each_packet_to_one_of_two_sockets() -> None:
    with (
        sockets.open_receiver("127.0.0.1", 0, PacketSelection.HEARTBEATS) as heartbeats,
        sockets.open_receiver("127.0.0.1", 0, PacketSelection.OTHERS) as others,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        beacons = {kind: Beacon(kind, PAD, 15_000, 1).serialize() for kind in BeaconKind}
        newer = bytearray(beacons[BeaconKind.HEARTBEAT])
        newer[4] = 9
        odd = [b"", b"R", b"RMPA", b"RMPA\1", b"RMPB\1\2" + bytes(50), bytes(2000), bytes(newer), b"RMPA\1\2"]
        sent = [*beacons.values(), *odd]
        for packet in sent:
            for receiver in (heartbeats, others):
                sender.sendto(packet, receiver.getsockname())
        got = {name: _all_of(sock) for name, sock in (("heartbeats", heartbeats), ("others", others))}
    assert got["heartbeats"] == [beacons[BeaconKind.HEARTBEAT], bytes(newer), b"RMPA\1\2"]
    assert got["others"] == [p for p in sent if p not in got["heartbeats"]]


def _all_of(sock: socket.socket) -> list[bytes]:
    found = []
    while True:
        try:
            found.append(sock.recv(4096))
        except BlockingIOError:
            return found
