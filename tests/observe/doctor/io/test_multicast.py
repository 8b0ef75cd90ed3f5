"""Real packets, on loopback alone."""

from __future__ import annotations

import os
import socket
import threading

import pytest

from rmpa.config import limits as config_limits
from rmpa.core.errors import StartError
from rmpa.core.statistics import Counters
from rmpa.discovery.beacon import PacketFilter
from rmpa.discovery.network import Interface, list_interfaces, receive
from rmpa.observe import limits
from rmpa.observe.doctor import network as multicast
from rmpa.observe.doctor.network import hear

PORT = 20000 + os.getpid() % 20000
LO = next(interface for interface in list_interfaces() if interface.name == "lo")
GROUP = config_limits.MULTICAST_GROUP


def test_doctor_receives_its_own_packets() -> None:
    gone = Interface("gone0", LO.networks, 9999)
    lo, other = hear([LO, gone], GROUP, PORT)
    assert lo.after is not None
    assert 0 < lo.after < limits.DOCTOR_HEAR
    assert other.after is None
    assert "No such device" in other.problem
    assert lo.others == set()


def test_a_packet_on_another_interface_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(multicast, "receive", lambda sock: (*receive(sock)[:2], 9999))
    monkeypatch.setattr(limits, "DOCTOR_HEAR", 0.2)
    assert [heard.after for heard in hear([LO], GROUP, PORT)] == [None]


def test_another_machine_is_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its packets are those of a second doctor; loopback stands for the cable."""
    heard = threading.Event()

    def from_afar(sock: socket.socket) -> tuple[bytes, tuple[str, int], int]:
        data, (_, port), index = receive(sock)
        heard.set()
        return data, ("10.0.0.2", port), index

    monkeypatch.setattr(multicast, "receive", from_afar)
    found: list[set[str]] = []
    listener = threading.Thread(target=lambda: found.extend(e.others for e in hear([LO], GROUP, PORT, 2.0)))
    listener.start()
    assert heard.wait(20)
    hear([LO], GROUP, PORT)
    listener.join()
    assert found == [{"10.0.0.2"}]


def test_agents_ignore_the_doctors_packet(monkeypatch: pytest.MonkeyPatch) -> None:
    counters = Counters()
    intake = PacketFilter(0, counters)
    heard: list[bytes] = []

    def note(sock: socket.socket) -> tuple[bytes, tuple[str, int], int]:
        packet = receive(sock)
        heard.append(packet[0])
        return packet

    monkeypatch.setattr(multicast, "receive", note)
    hear([LO], GROUP, PORT)
    assert [intake.parse(data, ("127.0.0.1", 1), 0.0, multicast=True) for data in heard] == [None]
    assert counters.as_dict() == {"beacon.other_domain": 1}


def test_a_port_that_is_not_shared() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((GROUP, PORT))
        with pytest.raises(StartError, match=f"UDP port {PORT}"):
            hear([LO], GROUP, PORT)
