"""Real packets, on loopback alone."""

from __future__ import annotations

import os
import socket
from dataclasses import replace

import pytest

from rmpa.config import limits as config_limits
from rmpa.core.counters import Counters
from rmpa.core.errors import ConfigError, StartError
from rmpa.discovery.io.interfaces import Interface, list_interfaces
from rmpa.discovery.io.packet_filter import PacketFilter
from rmpa.observe import limits
from rmpa.observe.doctor.io.multicast import GroupReceiver, GroupSender, hear_ourselves

PORT = 20000 + os.getpid() % 20000
LO = next(interface for interface in list_interfaces() if interface.name == "lo")
GROUP = config_limits.MULTICAST_GROUP


def test_a_packet_is_received_on_its_interface() -> None:
    with GroupReceiver(GROUP, PORT) as receiver, GroupSender(GROUP, PORT) as sender:
        assert receiver.join([LO]) == {}
        assert sender.send(LO, b"hello") == ""
        packet = receiver.wait(20.0)
        assert packet is not None
        assert (packet.data, packet.interface) == (b"hello", "lo")
        assert packet.source.startswith("127.0.0.1:")
        assert receiver.wait(0.0) is None


def test_without_joining_nothing_is_received() -> None:
    with GroupReceiver(GROUP, PORT) as receiver, GroupSender(GROUP, PORT) as sender:
        sender.send(LO, b"hello")
        assert receiver.wait(0.2) is None


def test_doctor_receives_its_own_packets() -> None:
    gone = Interface("gone0", 9999, LO.addresses, up=True, multicast=True, loopback=False)
    lo, other = hear_ourselves([LO, gone], GROUP, PORT)
    assert lo.after is not None
    assert 0 < lo.after < limits.DOCTOR_HEAR
    assert other.after is None
    assert "No such device" in other.problem


def test_a_packet_on_another_interface_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    wait = GroupReceiver.wait

    def elsewhere(self: GroupReceiver, timeout: float | None = None) -> object:
        packet = wait(self, timeout)
        return None if packet is None else replace(packet, interface="eth9")

    monkeypatch.setattr(GroupReceiver, "wait", elsewhere)
    monkeypatch.setattr(limits, "DOCTOR_HEAR", 0.2)
    assert [heard.after for heard in hear_ourselves([LO], GROUP, PORT)] == [None]


def test_agents_ignore_the_doctors_packet(monkeypatch: pytest.MonkeyPatch) -> None:
    counters = Counters()
    intake = PacketFilter(0, counters)
    heard: list[bytes] = []
    wait = GroupReceiver.wait

    def note(self: GroupReceiver, timeout: float | None = None) -> object:
        packet = wait(self, timeout)
        if packet is not None:
            heard.append(packet.data)
        return packet

    monkeypatch.setattr(GroupReceiver, "wait", note)
    hear_ourselves([LO], GROUP, PORT)
    assert [intake.parse(data, ("127.0.0.1", 1), 0.0, multicast=True) for data in heard] == [None]
    assert counters.as_dict() == {"beacon.other_domain": 1}


def test_a_port_that_is_not_shared() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((GROUP, PORT))
        with pytest.raises(StartError, match=f"UDP port {PORT}"):
            hear_ourselves([LO], GROUP, PORT)


@pytest.mark.parametrize("group", ["10.0.0.1", "239.1", "x", "240.0.0.1"])
def test_addresses_that_are_no_group(group: str) -> None:
    with pytest.raises(ConfigError, match="not an IPv4 multicast group"):
        GroupSender(group, PORT)
    with pytest.raises(ConfigError):
        GroupReceiver(group, PORT)
