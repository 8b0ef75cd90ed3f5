from __future__ import annotations

import pytest

from rmpa.bridge import limits
from rmpa.bridge.topics.subscribers import audience, compares_names, is_watched


@pytest.mark.parametrize(
    ("type_name", "watched"),
    [
        ("move_base_msgs/MoveBaseActionGoal", True),
        ("actionlib_msgs/GoalID", True),
        ("actionlib_msgs/GoalStatusArray", False),
        ("move_base_msgs/MoveBaseActionResult", False),
        ("move_base_msgs/MoveBaseGoal", False),
        ("other_msgs/GoalID", False),
        ("*", False),
    ],
)
def test_publishers_of_goals_and_cancellations_look_at_who_listens(type_name: str, watched: bool) -> None:
    assert is_watched(type_name) is watched


def test_nodes_are_named_once_in_order_and_nobody_else() -> None:
    caller_ids = ("/b", "/a", "/b", "/rmpa", "/rmpa/peer/node", "no name", "", "/line\nfeed", "/" + "x" * 2000)
    # What stands for other modules is named where we relay: nothing else of theirs listens to a proxy.
    assert audience(caller_ids) == ("/a", "/b", "/rmpa/peer/node")


def test_no_more_are_named_than_a_message_may_hold() -> None:
    assert len(audience(f"/n{number}" for number in range(1000))) == limits.AUDIENCE_MAX


def test_all_topics_of_an_action_compare_names() -> None:
    of_actions = {
        "actionlib/TestActionGoal",
        "actionlib_msgs/GoalID",
        "actionlib_msgs/GoalStatusArray",
        "actionlib/TestActionFeedback",
        "actionlib/TestActionResult",
    }
    assert all(compares_names(name) for name in of_actions)
    assert not compares_names("std_msgs/String")
