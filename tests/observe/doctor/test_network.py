"""What ``rmpa doctor`` says of interfaces, multicast, routes, filters and ports."""

from __future__ import annotations

from ipaddress import IPv4Interface

import pytest

from rmpa.observe.doctor.network import (
    MulticastEcho,
    NetworkInterface,
    Port,
    Radio,
    judge_interfaces,
    judge_multicast,
    judge_ports,
    judge_radio,
    judge_routes,
    judge_rp_filter,
)
from rmpa.observe.peer_info import Check, CheckLevel, exit_code

LO = NetworkInterface("lo", (IPv4Interface("127.0.0.1/8"),), loopback=True)
WLAN = NetworkInterface("wlan0", (IPv4Interface("192.168.1.5/24"),))
ETH = NetworkInterface("eth0", (IPv4Interface("10.0.0.5/24"),))


def only(found: list[Check], level: CheckLevel) -> Check:
    (one,) = [finding for finding in found if finding.level is level]
    if level in (CheckLevel.WARN, CheckLevel.FAIL):
        assert one.remedy, "who is told of trouble is told what to do"
    return one


def test_two_ordinary_interfaces_are_fine() -> None:
    found = judge_interfaces((LO, WLAN, ETH), ())
    assert {finding.level for finding in found} == {CheckLevel.OK}
    assert [finding.where for finding in found] == ["wlan0", "eth0"]
    assert exit_code(found) == 0


def test_no_network_at_all() -> None:
    warned = only(judge_interfaces((LO, NetworkInterface("eth0", up=False, used=False)), ()), CheckLevel.WARN)
    assert "none but loopback" in warned.text
    assert "eth0" in warned.remedy
    assert only(judge_interfaces((LO,), ()), CheckLevel.WARN).remedy == "plug in a network"


def test_settings_that_keep_to_loopback_mean_it() -> None:
    (found,) = judge_interfaces((LO, NetworkInterface("eth0", ETH.networks, used=False)), ("lo",))
    assert (found.where, found.level) == ("lo", CheckLevel.OK)


def test_an_interface_that_the_settings_name_and_that_is_not_there() -> None:
    warned = only(judge_interfaces((LO, WLAN), ("wlan0", "eth7")), CheckLevel.WARN)
    assert warned.where == "eth7"
    assert "there are lo, wlan0" in warned.text


@pytest.mark.parametrize("name", ["tun0", "wg0", "tailscale0", "ztabc"])
def test_a_tunnel_carries_no_multicast(name: str) -> None:
    warned = only(
        judge_interfaces((LO, WLAN, NetworkInterface(name, (IPv4Interface("10.8.0.2/32"),))), ()), CheckLevel.WARN
    )
    assert warned.where == name
    assert "--seed" in warned.remedy


def test_interfaces_of_containers_are_named_but_no_trouble() -> None:
    found = judge_interfaces((LO, WLAN, NetworkInterface("docker0", (IPv4Interface("172.17.0.1/16"),))), ())
    assert exit_code(found) == 0
    assert "containers" in next(finding.text for finding in found if finding.where == "docker0")


def test_an_address_that_no_dhcp_gave() -> None:
    warned = only(
        judge_interfaces((LO, NetworkInterface("eth0", (IPv4Interface("169.254.3.4/16"),))), ()), CheckLevel.WARN
    )
    assert "DHCP" in warned.text


def test_two_interfaces_in_one_network() -> None:
    warned = only(
        judge_interfaces((LO, WLAN, NetworkInterface("eth0", (IPv4Interface("192.168.1.6/24"),))), ()),
        CheckLevel.WARN,
    )
    assert warned.where == "wlan0+eth0"
    assert "192.168.1.0/24" in warned.text


def test_a_container_with_a_network_of_its_own() -> None:
    warned = only(judge_interfaces((LO, ETH), (), container=True), CheckLevel.WARN)
    assert "--network host" in warned.remedy


def test_multicast_by_interface() -> None:
    echoes = (
        MulticastEcho("lo", after=0.0002),
        MulticastEcho("eth0"),
        MulticastEcho("wlan0", "Operation not permitted"),
    )
    lo, eth, wlan = judge_multicast(echoes, "239.255.82.77", 11411)
    assert (lo.level, eth.level, wlan.level) == (CheckLevel.OK, CheckLevel.FAIL, CheckLevel.FAIL)
    assert "heard 0.2 ms later" in lo.text
    assert "not heard" in eth.text
    assert "11411" in eth.remedy
    assert "Operation not permitted" in wlan.text
    assert exit_code([lo, eth]) == 1


def test_strict_filters_matter_with_two_interfaces() -> None:
    strict = {"all": 1, "wlan0": 0, "eth0": 0}
    warned = only(judge_rp_filter(strict, (LO, WLAN, ETH)), CheckLevel.WARN)
    assert "rp_filter=2" in warned.remedy
    assert judge_rp_filter(strict, (LO, WLAN))[0].level is CheckLevel.OK
    # The greater of both counts: 2 is loose.
    assert judge_rp_filter({"all": 2, "wlan0": 1, "eth0": 1}, (LO, WLAN, ETH))[0].level is CheckLevel.OK
    assert judge_rp_filter({}, (LO, WLAN, ETH))[0].level is CheckLevel.SKIPPED


def test_routes() -> None:
    found = judge_routes({"10.1.0.2 (arm)": "Network is unreachable", "10.0.0.2 (base)": ""})
    assert only(found, CheckLevel.FAIL).where == "10.1.0.2 (arm)"
    assert only(found, CheckLevel.OK).where == "10.0.0.2 (base)"
    assert judge_routes({})[0].level is CheckLevel.SKIPPED


def test_routes_to_many_peers_are_counted() -> None:
    found = judge_routes({f"10.0.{n >> 8}.{n & 255} (m{n})": "" for n in range(999)} | {"10.1.0.2 (arm)": "none"})
    assert len(found) == 2
    assert only(found, CheckLevel.FAIL).where == "10.1.0.2 (arm)"
    assert only(found, CheckLevel.OK).text == "there is a way to 999 of 1,000 peers and seeds"


def test_ports() -> None:
    ports = (
        Port("the ROS core", 11311, "Address already in use", "roscore (pid 7)"),
        Port("the mesh (TCP)", 40001, "Address already in use", "agent base", ours=True),
        Port("beacons (UDP)", 11411),
        Port("beacons (UDP)", 11412, owner="agent base and python3 (pid 7)"),
    )
    core, mesh, beacons, shared = judge_ports(ports)
    assert (core.level, mesh.level, beacons.level) == (CheckLevel.FAIL, CheckLevel.OK, CheckLevel.OK)
    assert "roscore (pid 7)" in core.text
    assert "11311" in core.remedy
    assert "agent base" in mesh.text
    assert beacons.text == "beacons (UDP): free"
    text = "beacons (UDP): used by agent base and python3 (pid 7); others may use it too"
    assert (shared.level, shared.text) == (CheckLevel.OK, text)


def test_a_radio_whose_losses_are_repeated_late_or_whose_queue_is_filled() -> None:
    wlan = Radio("wlan0", "10.0.0.0/24")
    assert [check.level for check in judge_radio((), quick=False, bbr=False)] == [CheckLevel.SKIPPED]
    (quick,) = judge_radio((wlan,), quick=True, bbr=True)
    (slow,) = judge_radio((wlan,), quick=False, bbr=True)
    assert (quick.level, slow.level) == (CheckLevel.OK, CheckLevel.WARN)
    assert "ip route change 10.0.0.0/24 dev wlan0 rto_min 40ms" in quick.remedy
    assert quick.remedy == slow.remedy
    (done, queue) = judge_radio((Radio("wlan0", "10.0.0.0/24", "40ms"),), quick=False, bbr=False)
    assert (done.level, done.remedy, queue.level) == (CheckLevel.OK, "", CheckLevel.WARN)
    assert "tcp_allowed_congestion_control" in queue.remedy
