"""Actions of both ROS, and answers about ROS 2."""

from __future__ import annotations

import asyncio
import struct
from typing import Any

import pytest

from rmpa.core.errors import UnreachableError
from rmpa.gateway.ros2.format import EntityKind, Ros2Attachment, data_key
from rmpa.gateway.ros2.pairs import ActionPair
from rmpa.gateway.ros2.types import Ros2Types, TypePair
from rmpa.observe.sites import REPORT, SITE_INFO, SITE_WHY, SiteInfo, SitesReport
from rmpa.ros.types.definitions import SEPARATOR, known_text
from rmpa.ros.types.messages import MessageType
from tests.gateway.memory_zenoh import MemoryQuery, eventually
from tests.gateway.ros2.io.ros2_bed import NO_TYPE, STRING, Ros2Bed, cdr

TEST = [MessageType(f"actionlib/Test{part}") for part in ("Goal", "Result", "Feedback")]
TYPES = ActionPair(TEST, TypePair("actionlib/action/Test"), Ros2Types("jazzy")).types
ACTION = {part: MessageType(f"actionlib/TestAction{part.title()}") for part in ("goal", "feedback", "result")}
ACTION["status"] = MessageType("actionlib_msgs/GoalStatusArray")
UUID = bytes(range(16))
ATTACHMENT = Ros2Attachment(3, 1, bytes(16)).serialize()


def blocks(*names: str) -> str:
    """The blocks of embedded types in a definition."""
    return "".join(f"{SEPARATOR}\nMSG: {name}\n{known_text(name)}\n" for name in names)


def request(bed: Ros2Bed, service: str, payload: bytes) -> asyncio.Future[Any]:
    """A request of a client of ROS 2."""
    key = data_key(0, f"/count/_action/{service}", *TYPES[service])
    return asyncio.ensure_future(bed.ros2.get(key, b"\0\1\0\0" + payload, ATTACHMENT, timeout=20))


async def test_a_server_of_ros1_that_goes_aborts_the_goal_of_ros2(bed: Ros2Bed) -> None:
    parts = ("status", "feedback", "result")
    server = {part: bed.graph.publisher(f"/count/{part}", ACTION[part], "/counter") for part in parts}

    def shown() -> int:
        kinds = (EntityKind.SERVICE, EntityKind.PUBLISHER)
        return sum(each.node.name == "/rmpa/arm/counter" for kind in kinds for each in bed.own(kind))

    await eventually(lambda: shown() == 5)
    for part in ("goal", "cancel"):
        bed.graph.topics[f"/count/{part}", "/action_clients"].on_demand(True)
    sending = request(bed, "send_goal", UUID + b"\7\0\0\0")
    goal = bed.graph.topics["/count/goal", "/action_clients"]
    await eventually(lambda: goal.messages)
    name = ACTION["goal"].deserialize(goal.messages[0]).goal_id.id
    status = ACTION["status"].make({"status_list": [{"goal_id": {"id": name}, "status": 1}]})
    bed.graph.send(server["status"], ACTION["status"].serialize(status))
    await sending
    waiting = request(bed, "get_result", UUID)
    for _ in range(5):
        await asyncio.sleep(0)  # the query is delivered
    for source in server.values():
        bed.graph.remove(source)
    (reply,) = await waiting
    assert (reply.ok, reply.payload[4]) == (True, 6)
    assert not shown()


DOCK = [
    MessageType.learn(
        "dock_msgs/DockGoal", "geometry_msgs/Point place\nuint16 tries\n" + blocks("geometry_msgs/Point")
    ),
    MessageType.learn("dock_msgs/DockResult", "string where\n"),
    MessageType.learn("dock_msgs/DockFeedback", "float32 left\n"),
]
DOCK_GOAL = MessageType.learn(
    "dock_msgs/DockActionGoal",
    "Header header\nactionlib_msgs/GoalID goal_id\ndock_msgs/DockGoal goal\n"
    + blocks("std_msgs/Header", "actionlib_msgs/GoalID")
    + f"{SEPARATOR}\nMSG: dock_msgs/DockGoal\n{DOCK[0].definition}",
)


async def test_an_action_of_a_type_that_ros1_lacks_is_learnt_from_its_server(bed: Ros2Bed) -> None:
    theirs, action = Ros2Types("jazzy"), "dock_msgs/action/Dock"
    types = ActionPair(DOCK, TypePair(action), theirs).types
    goals: list[MemoryQuery] = []
    results: list[MemoryQuery] = []
    for service, asked in (("send_goal", goals), ("get_result", results)):
        name, type_hash = types[service]
        bed.server(f"/dock/_action/{service}", name, asked.append, node="/docker", type_hash=type_hash)
    name, type_hash = types["feedback"]
    told = bed.publisher("/dock/_action/feedback", node="/docker", type_name=name, type_hash=type_hash)
    bed.describes("/docker", theirs, *(types[part][0] for part in ("send_goal", "get_result", "feedback")))
    await eventually(lambda: len(bed.graph.topics) == 3)
    status, feedback, result = (bed.graph.topics[f"/dock/{p}", "/docker"] for p in ("status", "feedback", "result"))
    assert result.description is not None
    assert result.description.type == "dock_msgs/DockActionResult"
    own = MessageType.learn(result.description.type, result.description.definition, result.description.md5sum)
    status.on_demand(True)
    client = bed.graph.publisher("/dock/goal", DOCK_GOAL, "/client")
    await eventually(lambda: bed.graph.taps and told.wanted)
    goal = DOCK_GOAL.make({"goal_id": {"id": "g1"}, "goal": {"place": {"x": 2.0}, "tries": 9}})
    bed.graph.send(client, DOCK_GOAL.serialize(goal))
    await eventually(lambda: goals)
    sent: Any = theirs.store.deserialize_cdr(goals[0].payload, f"{types['send_goal'][0]}_Request")
    assert (sent.goal.place.x, sent.goal.tries) == (2.0, 9)
    goals[0].answer(b"\0\1\0\0\1" + bytes(11))
    await eventually(lambda: results)
    told.put(b"\0\1\0\0" + goals[0].payload[4:20] + struct.pack("<f", 0.5))
    await eventually(lambda: feedback.messages)
    home = theirs.store.types[f"{action}_Result"]("home")
    results[0].answer(cdr(theirs, f"{types['get_result'][0]}_Response", 4, home))
    await eventually(lambda: result.messages)
    got = own.deserialize(result.messages[0])
    assert (got.status.status, got.result.where) == (3, "home")
    await bed.ros2.close()
    await eventually(lambda: not bed.graph.topics)


class OtherSites:
    """Answers for another site."""

    async def answer(self, what: str, _args: dict[str, Any], _asker: str = "", /) -> Any:
        sites = (SiteInfo(name="hall", state="this site"),)
        return SitesReport(gateway="gate", site="hall", sites=sites) if what == REPORT else ["of a site"]


async def test_ros2_is_listed_with_its_topics_and_what_is_wrong_with_them(bed: Ros2Bed) -> None:
    bed.graph.publisher("/mine", STRING)
    bed.publisher("/chatter")
    bed.subscribe("/mine", node="/older", type_hash=NO_TYPE)
    await eventually(lambda: bed.problems and bed.topic("/chatter"))
    answer = bed.neighbour.answer
    report: SitesReport = await answer(REPORT, {})
    assert [(site.name, site.state) for site in report.sites] == [("ros2", "joined")]
    (info,) = (await answer(SITE_INFO, {"site": "ros2"})).sites
    rows = {(row.name, row.node): row for row in info.sources}
    assert rows["/chatter", "/bot"].type == "std_msgs/String"
    assert "definitions differ" in rows["/mine", "/older"].problem
    ways = await answer(SITE_WHY, {"name": "/chatter", "site": "ros2"})
    assert [(way.peer, way.node) for way in ways] == [("ros2", "/bot")]
    with pytest.raises(UnreachableError):
        await answer(SITE_INFO, {"site": "hall"})


async def test_questions_about_sites_go_to_what_answers_for_them(bed: Ros2Bed) -> None:
    bed.neighbour.sites = OtherSites()
    report: SitesReport = await bed.neighbour.answer(REPORT, {})
    assert [site.name for site in report.sites] == ["hall", "ros2"]
    for what, args in ((SITE_INFO, {"site": "hall"}), (SITE_WHY, {"name": "/nothing"})):
        assert await bed.neighbour.answer(what, args) == ["of a site"]
