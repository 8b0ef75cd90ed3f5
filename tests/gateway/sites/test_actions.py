"""Actions between sites: a client here hears the name of a server at another site."""

from __future__ import annotations

from typing import Any, cast

from rmpa.gateway.rules import ForeignSource, MeshSource, SourceKind
from rmpa.gateway.sites.services import SiteActions

GOAL, CANCEL = "arm_msgs/MoveActionGoal", "actionlib_msgs/GoalID"


def client(topic: str, type_name: str) -> MeshSource:
    return MeshSource(SourceKind.TOPIC, "base", "0" * 32, "/client", topic, type_name, topic, "/rmpa/base/client")


def server(topic: str, type_name: str = "actionlib_msgs/GoalStatusArray") -> ForeignSource:
    return ForeignSource(SourceKind.TOPIC, "warehouse", "arm", "/server", topic, type_name)


class Heard(set[tuple[str, str]]):
    """The pairs of a graph's topics and the servers under whose names they are listened to."""

    def attend(self, source: MeshSource, listener: ForeignSource) -> Heard:
        self.add((source.here, listener.name))
        tap = Heard()
        tap.close = lambda: self.remove((source.here, listener.name))  # type: ignore[method-assign]
        return tap

    def close(self) -> None:
        raise NotImplementedError


def test_goals_and_cancellations_are_listened_to_under_the_servers_name() -> None:
    heard = Heard()
    actions = SiteActions(cast("Any", heard))
    actions.client(client("/move/goal", GOAL), there=True)
    actions.client(client("/move/goal", GOAL), there=True)  # for another site too
    actions.client(client("/move/other", "std_msgs/String"), there=True)
    actions.server(server("/turn/status"), there=True)
    actions.server(server("/move/feedback", "arm_msgs/MoveActionFeedback"), there=True)
    assert heard == set()
    actions.server(server("/move/status"), there=True)
    actions.client(client("/move/cancel", CANCEL), there=True)
    assert heard == {("/move/goal", "/move/status"), ("/move/cancel", "/move/status")}
    actions.client(client("/move/goal", GOAL), there=False)
    assert len(heard) == 2
    actions.client(client("/move/goal", GOAL), there=False)
    assert heard == {("/move/cancel", "/move/status")}
    actions.server(server("/move/status"), there=False)
    assert heard == set()
