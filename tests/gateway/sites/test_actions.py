"""Actions between sites: a client here hears the name of a server at another site."""

from __future__ import annotations

from typing import Any, cast

from rmpa.gateway.neighbour import ForeignSource, MeshSource, SourceKind
from rmpa.gateway.sites.keys import SiteModule, SiteSource
from rmpa.gateway.sites.plans import SiteExport, SiteImport
from rmpa.gateway.sites.services import SiteActions

RUN = "0" * 32


def client(topic: str, type_name: str) -> SiteExport:
    source = MeshSource(SourceKind.TOPIC, "base", RUN, "/client", topic, type_name, topic, "/rmpa/base/client")
    return SiteExport(source, SiteSource(SiteModule("yard", "base", RUN), source.kind, type_name, "/client", topic))


def server(topic: str, type_name: str = "actionlib_msgs/GoalStatusArray") -> SiteImport:
    source = ForeignSource(SourceKind.TOPIC, "warehouse", "arm", "/server", topic, type_name)
    announced = SiteSource(SiteModule("warehouse", "arm", RUN), source.kind, type_name, "/server", topic)
    return SiteImport(source, announced)


class _Listening:
    def __init__(self, table: set[tuple[str, str]], pair: tuple[str, str]) -> None:
        self.table, self.pair = table, pair
        table.add(pair)

    description = None

    def close(self) -> None:
        self.table.remove(self.pair)


async def test_goals_and_cancellations_are_listened_to_under_the_servers_name() -> None:
    heard: set[tuple[str, str]] = set()
    part = SiteActions(cast("Any", lambda source, foreign: _Listening(heard, (source.here, foreign.name))))
    goal, cancel = client("/move/goal", "arm_msgs/MoveActionGoal"), client("/move/cancel", "actionlib_msgs/GoalID")
    part.export(goal)
    part.export(client("/move/other", "std_msgs/String"))
    part.show(server("/turn/status"))
    part.show(server("/move/feedback", "arm_msgs/MoveActionFeedback"))
    assert heard == set()
    part.show(server("/move/status"))
    part.export(cancel)
    assert heard == {("/move/goal", "/move/status"), ("/move/cancel", "/move/status")}
    part.withdraw(goal)
    assert heard == {("/move/cancel", "/move/status")}
    part.hide(server("/move/status"))
    assert heard == set()
    part.show(server("/move/status"))
    await part.close()
    assert heard == set()
