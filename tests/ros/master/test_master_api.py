from __future__ import annotations

import pytest

from rmpa.ros import limits
from rmpa.ros.master.api import MasterApi
from rmpa.ros.master.parameters import GraphChange, RegistrationKind, SlaveCall
from rmpa.ros.wire.xmlrpc import RosFault, RosReply, XmlRpcValue, serialize_response

A, B, C = "http://a:1/", "http://b:2/", "http://c:3/"
STRING = "std_msgs/String"
RPC = "rosrpc://a:9"


class Master:
    """A master, and what came out of it with the last call."""

    def __init__(self) -> None:
        self.ended: list[str] = []
        self.api = MasterApi("http://m:11311/", 42, self.ended.append)
        self.calls: list[SlaveCall] = []
        self.changes: list[GraphChange] = []

    def __call__(self, method: str, *params: XmlRpcValue) -> RosReply:
        reply = self.api.call(method, params)
        self.calls, self.changes = self.api.registrations.take()
        serialize_response(list(reply))  # whatever is answered can be said
        return reply

    def whole(self, node: str, uri: str, service: str) -> None:
        """A node that registers one of each kind."""
        self("registerPublisher", node, "/t", STRING, uri)
        self("registerSubscriber", node, "/u", STRING, uri)
        self("registerService", node, "/s", service, uri)
        self("subscribeParam", node, uri, "/p")

    def value(self, method: str, *params: XmlRpcValue) -> XmlRpcValue:
        reply = self(method, *params)
        assert reply.code == 1, reply
        return reply.value


@pytest.fixture
def master() -> Master:
    return Master()


def test_publisher_and_subscribers_are_notified(master: Master) -> None:
    assert master.value("registerSubscriber", "/s", "/t", "*", B) == []
    assert master.calls == []
    assert master.value("registerPublisher", "/p", "/t", STRING, A) == [B]
    assert master.calls == [(B, "publisherUpdate", "/t", [A])]
    assert master.changes == [GraphChange(RegistrationKind.PUBLISHER, True, "/t", "/p", A, STRING)]


@pytest.mark.trap(32)
def test_the_reply_to_a_subscriber_contains_the_publishers(master: Master) -> None:
    master("registerPublisher", "/p", "/t", STRING, A)
    master("registerPublisher", "/q", "/t", STRING, C)
    assert master.value("registerSubscriber", "/s", "/t", STRING, B) == [A, C]


@pytest.mark.trap(14)
def test_repeated_registration_notifies_but_is_no_change(master: Master) -> None:
    """Rospy connects again only because of it."""
    master("registerSubscriber", "/s", "/t", "*", B)
    master("registerPublisher", "/p", "/t", STRING, A)
    master("registerPublisher", "/p", "/t", STRING, A)
    assert master.calls == [(B, "publisherUpdate", "/t", [A])]
    assert master.changes == []


def test_each_publisher_keeps_the_type_that_it_registered(master: Master) -> None:
    master("registerPublisher", "/p", "/t", STRING, A)
    master("registerPublisher", "/q", "/t", "std_msgs/Int8", C)
    master("registerPublisher", "/any", "/t", "*", B)
    type_of = master.api.registrations.type_of
    assert [type_of("/t", node) for node in ("/p", "/q", "/any")] == [STRING, "std_msgs/Int8", "std_msgs/Int8"]
    master("unregisterPublisher", "/p", "/t", A)
    assert type_of("/t", "/p") == type_of("/t") == "std_msgs/Int8"
    assert type_of("/unknown") == "*"


@pytest.mark.trap(30)
def test_uris_are_kept_as_they_are(master: Master) -> None:
    """Roscpp recognises itself by the exact text."""
    uris: list[XmlRpcValue] = ["http://HOST:1/", "http://host:1", "http://host:1//", "http://[::1]:5/x?y"]
    for number, uri in enumerate(uris):
        master("registerPublisher", f"/p{number}", "/t", STRING, uri)
    assert master.value("registerSubscriber", "/s", "/t", STRING, B) == uris


def test_nodelets_with_one_uri_are_notified_once(master: Master) -> None:
    master("registerSubscriber", "/n1", "/t", "*", B)
    master("registerSubscriber", "/n2", "/t", "*", B)
    assert master.value("registerPublisher", "/p", "/t", STRING, A) == [B, B]
    assert master.calls == [(B, "publisherUpdate", "/t", [A])]


@pytest.mark.trap(33)
@pytest.mark.parametrize(
    "taking",
    [
        ("registerPublisher", "/twin", "/new", STRING, C), ("registerSubscriber", "/twin", "/new", STRING, C),
        ("registerService", "/twin", "/new", RPC, C), ("subscribeParam", "/twin", C, "/p"),
    ],
)  # fmt: skip
def test_a_node_of_the_same_name_is_pushed_out(master: Master, taking: tuple[str, ...]) -> None:
    """By any registration, subscribeParam included."""
    master.whole("/twin", A, RPC)
    master(*taking)
    assert (A, "shutdown", "/twin", ["/t"]) in master.calls
    gone = [change for change in master.changes if not change.added]
    assert master.value("lookupNode", "/x", "/twin") == C
    assert [(change.kind, change.name, change.api) for change in gone] == [
        (RegistrationKind.PUBLISHER, "/t", A),
        (RegistrationKind.SUBSCRIBER, "/u", A),
        (RegistrationKind.SERVICE, "/s", A),
    ]  # fmt: skip
    master("setParam", "/x", "/p", 1)
    assert (A, "paramUpdate", "/p/", 1) not in master.calls


@pytest.mark.trap(33)
def test_late_unregisters_do_not_hit_the_new_node(master: Master) -> None:
    """What the old node says on its way out is about its own URI."""
    for uri, service in ((A, RPC), (C, RPC + "1")):
        master.whole("/twin", uri, service)
    before = master.api.registrations.state()
    assert master.value("unregisterPublisher", "/twin", "/t", A) == 0
    assert master.value("unregisterSubscriber", "/twin", "/u", A) == 0
    assert master.value("unregisterService", "/twin", "/s", RPC) == 0
    master("unsubscribeParam", "/twin", A, "/p")
    assert master.calls == []
    assert master.api.registrations.state() == before
    master("setParam", "/x", "/p", 1)
    assert master.calls == [(C, "paramUpdate", "/p/", 1)]


@pytest.mark.trap(33)
def test_an_evicted_node_does_not_take_its_name_back_by_a_parameter(master: Master) -> None:
    """Roscpp subscribes a parameter while it obeys our shutdown; the newer node must not die of that."""
    master("setParam", "/x", "/p", 5)
    master("registerPublisher", "/twin", "/t", STRING, A)
    master("registerPublisher", "/twin", "/t", STRING, C)
    assert master.value("subscribeParam", "/twin", A, "/p") == 5
    assert master.calls == []
    assert master.value("lookupNode", "/x", "/twin") == C
    master("setParam", "/x", "/p", 6)
    assert master.calls == []
    # A real registration does take it, and a name that is free is anybody's.
    master("registerPublisher", "/twin", "/t", STRING, A)
    assert (C, "shutdown", "/twin", ["/t"]) in master.calls
    master("unregisterPublisher", "/twin", "/t", A)
    master("subscribeParam", "/twin", C, "/p")
    assert master.value("lookupNode", "/x", "/twin") == C


def test_dead_node_is_purged_and_subscribers_notified(master: Master) -> None:
    master("registerSubscriber", "/sub", "/t", "*", B)
    master.whole("/dead", A, RPC)
    registrations = master.api.registrations
    assert not registrations.purge("/dead", C), "it came back at another URI"
    assert registrations.purge("/dead", A)
    calls, changes = master.api.registrations.take()
    assert calls == [(B, "publisherUpdate", "/t", [])]
    kinds = RegistrationKind.PUBLISHER, RegistrationKind.SUBSCRIBER, RegistrationKind.SERVICE
    assert [(change.kind, change.added) for change in changes] == [(kind, False) for kind in kinds]
    assert master("lookupNode", "/x", "/dead").code == master("lookupService", "/x", "/s").code == -1
    master("setParam", "/x", "/p", 1)
    assert master.calls == []
    assert not registrations.purge("/dead", A)


def test_purge_leaves_a_service_of_another_node(master: Master) -> None:
    master("registerService", "/old", "/s", RPC, A)
    master("registerService", "/new", "/s", RPC + "1", B)
    assert [(change.node, change.added) for change in master.changes] == [("/old", False), ("/new", True)]
    master.api.registrations.purge("/old", A)
    assert master.value("lookupService", "/x", "/s") == RPC + "1"


def test_lookups_may_be_answered_for_each_caller(master: Master) -> None:
    asked: list[tuple[str, str, str, str]] = []

    def lookup(service: str, uri: str, caller: str, api: str) -> str:
        asked.append((service, uri, caller, api))
        return "rosrpc://10.0.0.7:9" if api == B else ""

    master("registerService", "/server", "/s", RPC, A)
    master("registerSubscriber", "/near", "/t", STRING, B)
    master.api.service_lookup = lookup
    assert master.value("lookupService", "/near", "/s") == "rosrpc://10.0.0.7:9"
    assert master.value("lookupService", "/unknown", "/s") == RPC
    assert master("lookupService", "/near", "/none").code == -1
    assert asked == [("/s", RPC, "/near", B), ("/s", RPC, "/unknown", "")]


@pytest.mark.trap(34)
def test_updates_have_slashes_and_deletion_is_an_empty_dict(master: Master) -> None:
    master("subscribeParam", "/s", B, "/a/b")
    master("setParam", "/x", "/a/b", 1)
    assert master.calls == [(B, "paramUpdate", "/a/b/", 1)]
    master("setParam", "/s", "/a/b", 2)
    assert master.calls == [], "the setter itself is not told"
    master("deleteParam", "/x", "/a")
    assert master.calls == [(B, "paramUpdate", "/a/b/", {})]
    master("setParam", "/x", "/", {"a": {"b": 3}})
    assert master.calls == [(B, "paramUpdate", "/a/b/", 3)]


def test_a_member_with_a_slash_in_its_name_is_no_news_of_another_parameter(master: Master) -> None:
    """Rosmaster answers with an error instead, and sends no notification: it does not find the value for the key."""
    master("setParam", "/x", "/motors/limit", 1)
    master("subscribeParam", "/s", B, "/motors/limit")
    master("subscribeParam", "/s", B, "/speed/max")
    master("setParam", "/x", "/speed", {"/motors/limit": 99, "max": 2})
    assert master.calls == [(B, "paramUpdate", "/speed/max/", 2)]
    assert master.value("getParam", "/x", "/motors/limit") == 1


@pytest.mark.trap(35)
def test_empty_namespaces_exist_but_have_no_names(master: Master) -> None:
    master("setParam", "/x", "/empty", {})
    assert master.value("hasParam", "/x", "/empty") is True
    assert master.value("getParamNames", "/x") == []
    assert master.value("getParam", "/x", "/empty") == {}


@pytest.mark.parametrize("value", [None, [None], {"a": {"b": [1, None]}}])
def test_nil_is_refused_before_it_is_stored(master: Master, value: XmlRpcValue) -> None:
    assert master("setParam", "/x", "/p", value)[0] == -1
    assert master.value("hasParam", "/x", "/p") is False


def test_names_too_deep_are_refused(master: Master) -> None:
    deep = "/a" * (limits.PARAM_DEPTH_MAX + 1)
    for method in ("getParam", "hasParam", "deleteParam"):
        assert master(method, "/x", deep)[0] == -1
    assert master("setParam", "/x", deep, 1)[0] == -1
    assert master("setParam", "/x", "/a" * limits.PARAM_DEPTH_MAX, 1)[0] == 1


def test_validators_say_which_parameter_is_wrong(master: Master) -> None:
    reply = master("registerPublisher", "/p", "/t", "String", A)
    assert reply == (-1, "topic_type must be a type like std_msgs/String or *, not 'String'", [])
    reply = master("registerPublisher", "/p", "/t")
    assert reply.status == "registerPublisher takes (caller_id, topic, topic_type, caller_api), not 2 parameters"
    assert master("getUri", 5).status == "caller_id must be a string, not 5"


def test_its_own_api(master: Master) -> None:
    assert master.value("getUri", "/x") == "http://m:11311/"
    assert master.value("getPid", "/x") == 42
    assert master.value("shutdown", "/x", "enough") == 0
    assert master.ended == ["/x: 'enough'"]


def test_unknown_methods_are_faults(master: Master) -> None:
    for method in ("getName", "_table", "call", "__init__", "", "system.multicall"):
        with pytest.raises(RosFault, match="has no method"):
            master(method, "/x")


def test_list_methods_names_what_there_is() -> None:
    api = Master().api
    listed = api.answer("system.listMethods", [])
    assert isinstance(listed, list)
    assert {"registerPublisher", "getParamNames", "system.multicall", "system.listMethods"} <= set(listed)
    for method in listed:
        assert isinstance(method, str)
        if not method.startswith("system."):
            assert api.call(method, [])[0] == -1


def test_multicall() -> None:
    api = Master().api
    calls: list[XmlRpcValue] = [
        {"methodName": "setParam", "params": ["/x", "/p", 1]}, {"methodName": "getParam", "params": ["/x", "/p"]},
        {"methodName": "nothing", "params": []}, {"methodName": "system.multicall", "params": [[]]},
        {"methodName": "getPid"}, 5,
    ]  # fmt: skip
    answers = api.answer("system.multicall", [calls])
    assert isinstance(answers, list)
    assert answers[1] == [(1, "the value of /p", 1)]
    for fault in answers[2:]:
        assert isinstance(fault, dict)
        assert fault["faultCode"] == 1
    wrongs: list[list[XmlRpcValue]] = [["/x"], [5], [[], 5]]
    for wrong in wrongs:
        with pytest.raises(RosFault):
            api.answer("system.multicall", wrong)


@pytest.mark.parametrize(
    ("name", "caller", "resolved"),
    [
        ("rel", "/ns/node", "/ns/rel"), ("~priv", "/ns/node", "/ns/node/priv"), ("/a//b/", "/n", "/a/b"),
        ("rel", "", "/rel"), ("rel", "noslash", "/rel"), ("~x", "/", "/x"),
    ],
)  # fmt: skip
def test_names_are_resolved_for_the_caller(master: Master, name: str, caller: str, resolved: str) -> None:
    assert master.value("hasParam", caller, name) is False
    assert master("hasParam", caller, name).status == resolved
