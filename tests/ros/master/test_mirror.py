"""The mirror beside a master that is another program: here the embedded one, asked as over XML-RPC."""

from __future__ import annotations

from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.master.api import MasterApi
from rmpa.ros.master.mirror import Call, Mirror, Survey, lookup_calls, read_lookups, read_survey, survey_calls
from rmpa.ros.master.parameters import RegistrationKind
from rmpa.ros.wire.xmlrpc import XmlRpcValue

OURS: Final = "http://127.0.0.1:1/"
THEIRS: Final = "http://127.0.0.1:2/"
MOVED: Final = "http://127.0.0.1:3/"
STRING: Final = "std_msgs/String"


class Pair:
    """A master, the mirror, and what the one has not been told by the other."""

    def __init__(self) -> None:
        self.master = MasterApi("http://m:1/", 1, lambda _: None)
        self.mirror = Mirror()
        self.graph = self.mirror.registrations
        self.writes: list[Call] = []
        self.nodes: tuple[str, ...] = ()

    def restart(self) -> None:
        """The master is another one now, which knows nothing."""
        self.master = MasterApi("http://m:1/", 2, lambda _: None)
        self.writes.clear()

    def theirs(self, method: str, *params: str) -> None:
        """Another program calls the master."""
        self.master.call(method, params)

    def call(self, method: str, *params: XmlRpcValue) -> XmlRpcValue:
        """We do, by the mirror."""
        self.writes.append((method, params))
        return self.mirror.apply(method, params).value

    def flush(self) -> None:
        """What we called arrives."""
        for method, params in self.writes:
            assert self.master.call(method, params).code == 1
        self.writes.clear()

    def survey(self) -> Survey:
        """Ask the master for everything."""
        found = read_survey(self._many(survey_calls("/rmpa", self.nodes, ())), self.nodes, ())
        nodes = [node for node in found.nodes() if node not in found.uris]
        services = list(found.holders[RegistrationKind.SERVICE])
        self.nodes = tuple(found.nodes())
        uris, places = read_lookups(self._many(lookup_calls("/rmpa", nodes, services)), nodes, services)
        found.uris |= uris
        found.services |= places
        return found

    def look(self) -> list[Call]:
        """Look at the master and learn; what must be registered again is written."""
        seen = self.mirror.asked
        again = self.mirror.update(self.survey(), seen)
        self.writes += again
        return again

    def changes(self) -> set[tuple[str, str, str]]:
        """What has changed: ``+`` or ``-``, the topic or service, the node."""
        return {("+" if c.added else "-", c.name, c.node) for c in self.graph.take()[1]}

    def _many(self, calls: list[XmlRpcValue]) -> XmlRpcValue:
        return self.master.answer("system.multicall", [calls])


@pytest.fixture
def pair() -> Pair:
    return Pair()


def test_other_type_of_a_topic_is_a_change(pair: Pair) -> None:
    pair.theirs("registerPublisher", "/p", "/t", "*", THEIRS)
    pair.theirs("registerSubscriber", "/s", "/u", "*", MOVED)
    pair.look()
    pair.graph.take()[1]
    pair.theirs("registerPublisher", "/p", "/t", STRING, THEIRS)
    pair.theirs("registerSubscriber", "/s", "/u", STRING, MOVED)
    pair.look()
    changes = {(change.name, change.node, change.type) for change in pair.graph.take()[1]}
    assert changes == {("/t", "/p", STRING), ("/u", "/s", STRING)}
    assert pair.graph.state() == pair.master.registrations.state()


def test_a_provider_that_a_look_from_before_saw_does_not_take_ours(pair: Pair) -> None:
    pair.theirs("registerService", "/n", "/srv", "rosrpc://h:9", THEIRS)
    seen, survey = pair.mirror.asked, pair.survey()
    pair.theirs("unregisterService", "/n", "/srv", "rosrpc://h:9")
    pair.call("registerService", "/rmpa/b/n", "/srv", "rosrpc://h:10", OURS)
    pair.flush()
    pair.mirror.update(survey, seen)
    assert pair.graph.state().services == {"/srv": {"/rmpa/b/n": "rosrpc://h:10"}}
    assert pair.look() == []


def test_ours_counts_at_once_and_a_look_from_before_takes_nothing_back(pair: Pair) -> None:
    pair.theirs("registerSubscriber", "/s", "/t", STRING, THEIRS)
    pair.look()
    seen, survey = pair.mirror.asked, pair.survey()
    assert pair.call("registerPublisher", "/rmpa", "/t", STRING, OURS) == [THEIRS]
    assert pair.call("registerSubscriber", "/rmpa", "/t", STRING, OURS) == [OURS]
    assert pair.graph.at(RegistrationKind.PUBLISHER, "/t") == {"/rmpa": OURS}
    assert pair.mirror.update(survey, seen) == []
    assert pair.graph.at(RegistrationKind.PUBLISHER, "/t") == {"/rmpa": OURS}
    pair.flush()
    assert pair.look() == []
    seen, survey = pair.mirror.asked, pair.survey()
    assert pair.call("unregisterPublisher", "/rmpa", "/t", OURS) == 1
    assert pair.call("unregisterPublisher", "/rmpa", "/t", OURS) == 0
    assert pair.mirror.update(survey, seen) == []
    assert pair.graph.at(RegistrationKind.PUBLISHER, "/t") == {}


def test_what_the_master_lacks_of_ours_is_registered_again(pair: Pair) -> None:
    calls: list[Call] = [
        ("registerPublisher", ("/rmpa", "/t", STRING, OURS)),
        ("registerSubscriber", ("/rmpa", "/u", "*", OURS)),
        ("registerService", ("/rmpa/b/n", "/srv", "rosrpc://h:9", OURS)),
        ("subscribeParam", ("/rmpa", OURS, "/key")),
    ]
    pair.look()
    for method, params in calls:
        pair.call(method, *params)
    pair.flush()
    assert pair.look() == []
    pair.restart()
    assert sorted(pair.look()) == sorted(calls)
    pair.flush()
    assert pair.look() == []
    assert pair.graph.state() == pair.master.registrations.state()
    for method, params in pair.mirror.unregister_calls():
        pair.call(method, *params)
    pair.flush()
    assert pair.master.registrations.nodes() == {}


def test_nodes_of_a_former_master_stay_until_they_die_or_return(pair: Pair) -> None:
    for node, api in (("/dies", THEIRS), ("/returns", MOVED)):
        pair.theirs("registerPublisher", node, "/t", STRING, api)
    pair.look()
    pair.restart()
    pair.look()
    assert pair.graph.at(RegistrationKind.PUBLISHER, "/t") == {"/dies": THEIRS, "/returns": MOVED}
    pair.theirs("registerPublisher", "/returns", "/other", STRING, "http://127.0.0.1:4/")
    pair.mirror.mark_dead("/dies", THEIRS)
    pair.look()
    assert pair.graph.at(RegistrationKind.PUBLISHER, "/t") == {}
    assert pair.graph.state().nodes == {"/returns": "http://127.0.0.1:4/"}


def test_local_provider_replaces_our_service_for_good(pair: Pair) -> None:
    pair.call("registerService", "/rmpa/b/n", "/srv", "rosrpc://h:9", OURS)
    pair.flush()
    pair.look()
    pair.theirs("registerService", "/local", "/srv", "rosrpc://h:10", THEIRS)
    pair.changes()
    assert pair.look() == []
    assert pair.changes() == {("-", "/srv", "/rmpa/b/n"), ("+", "/srv", "/local")}
    assert pair.graph.state().services == {"/srv": {"/local": "rosrpc://h:10"}}


def test_what_the_master_does_not_take_is_none(pair: Pair) -> None:
    pair.call("registerPublisher", "/rmpa", "/t", STRING, OURS)
    pair.mirror.forget(("registerPublisher", ("/rmpa", "/t", STRING, OURS)))
    assert pair.graph.state().publishers == {}
    assert pair.look() == []
    assert pair.mirror.apply("registerPublisher", ["/rmpa", "/t"]).code == -1
    assert pair.mirror.apply("registerPublisher", ["/rmpa", "/t", STRING, 5]).code == -1


@pytest.mark.parametrize(
    "answer",
    [None, "x", [], [[[1, "", 0]]] * 4, [[[1, "", [[], []]]]] + [[[1, "", []]]] * 3, [[[1, "", [[5], [], []]]]] * 4],
)
def test_an_answer_that_is_no_survey_is_an_error(answer: XmlRpcValue) -> None:
    with pytest.raises(RemoteProtocolError):
        read_survey(answer, (), ())
    with pytest.raises(RemoteProtocolError):
        read_lookups(answer, ["/a"] * 5, [])


ANSWERS: Final = st.recursive(
    st.none() | st.booleans() | st.integers(-1, 2) | st.sampled_from(["", "/t", "/n", OURS]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["faultCode", "x"]), inner),
    max_leaves=40,
)


@given(st.lists(st.builds(lambda value: [[1, "", value]], ANSWERS) | ANSWERS, min_size=4, max_size=7))
def test_whatever_a_master_answers_is_a_survey_or_an_error(answer: list[XmlRpcValue]) -> None:
    try:
        survey = read_survey(answer, ["/n", "/m"], ["/srv"])
    except RemoteProtocolError:
        return
    mirror = Mirror()
    mirror.update(survey, 0)
    assert set(mirror.registrations.state().nodes) <= set(survey.uris)


def test_what_a_survey_shows_of_a_node_between_two_of_its_registrations_goes_again(pair: Pair) -> None:
    """The call that unregisters is lost, or the survey began before it: the node is taken for a stranger's."""
    pair.call("registerPublisher", "/rmpa", "/b", STRING, OURS)
    pair.flush()
    pair.look()
    pair.call("unregisterPublisher", "/rmpa", "/b", OURS)
    pair.writes.clear()
    pair.look()
    pair.call("registerPublisher", "/rmpa", "/a", STRING, OURS)
    pair.flush()
    pair.look()
    pair.flush()
    assert pair.look() == []
    assert set(pair.graph.state().publishers) == set(pair.master.registrations.state().publishers) == {"/a"}


NAMES: Final = st.sampled_from(["/a", "/b"])
APIS: Final = st.sampled_from([THEIRS, MOVED])
METHODS: Final = st.sampled_from(
    ["registerPublisher", "registerSubscriber", "unregisterPublisher", "unregisterSubscriber"]
)
STEPS: Final = st.lists(
    st.one_of(
        st.tuples(st.just("theirs"), METHODS, st.sampled_from(["/x", "/y"]), NAMES, APIS),
        st.tuples(st.just("ours"), METHODS, st.sampled_from(["/rmpa", "/rmpa/b/n"]), NAMES, st.just(OURS)),
        st.tuples(st.just("look")),
        st.tuples(st.just("lose")),
    ),
    max_size=30,
)


@given(STEPS)
def test_whatever_happened_the_next_look_shows_what_the_master_has(steps: list[tuple[str, ...]]) -> None:
    """Our calls leave before each look, as those of the external core do; some do not arrive."""
    pair = Pair()
    for step in steps:
        if step[0] == "look":
            pair.flush()
            pair.look()
            continue
        if step[0] == "lose":
            pair.writes.clear()
            continue
        who, method, node, topic, api = step
        kind = [STRING] if method.startswith("register") else []
        (pair.theirs if who == "theirs" else pair.call)(method, node, topic, *kind, api)
    pair.flush()
    pair.look()
    pair.flush()
    assert pair.look() == []
    mirror, master = pair.graph.state(), pair.master.registrations.state()
    assert (mirror.publishers, mirror.subscribers, mirror.nodes) == (
        master.publishers, master.subscribers, master.nodes,
    )  # fmt: skip
