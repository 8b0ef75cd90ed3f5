"""The history of the graph: changes since a revision, and everything where it does not reach back so far."""

from __future__ import annotations

import msgspec
import pytest

from rmpa.observe import graph as graph_changes
from rmpa.observe import limits
from rmpa.observe.graph import GraphHistory, GraphRevision, GraphRows, TopicRow
from rmpa.ros.master.parameters import RegistrationKind
from rmpa.ros.master.registrations import Registrations

_API = "http://127.0.0.1:9/"


class _Graph:
    """A master's tables with their history."""

    def __init__(self, revision: int = 100) -> None:
        self.tables = Registrations()
        self.history = GraphHistory(revision)

    def publish(self, topic: str, node: str = "/talker") -> None:
        self.tables.register(RegistrationKind.PUBLISHER, topic, node, _API, "std_msgs/String")
        self.note()

    def note(self) -> None:
        changes, self.tables.changes = self.tables.changes, []
        for change in changes:
            self.history.add(change)

    def ask(self, known: object) -> GraphRows:
        return self.history.rows_since(known, self.tables.state())


def test_nothing_is_kept_without_a_client_and_no_more_when_it_is_far_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "GRAPH_HISTORY", 8)
    graph = _Graph()
    for number in range(20):
        graph.publish(f"/before{number}")
    assert not graph.history._changes
    graph.ask(None)
    known = graph.history.revision
    for number in range(8):
        graph.publish(f"/after{number}")
    assert not graph.history.rows_since(known, graph.tables.state()).whole
    for number in range(20):
        graph.publish(f"/gone{number}")
    assert not graph.history._changes
    rows = graph.ask(known)
    assert rows.whole
    assert len(rows.topics) == 48


@pytest.mark.parametrize("known", [None, 99, 10_000, -1, "100", 100.0, True])
def test_a_revision_of_another_agent_gets_the_whole_graph(known: object) -> None:
    graph = _Graph()
    graph.publish("/a")
    graph.ask(None)
    graph.publish("/b")
    rows = graph.ask(known)
    assert rows.whole
    assert [row.name for row in rows.topics] == ["/a", "/b"]


def test_an_answer_without_rows_is_what_it_was_before_there_were_any() -> None:
    assert msgspec.json.encode(GraphRevision(revision=7)) == b'{"revision":7}'
    rows = GraphRows(topics=(TopicRow("/a", "*", ("/n",), ()),))
    encoded = msgspec.json.encode(GraphRevision(revision=7, core_uri="http://h:1/", rows=rows))
    assert encoded == b'{"revision":7,"core_uri":"http://h:1/","rows":{"topics":[["/a","*",["/n"],[]]]}}'
    assert msgspec.json.decode(encoded, type=graph_changes.GraphRevision).rows == rows
