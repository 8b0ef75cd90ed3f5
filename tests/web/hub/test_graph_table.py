"""The graph made of the agent's rows is that which the master's own answers give, whatever has changed in between."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.observe import limits
from rmpa.observe.graph import GraphHistory, GraphRows, TopicRow
from rmpa.ros.master.parameters import RegistrationKind
from rmpa.ros.master.registrations import Registrations
from rmpa.web.hub.graph import GraphTable, rows_of

_NODES = ("/a", "/b", "/c")
_NAMES = ("/x", "/y", "/z/w", "/rosout")
_TYPES = ("std_msgs/String", "std_msgs/Int32", "*")
_STEP = st.one_of(
    st.tuples(st.just("publish"), st.sampled_from(_NAMES), st.sampled_from(_NODES), st.sampled_from(_TYPES)),
    st.tuples(st.just("subscribe"), st.sampled_from(_NAMES), st.sampled_from(_NODES), st.sampled_from(_TYPES)),
    st.tuples(st.just("serve"), st.sampled_from(_NAMES), st.sampled_from(_NODES), st.sampled_from(("1", "2"))),
    st.tuples(st.sampled_from(("unpublish", "unsubscribe", "unserve")), st.sampled_from(_NAMES),
              st.sampled_from(_NODES), st.just("1")),
    st.tuples(st.just("die"), st.just(""), st.sampled_from(_NODES), st.just("")),
    st.tuples(st.sampled_from(("ask", "restart")), st.just(""), st.just(""), st.just("")),
)  # fmt: skip


def _table() -> GraphTable:
    return GraphTable({name: (f"pkg/{name[1].upper()}", f"rosrpc://{name}") for name in _NAMES}, lambda _: None)


def _read(tables: Registrations) -> GraphTable:
    """The graph as the master's answers give it."""
    kinds = (RegistrationKind.PUBLISHER, RegistrationKind.SUBSCRIBER, RegistrationKind.SERVICE)
    state = [[[name, list(nodes)] for name, nodes in tables.table(kind).items()] for kind in kinds]
    made = _table()
    made.update(rows_of(state, [list(each) for each in tables.types().items()]))
    return made


def _act(tables: Registrations, what: str, name: str, node: str, more: str) -> None:
    api, uri = f"http://host{node}:1/", f"rosrpc://host{node}:{more}"
    match what:
        case "publish":
            tables.register(RegistrationKind.PUBLISHER, name, node, api, more)
        case "subscribe":
            tables.register(RegistrationKind.SUBSCRIBER, name, node, api, more)
        case "serve":
            tables.register(RegistrationKind.SERVICE, name, node, api, uri)
        case "unpublish":
            tables.unregister(RegistrationKind.PUBLISHER, name, node, api)
        case "unsubscribe":
            tables.unregister(RegistrationKind.SUBSCRIBER, name, node, api)
        case "unserve":
            tables.unregister(RegistrationKind.SERVICE, name, node, uri)
        case "die":
            tables.purge(node, api)


@given(st.lists(_STEP, max_size=60), st.integers(1, 6))
def test_changes_lead_to_the_graph_that_the_master_has(steps: list[tuple[str, str, str, str]], kept: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(limits, "GRAPH_HISTORY", kept)
        tables, history = Registrations(), GraphHistory(1 << 40)
        table, known = _table(), None
        for what, name, node, more in [*steps, ("ask", "", "", "")]:
            if what == "restart":  # of the agent, with an empty core
                tables, history = Registrations(), GraphHistory(history.revision + 1000)
            _act(tables, what, name, node, more)
            changes, tables.changes = tables.changes, []
            for change in changes:
                history.add(change)
            if what == "ask":
                table.update(history.rows_since(known, tables.state()))
                known = history.revision
                read = _read(tables)
                assert table.topics == read.topics
                assert table.services == read.services
                assert list(table.topics) == sorted(table.topics)
                assert list(table.services) == sorted(table.services)
                assert table.nodes == read.nodes


def test_types_that_publishers_showed_stay_while_there_is_a_publisher() -> None:
    table = _table()
    row = TopicRow("/t", "std_msgs/String", ("/a",), ())
    table.update(GraphRows(whole=True, topics=(row,)))
    assert table.saw_type("/t", "std_msgs/Int32")
    assert not table.saw_type("/t", "std_msgs/Int32")
    table.update(GraphRows(topics=(TopicRow("/t", "std_msgs/String", ("/a", "/b"), ()),)))
    assert set(table.topics["/t"].types) == {"std_msgs/String", "std_msgs/Int32"}
    table.update(GraphRows(topics=(TopicRow("/t", "std_msgs/String", (), ("/c",)),)))
    assert table.topics["/t"].types == ("std_msgs/String",)


def test_malformed_answers_of_a_master_are_left_out() -> None:
    table = _table()
    table.update(rows_of([[["/t", ["/a"]], ["/u"], 7], [], "no"], [["/t", "std_msgs/String"], ["/t"]]))
    assert [*table.topics] == ["/t"]
    table.update(rows_of("none", 3))
    assert not table.topics
