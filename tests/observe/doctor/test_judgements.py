"""What ``rmpa doctor`` says of facts; the golden file has the texts whole."""

from __future__ import annotations

from functools import partial
from ipaddress import IPv4Interface
from typing import TYPE_CHECKING, Any, Final

import msgspec
import pytest

from rmpa.observe.doctor.checks import is_beyond_loopback, judge_agents, judge_exposed_nodes, judge_membership
from rmpa.observe.doctor.facts import NetworkInterface
from rmpa.observe.doctor.machine import judge_clock, judge_peer_clock, judge_rights, judge_sim_time
from rmpa.observe.doctor.network import (
    MulticastEcho,
    Port,
    judge_interfaces,
    judge_multicast,
    judge_port,
    judge_radio,
    judge_routes,
    judge_rp_filter,
)
from rmpa.observe.peer_info import FAIL, FOREIGN, OK, SKIPPED, WARN, Check, CheckLevel, PeerInfo
from rmpa.observe.snapshot import FilesInfo, Snapshot, UnreachableInfo
from rmpa.trust.permissions import TrustStatus
from tests.observe.samples import SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

LO = NetworkInterface("lo", (IPv4Interface("127.0.0.1/8"),), loopback=True)
WLAN = NetworkInterface("wlan0", (IPv4Interface("192.168.1.5/24"),))
ETH = NetworkInterface("eth0", (IPv4Interface("10.0.0.5/24"),))
STRICT: Final = {"all": 1, "wlan0": 0, "eth0": 0}
GOOD: Final[dict[str, Any]] = {"stepped": 0.00001, "synchronised": True, "error": 0.004, "year": 2026}
WALL: Final = 1_790_000_000
TAKEN: Final = "Address already in use"
MEMBER: Final = TrustStatus(on=True, module="arm", expires=WALL + 7200, key=3, deny_number=1)
JOYSTICK, PC = SNAPSHOT.peers
RADIO: Final = ("wlan0", "10.0.0.0/24", "")
ROUTES: Final = {f"10.0.{n >> 8}.{n & 255} (m{n})": "" for n in range(999)} | {"10.1.0.2 (arm)": "none"}


def interfaces(
    *more: NetworkInterface, wanted: tuple[str, ...] = (), container: bool = False
) -> Callable[[], Iterable[Check]]:
    return partial(judge_interfaces, (LO, *more), wanted, container=container)


def card(name: str, network: str) -> NetworkInterface:
    return NetworkInterface(name, (IPv4Interface(network),))


def one(judge: Callable[..., Check], *args: object, **more: object) -> Callable[[], Iterable[Check]]:
    return lambda: [judge(*args, **more)]


def agent(snapshot: Snapshot = SNAPSHOT, version: str = "0.1.0", **changes: object) -> Callable[[], Iterable[Check]]:
    return partial(judge_agents, {"base": msgspec.structs.replace(snapshot, **changes)}, version)


def files(problem: str = "", *, near: bool = False) -> Callable[[], Iterable[Check]]:
    few = FilesInfo(open=60, limit=64, hard=64, reserved=16, near=near, problem=problem)
    changed = msgspec.structs.replace(SNAPSHOT.agent, files=few)
    return agent(agent=changed, notes=(problem,) if problem else ())


Said = tuple[str, CheckLevel, str, str]
CASES: dict[str, tuple[Callable[[], Iterable[Check]], tuple[Said, ...]]] = {
    # The facts; of what is said: the subject, the level, a part of the text, a part of the remedy.
    "two ordinary interfaces": (interfaces(WLAN, ETH), (("wlan0", OK, "", ""), ("eth0", OK, "", ""))),
    "an interface that is down": (
        interfaces(NetworkInterface("eth0", up=False, used=False)),
        (("", WARN, "none but loopback", "eth0"),),
    ),
    "no network at all": (interfaces(), (("", WARN, "none but loopback", "plug in a network"),)),
    "settings that keep to loopback": (
        interfaces(NetworkInterface("eth0", ETH.networks, used=False), wanted=("lo",)),
        (("lo", OK, "keep agents to this machine", ""),),
    ),
    "an interface that is not there": (
        interfaces(WLAN, wanted=("wlan0", "eth7")),
        (("eth7", WARN, "there are lo, wlan0", "plug it in"), ("wlan0", OK, "", "")),
    ),
    **{
        f"a tunnel {name}": (interfaces(card(name, "10.8.0.2/32")), ((name, WARN, "no multicast", "--seed"),))
        for name in ("tun0", "wg0", "tailscale0", "ztabc")
    },
    "interfaces of containers": (
        interfaces(card("docker0", "172.17.0.1/16")),
        (("docker0", OK, "containers", "--interface"),),
    ),
    "an address that no DHCP gave": (
        interfaces(card("eth0", "169.254.3.4/16")),
        (("eth0", WARN, "DHCP", "right network"),),
    ),
    "two interfaces in one network": (
        interfaces(WLAN, card("eth0", "192.168.1.6/24")),
        (
            *(("wlan0", OK, "", ""), ("eth0", OK, "", "")),
            ("wlan0+eth0", WARN, "both in 192.168.1.0/24", "keep one of them"),
        ),
    ),
    "a container": (
        interfaces(ETH, container=True),
        (("eth0", OK, "", ""), ("eth0", WARN, "a container", "--network host")),
    ),
    "multicast": (
        partial(
            judge_multicast,
            (MulticastEcho("lo", after=0.0002), MulticastEcho("eth0"), MulticastEcho("wlan0", "not permitted")),
            *("239.255.82.77", 11411),
        ),
        (
            ("lo", OK, "heard 0.2 ms later", ""),
            ("eth0", FAIL, "not heard", "11411"),
            ("wlan0", FAIL, "not permitted", "--seed"),
        ),
    ),
    # The greater of both values counts: 2 is loose.
    "strict filters and two interfaces": (
        one(judge_rp_filter, STRICT, (LO, WLAN, ETH)),
        (("", WARN, "strict on wlan0, eth0", "rp_filter=2"),),
    ),
    "strict filters and one interface": (one(judge_rp_filter, STRICT, (LO, WLAN)), (("", OK, "", ""),)),
    "loose filters": (one(judge_rp_filter, {"all": 2, "wlan0": 1}, (WLAN, ETH)), (("", OK, "", ""),)),
    "unknown filters": (one(judge_rp_filter, {}, (WLAN, ETH)), (("", SKIPPED, "", ""),)),
    "routes": (
        partial(judge_routes, {"10.1.0.2 (arm)": "Network is unreachable", "10.0.0.2 (base)": ""}),
        (("10.1.0.2 (arm)", FAIL, "unreachable", "ip route"), ("10.0.0.2 (base)", OK, "there is a way", "")),
    ),
    "no routes": (partial(judge_routes, {}), (("", SKIPPED, "", ""),)),
    "routes to many": (
        partial(judge_routes, ROUTES),
        (
            ("10.1.0.2 (arm)", FAIL, "none", "ip route"),
            ("", OK, "a way to 999 of 1,000 peers and seeds", ""),
        ),
    ),
    "a port that another program has": (
        one(judge_port, Port("the ROS core", 11311, TAKEN, "roscore (pid 7)")),
        (("11311", FAIL, "taken by roscore (pid 7)", ":11311"),),
    ),
    "a port of ours": (
        one(judge_port, Port("the mesh (TCP)", 40001, TAKEN, "agent base", ours=True)),
        (("40001", OK, "agent base has it", ""),),
    ),
    "a free port": (one(judge_port, Port("beacons (UDP)", 11411)), (("11411", OK, "beacons (UDP): free", ""),)),
    "a shared port": (
        one(judge_port, Port("beacons (UDP)", 11412, owner="agent base")),
        (("11412", OK, "used by agent base; others may use it too", ""),),
    ),
    "no radio": (partial(judge_radio, (), quick=False, bbr=False), (("", SKIPPED, "", ""),)),
    "a radio and a quick kernel": (
        partial(judge_radio, [RADIO], quick=True, bbr=True),
        (("wlan0", OK, "repeat lost commands soon", "ip route change 10.0.0.0/24 dev wlan0 rto_min 40ms"),),
    ),
    "a radio whose losses are repeated late and whose queue is filled": (
        partial(judge_radio, [RADIO], quick=False, bbr=False),
        (("wlan0", WARN, "200 ms", "rto_min 40ms"), ("wlan0", WARN, "BBR", "tcp_allowed_congestion_control")),
    ),
    "a radio that was set": (
        partial(judge_radio, [(*RADIO[:2], "40ms")], quick=False, bbr=True),
        (("wlan0", OK, "rto_min 40ms", ""),),
    ),
    "a good clock": (
        partial(judge_clock, **GOOD),
        (("step", OK, "", ""), ("synchronised", OK, "within ±4.0 ms", "")),
    ),
    "a clock that was set and of which nothing is known": (
        partial(judge_clock, **GOOD | {"stepped": -0.2, "synchronised": None}),
        (("step", WARN, "-200.0 ms", "chrony"), ("synchronised", SKIPPED, "", "")),
    ),
    "a clock alone, in the year 1970": (
        partial(judge_clock, **GOOD | {"synchronised": False, "year": 1970}),
        (
            ("date", FAIL, "the year 1970", "chrony"),
            *(("step", OK, "", ""), ("synchronised", WARN, "no other clock", "chrony")),
        ),
    ),
    "no simulated time": (partial(judge_sim_time, "base", None), ()),
    "simulated time": (
        partial(judge_sim_time, "base", ["/gazebo"]),
        (("simulated time of base", OK, "/gazebo", ""),),
    ),
    "simulated time that stands": (
        partial(judge_sim_time, "base", []),
        (("simulated time of base", WARN, "nodes that start stand still at time 0", "rosparam delete"),),
    ),
    "clocks that agree": (one(judge_peer_clock, "base", "arm", 0.001, 0.0), (("base-arm", OK, "ahead of", ""),)),
    "a clock ahead": (
        one(judge_peer_clock, "base", "arm", 0.5, 0.0),
        (("base-arm", WARN, "ahead of", "extrapolat"),),
    ),
    "a clock behind": (
        one(judge_peer_clock, "base", "arm", -0.5, None),
        (("base-arm", WARN, "behind", "extrapolat"),),
    ),
    "a clock within its error": (one(judge_peer_clock, "base", "arm", 0.5, 0.6), (("base-arm", OK, "", ""),)),
    "all rights": (partial(judge_rights, "", None, 65536, wanted=True), (("", OK, "", ""), ("", OK, "65536", ""))),
    "no rights and few files": (
        partial(judge_rights, "not permitted", 65536, 1024, wanted=True),
        (
            ("", WARN, "no SCHED_FIFO (not permitted); only 64 KiB", "LimitRTPRIO"),
            ("", WARN, "1024", "LimitNOFILE"),
        ),
    ),
    "rights that are not wanted; an agent tells its files": (
        partial(judge_rights, "not permitted", 65536, None, wanted=False),
        (("", OK, "not asked for", ""),),
    ),
    "a member": (
        one(judge_membership, MEMBER, WALL),
        (("arm", OK, "its certificate is valid for 2 h more; group key 3, deny list 1", ""),),
    ),
    "a certificate that ends": (
        one(judge_membership, msgspec.structs.replace(MEMBER, problems=("ends in 2 h; start it",)), WALL),
        (("arm", WARN, "ends in 2 h", "start it"),),
    ),
    "a certificate that has ended": (
        one(judge_membership, msgspec.structs.replace(MEMBER, problems=("ended; renew it",)), WALL + 8000),
        (("arm", FAIL, "ended", "renew it"),),
    ),
    "a clock that is not set": (
        one(
            judge_membership, msgspec.structs.replace(MEMBER, clock_set=False, problems=("not set; do",)), WALL + 8000
        ),
        (("arm", WARN, "not set", "do"),),
    ),
    "nodes of an open mesh": (
        one(judge_exposed_nodes, "base", None, trusted=False),
        (("base", SKIPPED, "", ""),),
    ),
    "unknown nodes": (one(judge_exposed_nodes, "base", None, trusted=True), (("base", SKIPPED, "", ""),)),
    "nodes on loopback": (one(judge_exposed_nodes, "base", {}, trusted=True), (("base", OK, "", ""),)),
    "exposed nodes": (
        one(judge_exposed_nodes, "base", {"/talker": (1, 2), "/camera": (5,)}, trusted=True),
        (("base", WARN, "reach /camera (5), /talker (1, 2) without", "ROS_IP=127.0.0.1"),),
    ),
    "exposed nodes and direct transport": (
        one(judge_exposed_nodes, "base", {f"/n{n}": (n,) for n in range(9)}, trusted=True, direct=True),
        (("base", WARN, "/n4 (4) and 4 more", "direct transport needs them open"),),
    ),
    "no agent": (partial(judge_agents, {}, "0.1.0"), (("", SKIPPED, "none runs", "rmpa up"),)),
    "an agent that does not answer": (
        partial(judge_agents, {"base": "no agent answers in time"}, "0.1.0"),
        (("base", FAIL, "in time", "stopped"),),
    ),
}


@pytest.mark.parametrize(("judge", "said"), CASES.values(), ids=CASES)
def test_what_is_said_of_facts(judge: Callable[[], Iterable[Check]], said: tuple[Said, ...]) -> None:
    found = [*judge()]
    assert [(check.where, check.level) for check in found] == [(where, level) for where, level, *_ in said]
    for check, (_, level, text, remedy) in zip(found, said, strict=True):
        assert text in check.text
        assert remedy in check.remedy
        assert check.remedy or level not in (WARN, FAIL) or text in SNAPSHOT.notes, "trouble has a remedy"


AGENTS: dict[str, tuple[Callable[[], Iterable[Check]], str, tuple[Said, ...]]] = {
    # Of one agent: the facts, the check, what is said.
    "itself": (
        agent(),
        "agent",
        (
            ("base", OK, "domain 3, core http://127.0.0.1:11311/, mesh 10.0.0.1:40001", ""),
            ("base", WARN, "no multicast on eth0", ""),
        ),
    ),
    "its proxies": (agent(), "proxies", (("base", OK, "17 nodes of peers, 2 listening sockets: two for all", ""),)),
    "its core": (agent(), "core memory", (("base", OK, SNAPSHOT.agent.core_memory, ""),)),
    "its peers": (
        agent(),
        "peer",
        (
            ("base-joystick", OK, "linked by 10.0.0.2:40002, found by multicast", ""),
            ("base-joystick", WARN, "2 messages were given up", "max_rate"),
            ("base-pc", WARN, "shares its name", "--name"),
            ("base-pc", WARN, "linking: connection refused", "firewall"),
        ),
    ),
    "their clocks": (agent(), "clock", (("base-joystick", OK, "1.2 ms ±0.2 ms behind ours", ""),)),
    "a conflict that keeps a peer out": (
        agent(peers=(msgspec.structs.replace(PC, state="conflict"),)),
        "peer",
        (("base-pc", FAIL, "shares its name with 10.0.0.9:40003#4", ""), ("base-pc", WARN, "conflict", "firewall")),
    ),
    "a module that is not of this mesh, and no advice on multicast": (
        agent(
            peers=(),
            strangers=(
                PeerInfo(
                    name="opn",
                    guid="g",
                    instance="33" * 16,
                    state=FOREIGN,
                    since_ago=1.0,
                    last_error="not of this mesh: it has not joined; let it join",
                ),
            ),
        ),
        "peer",
        (("base-opn", WARN, "not of this mesh: it has not joined", "let it join"),),
    ),
    "a relayed peer needs no link": (
        agent(peers=(msgspec.structs.replace(JOYSTICK, state="relayed", link=None),)),
        "peer",
        (("base-joystick", OK, "relayed: another peer passes on its topics", ""),),
    ),
    "of many peers the problems": (
        agent(
            peers=(
                *(msgspec.structs.replace(JOYSTICK, name=f"m{n}", state="relayed", link=None) for n in range(999)),
                *(JOYSTICK, PC),
            )
        ),
        "peer",
        (
            ("base-joystick", WARN, "", ""),
            *(("base-pc", WARN, "", ""), ("base-pc", WARN, "", "")),
            ("base", OK, "999 of 1,001 have no problem: 999 relayed", ""),
        ),
    ),
    "what permissions refused": (
        agent(counters={"link.up": 3, "permission.call": 1, "permission.publish": 4}),
        "permissions",
        (("base", OK, "refused so far: 1 call, 4 publish; its log names the rules", ""),),
    ),
    "nodes that cannot be reached": (
        agent(
            unreachable=(
                UnreachableInfo(node="/cam", uri="http://nosuch:1/", problem="no such name", ago=3.0),
                UnreachableInfo(node="/gone", uri="http://10.9.9.9:1/", problem="none", ago=60.0, withdrawn=True),
            )
        ),
        "node",
        (
            ("/cam", WARN, "/cam cannot be reached at http://nosuch:1/ (no such name)", "ROS_IP=127.0.0.1"),
            ("/gone", FAIL, "so peers are not offered it", "ROS_IP=127.0.0.1"),
        ),
    ),
    "another version": (
        agent(notes=(), version="0.2.0"),
        "agent",
        (("base", OK, "", ""), ("base", WARN, "it is RMPA 0.1.0, this command is 0.2.0", "start it again")),
    ),
    "alone": (agent(peers=()), "peer", (("base", WARN, "knows no peer (domain 3, looking on wlan0)", "--domain 3"),)),
    "files": (files(), "files", (("base", OK, "60 of 64 file descriptors are open; the last 16 are kept", ""),)),
    "few files": (files(near=True), "files", (("base", WARN, "", "prlimit --pid 4242"),)),
    "no file": (
        files("node /x is refused: none left; raise it", near=True),
        "files",
        (("base", FAIL, "node /x is refused: none left; 60 are open", "raise it"),),
    ),
    "a shortage is said once": (files("none left; raise it"), "agent", (("base", OK, "", ""),)),
}


@pytest.mark.parametrize(("judge", "name", "said"), AGENTS.values(), ids=AGENTS)
def test_what_is_said_of_an_agent(judge: Callable[[], Iterable[Check]], name: str, said: tuple[Said, ...]) -> None:
    test_what_is_said_of_facts(lambda: [check for check in judge() if check.name == name and check.where], said)


@pytest.mark.parametrize(
    ("address", "beyond"),
    [("127.0.0.1", False), ("127.1.2.3", False), ("::1", False), ("0.0.0.0", True), ("::", True), ("10.0.0.1", True)],
)
def test_loopback(address: str, beyond: bool) -> None:
    assert is_beyond_loopback(address) is beyond
