"""What users and programs read of checks, byte for byte: doctor's JSON and lines, why's JSON, /diagnostics.

``.venv/bin/python -m tests.observe.test_golden`` writes the files anew, after a change of texts that is meant.
"""

from __future__ import annotations

from dataclasses import replace
from ipaddress import IPv4Interface
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click
import msgspec
import pytest

from rmpa.cli.agent import _json as doctor_json
from rmpa.cli.agent import _lines as doctor_lines
from rmpa.cli.agent import _stage_lines as why_lines
from rmpa.cli.agent import _summary as doctor_summary
from rmpa.observe.doctor.checks import judge_agents
from rmpa.observe.doctor.facts import NetworkInterface
from rmpa.observe.doctor.machine import judge_clock, judge_rights, judge_shell
from rmpa.observe.doctor.network import (
    MulticastEcho,
    Port,
    judge_interfaces,
    judge_multicast,
    judge_port,
    judge_radio,
    judge_routes,
    judge_rp_filter,
    judge_rules,
    read_iptables,
    read_nft,
)
from rmpa.observe.health import Health, diagnostic_status
from rmpa.observe.peer_info import exit_code
from rmpa.observe.snapshot import EventInfo, FilesInfo, ServiceInfo, Snapshot, UnreachableInfo
from rmpa.ros.types.definitions import frame_array
from tests.observe.doctor.test_firewall import IPTABLES_UFW, NFT_AGAINST, NFT_CLOSED, NFT_OPEN, NFT_OURS, PORTS
from tests.observe.doctor.test_ros_environment import SHELL
from tests.observe.samples import DIRECT, SNAPSHOT, VIEWER
from tests.observe.why import test_direct_stages, test_services, test_topics

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from rmpa.observe.peer_info import Check, PeerInfo
    from rmpa.observe.why.diagnosis import Diagnosis

RADIO: Final = ("wlan0", "10.0.0.0/24", "")
GOLDEN: Final = Path(__file__).with_name("golden")
JOYSTICK, PC = SNAPSHOT.peers
(ROUTE,) = SNAPSHOT.topics[0].routes
LO = NetworkInterface("lo", (IPv4Interface("127.0.0.1/8"),), loopback=True)
ETH = NetworkInterface("eth0", (IPv4Interface("10.0.0.1/24"),))
WLAN = NetworkInterface("wlan0", (IPv4Interface("192.168.1.5/24"),))


def with_files(*, near: bool = False, problem: str = "") -> Snapshot:
    files = FilesInfo(open=60, limit=64, hard=64, reserved=16, near=near, problem=problem)
    agent = msgspec.structs.replace(SNAPSHOT.agent, files=files)
    return msgspec.structs.replace(SNAPSHOT, agent=agent, notes=(problem,) if problem else ())


def with_peers(*peers: PeerInfo) -> Snapshot:
    return msgspec.structs.replace(SNAPSHOT, peers=peers, notes=())


def with_misplaced() -> Snapshot:
    """A direct topic; another one whose subscriber is direct and has to be relayed."""
    caught = {"state": "relayed", "condition": "name", "text": "it has another name there"}
    misplaced = msgspec.structs.replace(DIRECT, subscribers=(msgspec.structs.replace(VIEWER, **caught),))
    cmd, odom = SNAPSHOT.topics
    topics = (msgspec.structs.replace(cmd, routes=(DIRECT,)), msgspec.structs.replace(odom, routes=(misplaced,)))
    return msgspec.structs.replace(with_peers(JOYSTICK), topics=topics)


def document(value: Sequence[object], lines: Sequence[str]) -> bytes:
    """As JSON, one object a line, and the lines behind it."""
    plain = (click.unstyle(line).encode() for line in lines)
    return b"\n".join((msgspec.json.encode(value).replace(b"},{", b"},\n{"), *plain, b""))


def findings() -> Iterator[Check]:
    yield from judge_agents({}, "0.1.0")
    cam = UnreachableInfo(node="/cam", uri="http://nosuch:1/", problem="no such name", ago=3.0)
    gone = UnreachableInfo(node="/gone", uri="http://10.9.9.9:1/", problem="no answer", ago=60.0, withdrawn=True)
    shown: dict[str, Snapshot | str] = {
        "base": msgspec.structs.replace(SNAPSHOT, unreachable=(cam, gone)),
        "stopped": "no agent answers in time",
        "few": with_files(near=True),
        "none": with_files(near=True, problem="node /x is refused: none left; raise it"),
        "alone": with_peers(),
        "misplaced": with_misplaced(),
        "refused": with_peers(msgspec.structs.replace(PC, state="refused", conflicts=("no remedy",), last_error="")),
    }
    yield from judge_agents(shown, "0.1.0")
    yield from judge_agents({"older": SNAPSHOT}, "0.2.0")
    yield from judge_interfaces((LO, WLAN, ETH), ())
    yield from judge_interfaces((LO, NetworkInterface("eth0", up=False, used=False)), ())
    yield from judge_interfaces((LO,), ())
    yield from judge_interfaces((LO, replace(ETH, used=False)), ("lo",))
    yield from judge_interfaces((LO, WLAN), ("wlan0", "eth7"))
    odd = {"tun0": "10.8.0.2/32", "docker0": "172.17.0.1/16", "usb0": "169.254.3.4/16", "eth1": "10.0.0.2/24"}
    cards = (LO, ETH, *(NetworkInterface(name, (IPv4Interface(at),)) for name, at in odd.items()))
    yield from judge_interfaces(cards, (), container=True)
    echoes = (MulticastEcho("lo", after=0.0002), MulticastEcho("eth0"), MulticastEcho("wlan0", "not permitted"))
    yield from judge_multicast(echoes, "239.255.82.77", 11411)
    yield from judge_multicast((MulticastEcho("lo", after=0.0002),), "239.255.82.77", 11411, 30.0)
    yield from judge_multicast(
        (MulticastEcho("eth0", after=0.01, others={"10.0.0.2"}),), "239.255.82.77", 11411, 30.0
    )
    for rules in (
        *(read_nft(text, PORTS) for text in ("", NFT_OPEN, NFT_CLOSED, NFT_OURS, NFT_AGAINST)),
        read_iptables(IPTABLES_UFW, PORTS),
    ):
        yield judge_rules(rules, "UDP port 11411")
    for values in ({}, {"all": 1, "wlan0": 0, "eth0": 0}, {"all": 2}):
        yield judge_rp_filter(values, (LO, WLAN, ETH))
    marked = (*RADIO[:2], "40ms")
    for radios, quick in ((), True), ((RADIO,), True), ((RADIO, marked), False):
        yield from judge_radio(radios, quick=quick, bbr=quick)
    yield from judge_routes({})
    yield from judge_routes({"10.1.0.2 (arm)": "Network is unreachable", "10.0.0.2 (base)": ""})
    yield from map(
        judge_port,
        (
            Port("the ROS core", 11311, "Address already in use", "roscore (pid 7)"),
            Port("the ROS core", 11312, "Address already in use"),
            Port("the mesh (TCP)", 40001, "Address already in use", "agent base", ours=True),
            Port("beacons (UDP)", 11411),
            Port("beacons (UDP)", 11412, owner="agent base and python3 (pid 7)"),
        ),
    )
    for environ in (
        {"ROS_MASTER_URI": "http://10.0.0.1:11311", "ROS_IP": "127.0.0.1", "ROS_DOMAIN_ID": "0"},
        {"ROS_MASTER_URI": "http://robot2:11311", "ROS_IP": "base", "ROS_DOMAIN_ID": "7"},
        {"ROS_MASTER_URI": "http://nobody:11311", "ROS_IP": "10.0.0.9", "ROS_DOMAIN_ID": "x"},
        {"ROS_MASTER_URI": "http://localhost:11312", "ROS_HOSTNAME": "nobody", "ROS_LOCALHOST_ONLY": "1"},
        {"ROS_MASTER_URI": "localhost:11311", "ROS_HOSTNAME": "http://base:1", "ROS_NAMESPACE": "/robot"},
        {"ROS_IP": "10.0.0.1", "ROS_HOSTNAME": "base.local", "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"},
    ):
        yield from judge_shell(replace(SHELL, environ=environ))
    alone = replace(SHELL, cores={}, domains={})
    for shell in (alone, replace(alone, answers=True), replace(SHELL, resolved={}, host_name="odd")):
        yield from judge_shell(shell)
    for answers in (True, False):
        shell = replace(alone, external="http://robot2:11311/", answers=answers)
        yield from judge_shell(replace(shell, environ={"ROS_MASTER_URI": "http://robot2:11311"}))
    yield from judge_clock(0.00001, True, 0.004, 2026)
    yield from judge_clock(-0.2, False, 0.0, 1970)
    yield from judge_clock(0.00001, None, 0.004, 2026)
    yield from judge_rights("", None, 65536, wanted=True)
    yield from judge_rights("Operation not permitted", 65536, 1024, wanted=True)
    yield from judge_rights("Operation not permitted", 65536, None, wanted=False)


def doctor() -> bytes:
    """The document of ``--json``, and the lines of a terminal."""
    found = list(findings())
    lines = [line for finding in found for line in doctor_lines(finding)]
    lines += [doctor_summary(found), f"exit code {exit_code(found)}"]
    return document([*map(doctor_json, found)], lines)


def diagnoses() -> Iterator[Diagnosis]:
    yield from test_topics.Case().walk()
    for topic, *_ in test_topics.FAILURES.values():
        yield from topic.walk()
    for topic, *_ in test_topics.WARNINGS.values():
        yield from topic.walk()
    yield from test_topics.Case(subscribers=(), readers=(), **test_topics.route(state="idle")).walk()
    yield from test_topics.Case(there=None, refusal="it is older").walk()
    yield from test_direct_stages.direct().walk()
    yield from test_direct_stages.direct(relayed=True).walk()
    for topic, *_ in test_direct_stages.FAILURES.values():
        yield from topic.walk()
    yield test_services.walk()
    for here, there, *_ in test_services.FAILURES.values():
        yield test_services.walk(here, there)
    yield test_services.walk(there=None)
    yield test_services.walk(test_services.told(failed=1, problem="took more than 60 s"))


def why() -> bytes:
    """What the control socket and the peers carry, and the lines of a terminal."""
    found = list(diagnoses())
    lines = [line for diagnosis in found for line in why_lines(diagnosis)]
    return document(found, lines)


def snapshots() -> Iterator[Snapshot]:
    """An agent's, one a second: it has troubles, its links and topics get worse, and end."""
    healthy = msgspec.structs.replace(ROUTE, events={}, recent=(), contract={}, oversized=0)
    topic = SNAPSHOT.topics[0]
    yield SNAPSHOT
    for changes in (
        {},
        {"lost": 5, "expired": 5, "events": {"deadline_missed": 1}},
        {"state": "idle", "rate": None, "period": None, "latency": None},
        {"rate": None, "age": 90.0},
        {"state": "hidden", "problem": "another type"},
        {"problem": "more topics than limits.topics = 1", "limit": "topics"},
        {"contract": {"deadline": 0.2}, "age": 0.5},
        {"events": {"liveliness_lost": 1}},
        {
            "events": {"liveliness_lost": 1},
            "recent": (EventInfo(kind="liveliness_lost", count=1, text="no link for 2 s", ago=1.0),),
        },
    ):
        route = msgspec.structs.replace(healthy, **changes)
        out = msgspec.structs.replace(route, direction="out", state="away", kept=7, node="/mine")
        topics = (msgspec.structs.replace(topic, routes=(route, healthy, out)),)
        yield msgspec.structs.replace(with_peers(JOYSTICK, PC), topics=topics)
    yield with_misplaced()
    refused = msgspec.structs.replace(SNAPSHOT.topics[1], mismatches=("pc/viewer wants another md5",))
    gone = UnreachableInfo(node="/odd", uri="http://nosuch:1/", problem="no such name", ago=20.0, withdrawn=True)
    called = ServiceInfo(name="/add", node="/adder", direction="in", peer="joystick", calls=3, type="a/Add")
    for failed in (0, 1):
        services = (msgspec.structs.replace(called, calls=3 + failed, failed=failed, problem="it sticks"),)
        yield msgspec.structs.replace(
            with_files(near=True), topics=(refused,), unreachable=(gone,), services=services
        )
    lost = msgspec.structs.replace(JOYSTICK, state="linking", link=None, last_error="silent")
    yield with_peers(lost, msgspec.structs.replace(PC, state="refused"))
    yield with_files(near=True, problem="node /x is refused")
    yield with_peers()


def diagnostics() -> bytes:
    """The messages on /diagnostics as TCPROS sends them, one after the other."""
    health, messages = Health(), []
    for second, snapshot in enumerate(snapshots()):
        checks = health.judge(snapshot, float(second))
        parts = [diagnostic_status(check, snapshot.agent.name).serialize() for check in checks]
        messages.append(frame_array(second, second * 1_000_000_000, parts))
    return b"".join(messages)


def shown() -> bytes:
    """A direct route as ``--json`` has it: programs read these names."""
    return b"\n".join(msgspec.json.format(msgspec.json.encode(one), indent=1) for one in (DIRECT, ROUTE)) + b"\n"


FILES: Final = {"doctor.txt": doctor, "why.txt": why, "diagnostics.bin": diagnostics, "route.json": shown}


@pytest.mark.parametrize(("file", "said"), FILES.items(), ids=FILES)
def test_output_is_byte_for_byte_the_same(file: str, said: Callable[[], bytes]) -> None:
    assert said() == (GOLDEN / file).read_bytes()


if __name__ == "__main__":
    for name, made in FILES.items():
        (GOLDEN / name).write_bytes(made())
