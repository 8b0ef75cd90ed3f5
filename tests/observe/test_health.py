"""Snapshots judged by the levels of REP 107."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import pytest

from rmpa.observe import limits
from rmpa.observe.health import HERE, Health, diagnostic_status
from rmpa.observe.snapshot import EventInfo, FilesInfo, RouteInfo, ServiceInfo, Snapshot, UnreachableInfo
from rmpa.ros.types.definitions import DiagnosticLevel, DiagnosticStatus
from tests.observe.samples import DIRECT, SNAPSHOT, VIEWER

if TYPE_CHECKING:
    from rmpa.observe.peer_info import PeerInfo

CMD = "rmpa: joystick: /cmd"
JOYSTICK, PC = SNAPSHOT.peers
(ROUTE,) = SNAPSHOT.topics[0].routes

HEALTHY = msgspec.structs.replace(ROUTE, events={}, recent=(), contract={}, oversized=0, oversized_bytes=270_000_000)


def with_routes(*routes: RouteInfo, peers: tuple[PeerInfo, ...] = SNAPSHOT.peers, **topic: object) -> Snapshot:
    info = msgspec.structs.replace(SNAPSHOT.topics[0], routes=routes, **topic)
    return msgspec.structs.replace(SNAPSHOT, topics=(info,), peers=peers)


def judged(health: Health, snapshot: Snapshot, now: float = 0.0) -> dict[str, DiagnosticStatus]:
    statuses = [diagnostic_status(check, snapshot.agent.name) for check in health.judge(snapshot, now)]
    found = {status.name: status for status in statuses}
    assert len(found) == len(statuses), "names are unique"
    return found


def level(snapshot: Snapshot, name: str = CMD) -> tuple[DiagnosticLevel, str]:
    status = judged(Health(), snapshot)[name]
    return status.level, status.message


def test_agent_peers_and_incoming_topics_have_a_status() -> None:
    found = judged(Health(), with_routes(HEALTHY))
    assert list(found) == [HERE, "rmpa: joystick", "rmpa: pc", CMD]
    assert {status.hardware_id for status in found.values()} == {"base"}
    assert found[CMD].level is DiagnosticLevel.OK
    assert found[CMD].message == "10.0 Hz, 0.41 ms"
    values = found[CMD].values
    assert {key: values[key] for key in ("rate (Hz)", "latency p99 (ms)", "jitter (ms)", "lost")} == {
        "rate (Hz)": "10",
        "latency p99 (ms)": "0.79",
        "jitter (ms)": "0.82",
        "lost": "3",
    }
    assert found["rmpa: joystick"].values["clock error (± ms)"] == "0.216"
    assert found[HERE].values["count beacon.malformed"] == "1"
    assert all(found[name].values[key] for name in found for key in found[name].values)


def test_outgoing_topics_have_no_status() -> None:
    assert list(judged(Health(), msgspec.structs.replace(SNAPSHOT, topics=SNAPSHOT.topics[1:]))) == [
        HERE,
        "rmpa: joystick",
        "rmpa: pc",
    ]


def test_the_agents_notes_are_a_warning() -> None:
    assert level(SNAPSHOT, HERE) == (DiagnosticLevel.WARN, "no multicast on eth0")
    quiet = msgspec.structs.replace(SNAPSHOT, notes=())
    assert level(quiet, HERE) == (DiagnosticLevel.OK, "1 of 2 known peers linked")


@pytest.mark.parametrize(
    ("near", "problem", "expected", "text"),
    [
        (False, "", DiagnosticLevel.OK, "1 of 2 known peers linked"),
        (True, "", DiagnosticLevel.WARN, "60 of 64 file descriptors are open; raise it: LimitNOFILE="),
        (True, "node /x has to wait", DiagnosticLevel.ERROR, "node /x has to wait"),
    ],
)
def test_file_descriptors(near: bool, problem: str, expected: DiagnosticLevel, text: str) -> None:
    files = FilesInfo(open=60, limit=64, hard=64, reserved=16, near=near, problem=problem)
    agent = msgspec.structs.replace(SNAPSHOT.agent, files=files)
    notes = (problem,) if problem else ()
    found, said = level(msgspec.structs.replace(SNAPSHOT, agent=agent, notes=notes), HERE)
    assert found is expected
    assert said.startswith(text)


@pytest.mark.parametrize(
    ("changes", "expected", "text"),
    [
        ({"state": "idle", "rate": None}, DiagnosticLevel.OK, "no node here subscribes"),
        ({"rate": None, "age": None}, DiagnosticLevel.OK, "open"),
        ({"rate": None, "age": 90.0}, DiagnosticLevel.OK, "open, last message 90 s ago"),
        ({"latency": None}, DiagnosticLevel.OK, "10.0 Hz"),
        ({"state": "hidden", "problem": "another type"}, DiagnosticLevel.ERROR, "another type"),
        ({"state": "waiting", "problem": "no answer"}, DiagnosticLevel.WARN, "no answer"),
        ({"contract": {"deadline": 0.2}, "age": 0.15}, DiagnosticLevel.OK, "10.0 Hz, 0.41 ms"),
        ({"contract": {"deadline": 0.2}, "age": 0.5}, DiagnosticLevel.WARN, "no message for 0.5 s; deadline 0.2 s"),
        ({"events": {"liveliness_lost": 1}}, DiagnosticLevel.ERROR, "does not live"),
        ({"events": {"liveliness_lost": 1, "liveliness_restored": 1}}, DiagnosticLevel.OK, "10.0 Hz, 0.41 ms"),
        (
            {
                "events": {"liveliness_lost": 1},
                "recent": (EventInfo(kind="liveliness_lost", count=1, text="no link for 2 s", ago=1.0),),
            },
            DiagnosticLevel.ERROR,
            "no link for 2 s",
        ),
    ],
)
def test_levels_of_a_topic(changes: dict[str, object], expected: DiagnosticLevel, text: str) -> None:
    assert level(with_routes(msgspec.structs.replace(HEALTHY, **changes))) == (expected, text)


def test_a_subscriber_that_was_refused_is_an_error() -> None:
    assert level(with_routes(HEALTHY, mismatches=("another md5",))) == (DiagnosticLevel.ERROR, "another md5")


def test_a_node_that_cannot_be_reached_is_a_warning() -> None:
    info = UnreachableInfo(node="/odd", uri="http://nosuch:1/", problem="no such name", ago=20.0, withdrawn=True)
    status = judged(Health(), msgspec.structs.replace(SNAPSHOT, unreachable=(info,)))["rmpa: node /odd"]
    assert (status.level, status.message) == (DiagnosticLevel.WARN, str(info))
    assert status.values == {"unreachable for (s)": "20"}


def test_a_refused_outgoing_topic_is_an_error() -> None:
    outgoing = msgspec.structs.replace(HEALTHY, direction="out")
    for routes in ((), (outgoing,)):
        snapshot = with_routes(*routes, mismatches=("pc/viewer wants another md5",))
        assert level(snapshot, "rmpa: /cmd") == (DiagnosticLevel.ERROR, "pc/viewer wants another md5")
    assert "rmpa: /cmd" not in judged(Health(), with_routes(HEALTHY, mismatches=("another md5",)))


def test_new_losses_are_a_warning_once() -> None:
    health = Health()
    assert (
        judged(health, with_routes(HEALTHY))[CMD].level is DiagnosticLevel.OK
    )  # the three lost ones were before our time
    more = msgspec.structs.replace(HEALTHY, lost=5, expired=5, events={"deadline_missed": 1})
    status = judged(health, with_routes(more))[CMD]
    assert (status.level, status.message) == (
        DiagnosticLevel.WARN,
        "2 lost, 1 beyond their lifespan, 1 deadlines missed",
    )
    assert judged(health, with_routes(more))[CMD].level is DiagnosticLevel.OK
    again = msgspec.structs.replace(HEALTHY, lost=0)  # the route was opened anew
    assert judged(health, with_routes(again))[CMD].level is DiagnosticLevel.OK


def test_oversized_messages_warn_at_both_ends() -> None:
    to_it = msgspec.structs.replace(HEALTHY, direction="out", oversized=0)
    name = "rmpa: to joystick: /cmd (/joy_node)"
    health = Health()
    before = msgspec.structs.replace(to_it, lost=0)
    assert name not in judged(health, with_routes(before, msgspec.structs.replace(HEALTHY, oversized=0)))
    for count in (1, 3):
        found = judged(health, with_routes(*(msgspec.structs.replace(r, oversized=count) for r in (before, HEALTHY))))
        for status in (found[name], found[CMD]):
            assert status.level is DiagnosticLevel.WARN
            assert f"{max(1, count - 1)} left out, too long to cross" in status.message
            assert status.values["too long, last (B)"] == "270000000"
    again = judged(health, with_routes(*(msgspec.structs.replace(r, oversized=3) for r in (before, HEALTHY))))
    assert (again[name].level, again[CMD].level) == (DiagnosticLevel.OK, DiagnosticLevel.OK)


def test_a_reliable_route_to_an_absent_peer() -> None:
    away = msgspec.structs.replace(
        HEALTHY, direction="out", state="away", problem="joystick is away for 12 s", lost=0, oversized=0, kept=7
    )
    name = "rmpa: to joystick: /cmd (/joy_node)"
    health = Health()
    status = judged(health, with_routes(away))[name]
    assert (status.level, status.message) == (DiagnosticLevel.OK, "joystick is away for 12 s")
    assert status.values["waiting"] == "7"
    lost = msgspec.structs.replace(away, lost=7046, kept=0)
    status = judged(health, with_routes(lost))[name]
    assert (status.level, status.message) == (DiagnosticLevel.WARN, "joystick is away for 12 s; 7046 lost")
    status = judged(health, with_routes(lost))[name]
    assert (status.level, status.message) == (
        DiagnosticLevel.WARN,
        "joystick is away for 12 s; 7046 messages lost to it until now",
    )
    back = msgspec.structs.replace(lost, state="open", problem="")
    status = judged(health, with_routes(back))[name]
    assert (status.level, status.message) == (DiagnosticLevel.OK, "7046 messages lost to it until now")


def test_an_unknown_loss_is_a_warning() -> None:
    health = Health()
    judged(health, with_routes(HEALTHY))
    status = judged(health, with_routes(msgspec.structs.replace(HEALTHY, events={"loss_unknown": 1})))[CMD]
    assert (status.level, status.message) == (DiagnosticLevel.WARN, "1 times an unknown number lost")


def test_sources_of_one_topic_have_unique_names() -> None:
    other = msgspec.structs.replace(HEALTHY, node="/other")
    found = judged(Health(), with_routes(HEALTHY, other, HEALTHY))
    assert [name for name in found if "/cmd" in name] == [
        f"{CMD} (/joy_node)",
        f"{CMD} (/other)",
        f"{CMD} (/joy_node) #2",
    ]


@pytest.mark.parametrize(
    ("change", "expected", "text"),
    [
        ({}, DiagnosticLevel.OK, "linked, round trip 0.43 ms"),
        ({"state": "linking", "link": None}, DiagnosticLevel.WARN, "linking"),
        (
            {"state": "relayed", "link": None, "via": "gate"},
            DiagnosticLevel.OK,
            "relayed: gate passes on what it publishes",
        ),
        ({"state": "refused", "link": None, "last_error": "another domain"}, DiagnosticLevel.ERROR, "another domain"),
        ({"state": "conflict", "link": None, "conflicts": ("one GUID",)}, DiagnosticLevel.ERROR, "one GUID"),
    ],
)
def test_levels_of_a_peer(change: dict[str, object], expected: DiagnosticLevel, text: str) -> None:
    peer = msgspec.structs.replace(JOYSTICK, **change)
    assert level(with_routes(peers=(peer,)), "rmpa: joystick") == (expected, text)


def test_a_link_that_drops_is_a_warning() -> None:
    health = Health()
    judged(health, with_routes(peers=(JOYSTICK,)))
    assert JOYSTICK.link is not None
    slow = msgspec.structs.replace(JOYSTICK, link=msgspec.structs.replace(JOYSTICK.link, dropped=7))
    status = judged(health, with_routes(peers=(slow,)))["rmpa: joystick"]
    assert (status.level, status.message) == (
        DiagnosticLevel.WARN,
        "5 messages dropped: the link takes them too slowly",
    )


def test_a_lost_peer_and_its_topics_are_stale_for_a_while() -> None:
    health = Health()
    judged(health, with_routes(HEALTHY, peers=(JOYSTICK,)), 0.0)
    lost = msgspec.structs.replace(JOYSTICK, state="linking", link=None, last_error="silent")
    found = judged(health, with_routes(peers=(lost,)), 1.0)
    assert (found["rmpa: joystick"].level, found["rmpa: joystick"].message) == (
        DiagnosticLevel.STALE,
        "linking: silent",
    )
    assert (found[CMD].level, found[CMD].message) == (DiagnosticLevel.STALE, "no link to joystick")
    waiting = msgspec.structs.replace(HEALTHY, state="waiting", problem="its peer is away")
    assert judged(health, with_routes(waiting, peers=(lost,)), 1.0)[CMD] == found[CMD]
    gone = with_routes(peers=())
    found = judged(health, gone, 2.0)
    assert [found[name].level for name in ("rmpa: joystick", CMD)] == [DiagnosticLevel.STALE] * 2
    assert found["rmpa: joystick"].values == {"linked before (s)": "2"}
    assert list(judged(health, gone, limits.DIAGNOSTICS_STALE + 1)) == [HERE]
    back = judged(health, with_routes(HEALTHY, peers=(JOYSTICK,)), 100.0)
    assert [back[name].level for name in ("rmpa: joystick", CMD)] == [DiagnosticLevel.OK] * 2


def test_a_topic_whose_publisher_ended_is_forgotten_at_once() -> None:
    health = Health()
    judged(health, with_routes(HEALTHY))
    assert CMD not in judged(health, with_routes())


def test_the_old_entry_of_a_restarted_peer_is_left_out() -> None:
    ghost = msgspec.structs.replace(JOYSTICK, guid="10.0.0.2:40002#0", state="linking", link=None)
    twin = msgspec.structs.replace(JOYSTICK, guid="10.0.0.9:40002#1")
    found = judged(Health(), with_routes(peers=(ghost, JOYSTICK, twin)))
    assert {name: found[name].level for name in found if "joystick" in name} == {
        "rmpa: joystick": DiagnosticLevel.OK,
        "rmpa: joystick (10.0.0.9:40002#1)": DiagnosticLevel.OK,
    }


def test_failed_calls_are_a_warning_once() -> None:
    idle = ServiceInfo(name="/add", node="/adder", direction="in", peer="joystick")
    used = msgspec.structs.replace(idle, calls=3, type="a/Add", state="open")
    failed = msgspec.structs.replace(used, calls=5, failed=1, problem="it sticks")
    ours = ServiceInfo(name="/add", node="/mine", direction="out", calls=1)

    def with_services(*services: ServiceInfo) -> Snapshot:
        return msgspec.structs.replace(SNAPSHOT, topics=(), services=services)

    health, name = Health(), "rmpa: joystick: service /add"
    assert name not in judged(health, with_services(idle))
    first = judged(health, with_services(ours, used))
    assert (first[name].level, first[name].values["calls"]) == (DiagnosticLevel.OK, "3")
    assert first["rmpa: service /add"].level is DiagnosticLevel.OK
    worse = judged(health, with_services(failed))[name]
    assert (worse.level, worse.message) == (DiagnosticLevel.WARN, "1 of 2 calls failed: it sticks")
    after = judged(health, with_services(failed))[name]
    assert (after.level, after.message, after.values["failed"]) == (DiagnosticLevel.OK, "0 calls", "1")


def test_a_direct_topic_tells_where_its_subscriber_is_connected() -> None:
    status = judged(Health(), with_routes(DIRECT))[CMD]
    text = "direct to 10.0.0.2:41234 for /viewer"
    assert (status.level, status.message) == (DiagnosticLevel.OK, text)
    shown = {key: value for key, value in status.values.items() if key.startswith("direct /viewer ")}
    assert shown == {
        "direct /viewer to": "10.0.0.2:41234",
        "direct /viewer since (s)": "180",
        "direct /viewer interruptions": "2",
    }
    assert status.values["transport"] == "direct"


def test_direct_and_relayed_subscribers_share_a_status() -> None:
    both = msgspec.structs.replace(HEALTHY, transport="both", subscribers=(VIEWER,))
    assert level(with_routes(both)) == (
        DiagnosticLevel.OK,
        "10.0 Hz, 0.41 ms; direct to 10.0.0.2:41234 for /viewer",
    )


@pytest.mark.parametrize(
    ("changes", "expected", "text"),
    [
        ({"wanted": "auto"}, DiagnosticLevel.OK, "10.0 Hz, 0.41 ms"),
        ({"wanted": "direct"}, DiagnosticLevel.WARN, "relayed for /viewer: no way"),
        ({"wanted": "direct", "condition": "transport"}, DiagnosticLevel.OK, "10.0 Hz, 0.41 ms"),
        ({"wanted": "direct", "condition": "measures"}, DiagnosticLevel.OK, "10.0 Hz, 0.41 ms"),
        (
            {"wanted": "auto", "transport": "direct", "endpoint": "10.0.0.2:41234"},
            DiagnosticLevel.WARN,
            "direct to 10.0.0.2:41234 for /viewer, has to be relayed: no way",
        ),
    ],
)
def test_a_direct_contract_that_falls_back_is_a_warning(
    changes: dict[str, object], expected: DiagnosticLevel, text: str
) -> None:
    relayed = {"transport": "relay", "state": "relayed", "endpoint": "", "condition": "reachable", "text": "no way"}
    one = msgspec.structs.replace(VIEWER, **(relayed | changes))
    route = msgspec.structs.replace(HEALTHY, transport="relay", subscribers=(one,))
    found, said = level(with_routes(route))
    assert found is expected
    assert said.startswith(text)
