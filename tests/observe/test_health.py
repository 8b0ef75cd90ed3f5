"""Snapshots judged by the levels of REP 107."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from rmpa.core.facts import EventInfo, FilesInfo, RouteInfo, ServiceInfo, UnreachableInfo
from rmpa.observe import limits
from rmpa.observe.health import HERE, Health, diagnostic_status
from rmpa.observe.snapshot import PeerInfo, Snapshot
from tests.observe.samples import DIRECT, SNAPSHOT, VIEWER

JOYSTICK, _ = SNAPSHOT.peers
assert JOYSTICK.link is not None
(ROUTE,) = SNAPSHOT.topics[0].routes

HEALTHY = msgspec.structs.replace(ROUTE, events={}, recent=(), contract={}, oversized=0, oversized_bytes=270_000_000)


def with_routes(*routes: RouteInfo, peers: tuple[PeerInfo, ...] = SNAPSHOT.peers, **topic: object) -> Snapshot:
    info = msgspec.structs.replace(SNAPSHOT.topics[0], routes=routes, **topic)
    return msgspec.structs.replace(SNAPSHOT, topics=(info,), peers=peers)


Steps = tuple[tuple[float, Snapshot], ...]


def route(**changes: object) -> RouteInfo:
    return msgspec.structs.replace(HEALTHY, **changes)


def steps(*snapshots: Snapshot) -> Steps:
    """Snapshots of this agent, one a second."""
    return tuple((float(second), snapshot) for second, snapshot in enumerate(snapshots))


def topic(*routes: dict[str, Any], **topic: Any) -> Steps:
    """``/cmd`` with a route of the joystick, once for each change."""
    return steps(*(with_routes(route(**changes), **topic) for changes in routes))


def peer(*changes: dict[str, Any]) -> Steps:
    return steps(*(with_routes(peers=(msgspec.structs.replace(JOYSTICK, **each),)) for each in changes))


def files(*, near: bool = True, problem: str = "") -> Steps:
    few = FilesInfo(open=60, limit=64, hard=64, reserved=16, near=near, problem=problem)
    agent = msgspec.structs.replace(SNAPSHOT.agent, files=few)
    return steps(msgspec.structs.replace(SNAPSHOT, agent=agent, topics=(), notes=(problem,) if problem else ()))


def services(*found: tuple[ServiceInfo, ...]) -> Steps:
    return steps(*(msgspec.structs.replace(SNAPSHOT, topics=(), services=each) for each in found))


def relayed(**changes: object) -> dict[str, object]:
    relay = {"transport": "relay", "state": "relayed", "endpoint": "", "condition": "reachable", "text": "no way"}
    return {"transport": "relay", "subscribers": (msgspec.structs.replace(VIEWER, **relay | changes),)}


ODD = UnreachableInfo(node="/odd", uri="http://nosuch:1/", problem="no such name", ago=20.0, withdrawn=True)
SILENT = EventInfo(kind="liveliness_lost", count=1, text="no link for 2 s", ago=1.0)
LOST = msgspec.structs.replace(JOYSTICK, state="linking", link=None, last_error="silent")
GHOST = msgspec.structs.replace(JOYSTICK, guid="10.0.0.2:40002#0", state="linking", link=None)
TWIN = msgspec.structs.replace(JOYSTICK, guid="10.0.0.9:40002#1")
AWAY: dict[str, Any] = {"direction": "out", "state": "away", "problem": "joystick is away for 12 s", "lost": 0}
OVERSIZED = tuple(
    with_routes(route(direction="out", lost=0, oversized=count), route(oversized=count)) for count in (0, 1, 3, 3)
)
USED = ServiceInfo(name="/add", node="/adder", direction="in", peer="joystick", calls=3, type="a/Add", state="open")
FAILED = msgspec.structs.replace(USED, calls=5, failed=1, problem="it sticks")

CASES: dict[str, Steps] = {
    "the agent, its peers and topics": steps(SNAPSHOT),
    "without notes; what goes out has no status": steps(
        msgspec.structs.replace(SNAPSHOT, notes=(), topics=SNAPSHOT.topics[1:])
    ),
    "few files": files(),
    "no files": files(problem="node /x has to wait"),
    "no subscriber": topic({"state": "idle", "rate": None}),
    "no message": topic({"rate": None, "age": None}),
    "an old message": topic({"rate": None, "age": 90.0}),
    "no latency": topic({"latency": None}),
    "hidden": topic({"state": "hidden", "problem": "another type"}),
    "hidden by a limit": topic({"state": "hidden", "problem": "more than limits.nodes = 1", "limit": "nodes"}),
    "waiting": topic({"state": "waiting", "problem": "no answer"}),
    "within the deadline": topic({"contract": {"deadline": 0.2}, "age": 0.15}),
    "beyond the deadline": topic({"contract": {"deadline": 0.2}, "age": 0.5}),
    "dead": topic({"events": {"liveliness_lost": 1}}, {"events": {"liveliness_lost": 1}, "recent": (SILENT,)}),
    "alive again": topic({"events": {"liveliness_lost": 1, "liveliness_restored": 1}}),
    "a subscriber that was refused": topic({}, mismatches=("another md5",)),
    "a subscriber that was refused elsewhere": steps(with_routes(mismatches=("pc/viewer wants another md5",))),
    "a node that cannot be reached": steps(msgspec.structs.replace(SNAPSHOT, topics=(), unreachable=(ODD,))),
    "new losses warn once": topic(
        {}, {"lost": 5, "expired": 5, "events": {"deadline_missed": 1}}, {"lost": 5, "expired": 5}, {"lost": 0}
    ),
    "an unknown loss": topic({}, {"events": {"loss_unknown": 1}}),
    "messages that are too long, at both ends": steps(*OVERSIZED),
    "a reliable route to an absent peer": topic(
        {**AWAY, "kept": 7}, {**AWAY, "lost": 7046}, {**AWAY, "lost": 7046}, {**AWAY, "lost": 7046, "state": "open"}
    ),
    "sources of one topic": steps(with_routes(HEALTHY, route(node="/other"), HEALTHY)),
    "a publisher that ended is forgotten": steps(with_routes(HEALTHY), with_routes()),
    "a direct subscriber": steps(with_routes(DIRECT)),
    "a direct subscriber and others": topic({"transport": "both", "subscribers": (VIEWER,)}),
    "relayed": topic(relayed(wanted="auto")),
    "relayed although direct is wanted": topic(relayed(wanted="direct")),
    "relayed by a rule": topic(relayed(wanted="direct", condition="transport")),
    "relayed for a tool": topic(relayed(wanted="direct", condition="measures")),
    "direct although it must not be": topic(relayed(transport="direct", endpoint="10.0.0.2:41234")),
    "a peer": peer({}, {"state": "relayed", "link": None, "via": "gate"}),
    "a peer that is not linked": peer({"state": "linking", "link": None}),
    "a peer that refuses": peer({"state": "refused", "link": None, "last_error": "another domain"}),
    "a conflict": peer({"state": "conflict", "link": None, "conflicts": ("one GUID",)}),
    "a link that drops": peer({}, {"link": msgspec.structs.replace(JOYSTICK.link, dropped=7)}),
    "a lost peer and its topics": (
        (0.0, with_routes(HEALTHY, peers=(JOYSTICK,))),
        (1.0, with_routes(route(state="waiting", problem="its peer is away"), peers=(LOST,))),
        (2.0, with_routes(peers=())),
        (limits.DIAGNOSTICS_STALE + 1, with_routes(peers=())),
        (100.0, with_routes(HEALTHY, peers=(JOYSTICK,))),
    ),
    "a restarted peer, and another of its name": steps(with_routes(peers=(GHOST, JOYSTICK, TWIN))),
    "calls": services(
        (msgspec.structs.replace(USED, calls=0),),
        (ServiceInfo(name="/add", node="/mine", direction="out", calls=1), USED),
        (FAILED,),
        (FAILED,),
    ),
}
"""Snapshots in turn; the golden file has the statuses."""


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_names_are_unique_and_figures_are_texts(case: Steps) -> None:
    health = Health()
    for now, snapshot in case:
        found = [diagnostic_status(check, snapshot.agent.name) for check in health.judge(snapshot, now)]
        assert len({status.name for status in found}) == len(found)
        assert {status.hardware_id for status in found} == {"base"}
        assert found[0].name == HERE
        assert all(status.values[key] for status in found for key in status.values)
