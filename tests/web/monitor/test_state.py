"""The state of the pages, made of recorded snapshots of the demo; the figures and words of its document."""

from __future__ import annotations

import asyncio
import json
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.facts import RouteInfo, TopicInfo, UnreachableInfo
from rmpa.core.limits import KIB
from rmpa.observe.snapshot import PeerInfo, Snapshot
from rmpa.trust.permissions import TrustStatus
from rmpa.web.monitor import limits, messages, questions, session
from rmpa.web.monitor.messages import Tree, difference
from rmpa.web.monitor.monitor import RatesFeed
from rmpa.web.monitor.resources import ResourceFacts
from rmpa.web.monitor.state import StateBuilder, details, module_state
from tests.web.monitor.fake_server import resources, snapshots
from tests.web.monitor.patches import apply
from tests.web.snapshots import AGENT, FULL, LINK, peer, route

RECORDED = snapshots()
RESOURCES = resources()


replace = msgspec.structs.replace


def build(snapshot: Snapshot, **more: Any) -> Any:
    return StateBuilder(snapshot.agent.name).build(snapshot, **more)


def has_null(value: object) -> bool:
    if isinstance(value, dict):
        return any(each is None or has_null(each) for each in value.values())
    return False


@pytest.mark.parametrize("snapshot", [FULL, *RECORDED])
def test_a_state_is_json_without_unknown_members(snapshot: Snapshot) -> None:
    state = build(snapshot, resources=RESOURCES)
    assert not has_null(state)
    assert json.loads(json.dumps(state)) == state


def test_the_state_says_who_is_there_and_what_flows() -> None:
    state = build(RECORDED[0], resources=RESOURCES)
    states = {name: one["state"] for name, one in state["modules"].items()}
    assert states == {"pc": "here", "base": "up", "joystick": "up", "velocity": "up"}
    assert (state["topics"]["/odom"]["from"], state["topics"]["/odom"]["to"]) == (["base"], ["pc"])
    for flow, topic, rate in (("base>pc", "/odom", 50), ("joystick>velocity", "/command_information", 10)):
        assert state["flows"][flow]["topics"] == [topic]
        assert state["flows"][flow]["rate"] == pytest.approx(rate, rel=0.05)
    assert state["flows"]["velocity>base"]["by"] == "resource"  # what flows between others is known from these alone


def test_a_killed_module_shows_in_the_next_state_and_comes_back() -> None:
    builder = StateBuilder("pc")
    states: list[Any] = [builder.build(snapshot) for snapshot in RECORDED]
    assert [state["modules"]["base"]["state"] for state in states] == ["up", "up", "lost", "lost", "up", "up"]
    assert "refused" in states[2]["modules"]["base"]["error"]
    assert "base>pc" not in states[2]["flows"]
    assert states[2]["modules"]["base"]["since"] == states[3]["modules"]["base"]["since"]
    lost = states[3]["modules"]["base"]["lost"]
    assert lost["topics"]["/odom"] == pytest.approx(50, rel=0.05)
    assert "lost" not in states[4]["modules"]["base"]


def test_a_lost_link_stays_until_it_is_back_and_says_what_waits_and_is_dropped() -> None:
    builder = StateBuilder(FULL.agent.name)
    builder.build(FULL)
    away = replace(route(direction="out"), state="away", kept=7, lost=2, dropped=1)
    waits = TopicInfo(name="/image", type="sensor_msgs/Image", routes=(away,))
    cut = replace(FULL, peers=(peer(state="linking", link=None),), topics=(waits,))
    builder.build(cut)
    later: Any = builder.build(replace(cut, taken=FULL.taken + limits.FORGET_AFTER + 9, peers=()))
    arm = later["modules"]["arm"]
    assert (arm["state"], arm["lost"]["kept"], arm["lost"]["dropped"]) == ("lost", 7, 3)
    back: Any = builder.build(FULL)
    assert back["modules"]["arm"]["state"] == "up"


def test_what_a_lost_module_said_last_is_no_news() -> None:
    one = next(one for one in RESOURCES if one.peer == "base")
    alarm: Tree = {"id": one.key, "module": "base", "resource": one.key, "level": "ERROR", "text": "hot", "at": 1.0}
    well, lost, back = (
        build(snapshot, resources=[one], alarms=[alarm]) for snapshot in (RECORDED[0], RECORDED[3], RECORDED[4])
    )
    for state, level, word, alarms in ((well, "OK", "active", [one.key]), (lost, "STALE", "not known", [])):
        shown = state["resources"][one.key]
        assert (shown["level"], shown["state"], list(state["alarms"])) == (level, word, alarms)
    assert back["resources"] == well["resources"]


def test_a_module_that_left_the_roster_is_away_since_nothing_came_of_it() -> None:
    builder = StateBuilder(FULL.agent.name)
    builder.build(FULL)
    left: Any = builder.build(replace(FULL, taken=FULL.taken + 60, peers=()))
    error = "has left the roster: no beacon and no link"
    assert left["modules"]["arm"] == {"state": "away", "since": FULL.taken, "error": error}
    assert left["modules"]["hand"]["since"] == FULL.taken - 1  # it had no link before


def test_a_module_that_left_long_ago_is_forgotten_and_so_are_the_oldest_of_too_many() -> None:
    builder = StateBuilder(FULL.agent.name)
    builder.build(FULL)
    later = replace(FULL, taken=FULL.taken + limits.FORGET_AFTER + 1, peers=())
    assert list(builder.build(later)["modules"]) == [FULL.agent.name]  # type: ignore[arg-type]
    last: Any = None
    for start in range(2):
        peers = tuple(peer(f"m{start}{number:03}") for number in range(limits.MODULES_SHOWN))
        last = builder.build(replace(later, taken=later.taken + start, peers=peers))
    assert len(last["modules"]) == limits.MODULES_SHOWN + 1
    assert not [name for name in last["modules"] if name.startswith("m0")]


def test_modules_that_are_not_of_this_mesh_stand_apart_and_can_be_invited_at_the_authority() -> None:
    invite = "rmpa trust invite --module arm2"
    arm2 = peer("arm2", state="pending", link=None, last_error="pending: no keys; invite it", invite=invite)
    impostor = peer("arm", state="foreign", link=None, last_error="not of this mesh")
    for trust in (TrustStatus(on=True, module="base", is_authority=True), TrustStatus(on=True, module="base")):
        state = build(replace(FULL, strangers=(arm2, impostor), trust=trust))
        assert state["outside"]["g arm2"] == {
            "name": "arm2", "state": "pending", "address": "g", "since": FULL.taken - 1,
            "text": "pending: no keys; invite it", "invite": invite, **({"here": True} if trust.is_authority else {}),
        }  # fmt: skip
        assert state["outside"]["g arm"]["state"] == "foreign"
        assert state["modules"]["arm"]["state"] == "up", "another one says that this is its name"
        assert not any("arm2" in note for note in state["notes"])


def test_to_a_module_without_keys_a_secured_mesh_that_it_met_is_not_away() -> None:
    arm, hand = (peer(name, state="pending", link=None, invite="x") for name in ("arm", "hand"))
    for trust, away in ((None, ["hand"]), (TrustStatus(on=True, module="base"), ["arm", "hand"])):
        builder = StateBuilder(FULL.agent.name)
        builder.build(replace(FULL, peers=(arm, hand)))
        after: Any = builder.build(replace(FULL, peers=(), strangers=(arm,), trust=trust))
        assert [name for name, one in after["modules"].items() if one["state"] == "away"] == away


def test_a_module_is_silent_since_it_was_heard_last_and_a_fresh_agent_has_lost_nothing() -> None:
    mute = peer("arm", link=replace(LINK, heard_ago=4.0, up_ago=3600.0))
    arm = build(replace(FULL, peers=(mute,)))["modules"]["arm"]
    assert (arm["state"], arm["since"]) == ("silent", FULL.taken - 4)
    builder = StateBuilder(FULL.agent.name)
    builder.build(FULL)
    fresh = replace(FULL.agent, uptime=2.0, started=FULL.taken + 8)
    started: Any = builder.build(replace(FULL, agent=fresh, taken=FULL.taken + 10, peers=()))
    assert {started["modules"][name]["state"] for name in ("arm", "hand")} == {"linking"}
    assert "just started" in started["modules"]["arm"]["error"]


def test_byte_rates_come_from_the_counters_of_one_link() -> None:
    builder = StateBuilder("pc")
    states: list[Any] = [builder.build(RECORDED[number]) for number in (0, 1, 4)]
    assert states[1]["modules"]["base"]["bytes_in"] == pytest.approx(37_000, rel=0.2)
    assert "bytes_in" not in states[2]["modules"]["base"]  # a link that is new has none yet


def test_noise_changes_nothing() -> None:
    builder = StateBuilder("pc")
    before = builder.build(RECORDED[1], RESOURCES)

    def noise(route: RouteInfo) -> RouteInfo:
        return replace(route, rate=route.rate and route.rate * 1.01, messages=route.messages + 9)

    topics = (replace(topic, routes=tuple(map(noise, topic.routes))) for topic in RECORDED[1].topics)
    noisy = replace(RECORDED[1], topics=tuple(topics))
    assert difference(before, builder.build(noisy, RESOURCES)) == {}


@pytest.mark.parametrize(
    ("rate", "age", "stopped"),
    [(50.0, 1.9, None), (50.0, 12.0, -12.0), (0.5, 9.0, None), (0.5, 11.0, -11.0)],
)
def test_what_stopped_is_old_after_some_of_its_own_periods(rate: float, age: float, stopped: float | None) -> None:
    (flowing, *_) = (each for each in snapshots()[0].topics if each.name == "/odom")
    routes = tuple(
        replace(each, rate=rate, age=age, period=None) for each in flowing.routes if each.direction == "in"
    )
    snapshot = replace(FULL, topics=(replace(flowing, routes=routes),))
    state = build(snapshot)
    moment = None if stopped is None else snapshot.taken + stopped
    assert state["topics"]["/odom"].get("stopped") == moment
    assert bool(state["flows"]) == (moment is None)
    detail: Any = details(snapshot, {}, "topic", "/odom")
    assert {route.get("stopped") for route in detail["routes"].values()} == {moment}


def test_one_latched_message_has_not_stopped() -> None:
    (topic, *_) = (each for each in snapshots()[0].topics if each.name == "/odom")
    routes = tuple(replace(each, rate=None, age=60.0, period=None) for each in topic.routes)
    detail: Any = details(replace(FULL, topics=(replace(topic, routes=routes),)), {}, "topic", "/odom")
    assert {route.get("stopped") for route in detail["routes"].values()} == {None}


async def test_rates_are_asked_while_a_page_looks_and_joined_with_the_topics_here() -> None:
    now, asked = [100.0], []
    told: dict[str, Any] = {
        "base": [["/quiet", 2.0, 16.0, "counted"]],
        "arm": [["/image", 30.0, 900.0, "sampled"], ["/other", 1.0, 1.0, "counted"]],
        "old": "there is no question 'topic.rates'",
    }

    async def ask() -> Any:
        asked.append(now[0])
        return told

    async def idle() -> None:
        for _ in range(4):
            await asyncio.sleep(0)

    feed = RatesFeed(ask, lambda: now[0])
    here = TopicInfo(name="/quiet", publishers=("/node",))
    away = TopicInfo(name="/far", routes=(RouteInfo(peer="old", node="/n", direction="in", state="idle"),))
    snapshot = replace(FULL, topics=(FULL.topics[0], here, away))
    assert feed.look(snapshot) == {}
    await idle()
    found: Any = feed.look(snapshot)
    assert found["/quiet"] == {"rate": 2.0, "bandwidth": 16.0, "how": "counted"}
    assert found["/image"] == {"rate": 30.0, "bandwidth": 900.0, "how": "sampled"}
    assert found["/far"] == {"how": told["old"]}
    told["base"] = [["/quiet", 2.01, 16.0, "counted"]]
    now[0] += limits.RATES_PERIOD
    feed.look(snapshot)
    await idle()
    assert (feed.look(snapshot)["/quiet"] is found["/quiet"], len(asked)) == (True, 2)
    await feed.close()


def test_patches_of_the_recorded_demo_are_small() -> None:
    builder = StateBuilder("pc")
    shown: Any = {}
    sizes = []
    for snapshot in RECORDED:
        state = builder.build(snapshot, RESOURCES)
        patch = difference(shown, state)
        shown = apply(shown, patch)
        assert shown == state
        sizes.append(len(json.dumps(patch)))
    assert sizes[0] < 20_000
    assert max(sizes[1], sizes[5]) < 1_500


@pytest.mark.parametrize(
    ("given", "word"),
    [
        (peer(), "up"),
        (peer(link=replace(LINK, heard_ago=1.5)), "silent"),
        (peer(link=replace(LINK, heard_ago=6.5, rests=True, lease=16.0)), "up"),
        (peer(link=replace(LINK, heard_ago=8.5, rests=True, lease=16.0)), "silent"),
        (peer(link=replace(LINK, heard_ago=20.0, rests=True, lease=58.0)), "up"),
        (peer(state="linking", link=None, beacon_ago=0.5), "linking"),
        (peer(state="linking", link=None, beacon_ago=8.0), "away"),
        (peer(state="linking", link=None), "away"),
        (peer(state="refused", link=None), "refused"),
        (peer(state="conflict", link=None), "refused"),
        (peer(state="relayed", link=None, via="gate"), "relayed"),
    ],
)
def test_each_peer_has_a_word(given: PeerInfo, word: str) -> None:
    assert module_state(given) == word


def test_a_state_of_a_huge_mesh_is_bounded_and_says_what_is_left_out() -> None:
    topic = RECORDED[0].topics[0]
    many = tuple(replace(topic, name=f"/t{number}") for number in range(limits.TOPICS_SHOWN + 5))
    peers = tuple(peer(f"m{number:04d}") for number in range(limits.MODULES_SHOWN + 3))
    state = build(replace(RECORDED[0], topics=many, peers=peers))
    assert len(state["topics"]) == limits.TOPICS_SHOWN
    assert len(state["modules"]) <= limits.MODULES_SHOWN + 1
    assert state["hidden"] == {"topics": 5, "modules": 3}


def test_without_an_agent_the_last_state_stays_and_says_so() -> None:
    builder = StateBuilder("pc")
    assert builder.unreachable(5.0, "no agent", "")["agent"] == {"name": "pc"}  # from the start
    known = builder.build(RECORDED[0])
    gone: Any = builder.unreachable(5.0, "no agent", "start one")
    assert gone["reach"] == {"ok": False, "since": 5.0, "error": "no agent", "remedy": "start one"}
    assert gone["modules"] is known["modules"]
    assert builder.build(RECORDED[0])["reach"] == {"ok": True}


FACTS = {one.key: one for one in RESOURCES}


@pytest.mark.parametrize(
    ("kind", "name", "has"),
    [
        ("module", "base", "instance"),
        ("module", "pc", "core_uri"),
        ("topic", "/odom", "policy"),
        ("service", "base:/base/set_parameters", "relayed_because"),
        ("resource", "velocity:/velocity", "descriptor"),
        ("counters", "", "xmlrpc.calls"),
    ],
)
def test_details_have_all_of_one_thing(kind: str, name: str, has: str) -> None:
    found: Tree | None = details(RECORDED[0], FACTS, kind, name)
    assert found is not None
    assert has in found
    assert not has_null(found)


def test_routes_of_a_topic_have_keys_and_what_is_not_there_has_no_details() -> None:
    found: Any = details(RECORDED[0], {}, "topic", "/odom")
    assert list(found["routes"]) == ["in base /base"]  # so that a patch is small
    for kind in ("module", "topic", "service", "resource", "node", "else"):
        assert details(RECORDED[0], FACTS, kind, "/nothing") is None


def test_a_strange_descriptor_of_a_peer_breaks_nothing() -> None:
    declared = {"outputs": [3], "profiles": ["p"]}
    strange = ResourceFacts(name="/x", peer="y", health={"values": {"rate": "much"}}, descriptor=declared)
    assert build(RECORDED[0], resources=[strange])["resources"]["y:/x"]["module"] == "y"


_PEERS = st.sampled_from(("arm", "base", "gate"))
_ROUTES = st.builds(
    lambda peer, direction, state, rate, lost, problem: RouteInfo(
        peer=peer, node="/n", direction=direction, state=state, rate=rate, bandwidth=rate, lost=lost, problem=problem
    ),
    _PEERS,
    st.sampled_from(("in", "out")),
    st.sampled_from(("open", "idle")),
    st.sampled_from((None, 0.0, 10.0, 10.1, 20.0)),
    st.integers(0, 1),
    st.sampled_from(("", "broken")),
)
_TOPIC = st.builds(
    lambda name, type_, publishers, crosses, routes: TopicInfo(
        name=name, type=type_, publishers=publishers, crosses=crosses, routes=tuple(routes)
    ),
    st.sampled_from(("/a", "/b", "/c")),
    st.sampled_from(("", "std_msgs/String")),
    st.sampled_from(((), ("/talker",))),
    st.booleans(),
    st.lists(_ROUTES, max_size=3),
)
_FIGURES = ("rate", "bandwidth", "latency")


@given(st.lists(st.lists(_TOPIC, max_size=3, unique_by=lambda topic: topic.name), max_size=6))
def test_a_state_made_of_the_last_one_says_what_one_made_anew_says(history: list[list[TopicInfo]]) -> None:
    builder = StateBuilder("pc")
    for number, topics in enumerate(history):
        snapshot = Snapshot(agent=AGENT, taken=1000.0 + number, topics=tuple(topics))
        state: Any = builder.build(snapshot)
        fresh: Any = StateBuilder("pc").build(snapshot)
        assert (state.keys(), state["nodes"]) == (fresh.keys(), fresh["nodes"])
        for part in ("topics", "flows"):
            assert state[part].keys() == fresh[part].keys()
        for name, entry in fresh["topics"].items():
            shown = state["topics"][name]
            assert shown.keys() == entry.keys()
            for member, value in entry.items():
                # Figures may be kept for a change that cannot be seen: up to 10 % of the bandwidth.
                assert shown[member] == (pytest.approx(value, rel=0.12) if member in _FIGURES else value)
        for key, flow in fresh["flows"].items():
            assert state["flows"][key]["topics"] == flow["topics"]
            assert state["flows"][key]["rate"] == pytest.approx(flow["rate"], rel=0.05)


def test_nodes_of_all_modules_are_listed_and_each_has_its_topics_and_services() -> None:
    nodes = build(RECORDED[0], resources=RESOURCES)["nodes"]

    def details_of(name: str) -> Any:
        return details(RECORDED[0], {}, "node", name)

    assert nodes["base:/base"]["module"] == "base"
    assert "/odom" in details_of("base:/base")["publishes"]
    own = next(name for name, one in nodes.items() if "module" not in one and one.get("subscribes"))
    assert nodes[own]["subscribes"] == len(details_of(own)["subscribes"])
    served = next(name for name, one in nodes.items() if one.get("serves") and one.get("module") == "base")
    assert all(each.startswith("base:/") for each in details_of(served)["services"])


def test_a_node_that_cannot_be_reached_says_so() -> None:
    gone = UnreachableInfo(node="/talker", uri="http://robot:1/", problem="no route", ago=3.0)
    topic = TopicInfo(name="/chatter", publishers=("/talker",))
    snapshot = replace(FULL, topics=(topic,), services=(), unreachable=(gone,))
    assert build(snapshot)["nodes"]["/talker"]["problem"] == "no route"
    assert "no route" in str((details(snapshot, {}, "node", "/talker") or {})["problem"])


def test_nodes_beyond_the_limit_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "NODES_SHOWN", 2)
    state = build(RECORDED[0])
    assert len(state["nodes"]) == 2
    assert state["hidden"]["nodes"] > 0


PAGE = (Path(__file__).parents[3] / "docs" / "design" / "monitor-protocol.md").read_text(encoding="utf-8")


def test_the_page_says_the_bounds_of_the_code() -> None:
    rows = re.findall(r"\| ([\d,.]+)( KiB| s)? \| `([A-Z_]+)` \|", PAGE)
    assert len(rows) > 10
    for figure, unit, name in rows:
        assert getattr(limits, name) == float(figure.replace(",", "")) * (KIB if unit == " KiB" else 1), name


def test_the_page_has_each_question_and_message() -> None:
    for word in (*questions.QUESTIONS, *session.RIGHTS, *session.OPS, messages.SUBPROTOCOL):
        assert f"`{word}`" in PAGE
