"""Nodes of the run before in the master's tables: hidden until taken up, replaced by whoever registers anew."""

from __future__ import annotations

import copy

import pytest

from rmpa.ros.master.effects import Effect, PublisherUpdate, Shutdown
from rmpa.ros.master.master_api import MasterApi
from rmpa.ros.master.unverified import NodeRecord

TALKER, HEARER, NEW = "http://h:1/", "http://h:2/", "http://h:3/"
STRING = "std_msgs/String"


class Master(MasterApi):
    def __init__(self) -> None:
        super().__init__("http://h:11311/", 1, lambda _: None)

    def effects(self) -> list[Effect]:
        return self.take()[0]


@pytest.fixture
def master() -> Master:
    made = Master()
    made.registrations.restore(
        "/talker", NodeRecord(TALKER, {"/t": STRING}, services={"/s": "rosrpc://h:9"}, params={"/p/": None})
    )
    made.registrations.restore("/hearer", NodeRecord(HEARER, {}, {"/t": STRING}))
    return made


def test_unverified_node_is_not_shown(master: Master) -> None:
    assert master.call("getSystemState", ["/x"]).value == [[], [], []]
    assert master.call("lookupNode", ["/x", "/talker"]).code == -1
    assert master.call("lookupService", ["/x", "/s"]).code == -1
    assert master.call("registerSubscriber", ["/x", "/t", STRING, NEW]).value == []
    assert master.state().nodes == {"/x": NEW}
    assert not [effect for effect in master.effects() if isinstance(effect, Shutdown)]


def test_confirmed_node_has_everything_again(master: Master) -> None:
    assert master.registrations.confirm("/talker") == (["/t"], [])
    assert master.registrations.confirm("/hearer") == ([], ["/t"])
    assert master.call("getSystemState", ["/x"]).value == [
        [["/t", ["/talker"]]],
        [["/t", ["/hearer"]]],
        [["/s", ["/talker"]]],
    ]
    assert master.call("lookupService", ["/x", "/s"]).value == "rosrpc://h:9"
    assert master.call("getTopicTypes", ["/x"]).value == [["/t", STRING]]
    assert master.registrations.param_subscribers() == {"/p/": {"/talker": TALKER}}
    changes = master.take()[1]
    assert [(change.name, change.type) for change in changes if change.added] == [
        ("/t", STRING),
        ("/s", ""),
        ("/t", STRING),
    ]
    assert master.registrations.confirm("/talker") == ([], [])


def test_restored_subscriber_gets_unverified_publishers(master: Master) -> None:
    master.registrations.confirm("/hearer")
    master.call("registerPublisher", ["/proxy", "/t", STRING, NEW])
    # roscpp hangs up on whom the list leaves out: the talker has not answered yet, and is still connected.
    assert master.effects() == [PublisherUpdate(HEARER, "/t", (NEW, TALKER))]
    master.registrations.notify_subscriber("/t", "/hearer")
    assert master.effects() == [PublisherUpdate(HEARER, "/t", (NEW, TALKER))]
    master.registrations.discard("/talker")
    assert master.effects() == [PublisherUpdate(HEARER, "/t", (NEW,))]


def test_new_subscriber_gets_no_unverified_publisher(master: Master) -> None:
    master.call("registerSubscriber", ["/new", "/t", STRING, NEW])
    master.call("registerPublisher", ["/proxy", "/t", STRING, "http://h:4/"])
    assert master.effects() == [PublisherUpdate(NEW, "/t", ("http://h:4/",))]
    master.registrations.confirm("/talker")
    master.registrations.confirm("/hearer")
    master.registrations.notify_new_subscribers("/t")
    assert master.effects() == [PublisherUpdate(NEW, "/t", ("http://h:4/", TALKER))]


def test_a_node_that_registers_at_another_address_takes_the_name(master: Master) -> None:
    master.registrations.confirm("/hearer")
    master.call("registerPublisher", ["/talker", "/t", STRING, NEW])
    assert master.effects() == [
        Shutdown(TALKER, "/talker", ("/t",)),
        PublisherUpdate(HEARER, "/t", ()),
        PublisherUpdate(HEARER, "/t", (NEW,)),
    ]
    assert master.registrations.confirm("/talker") == ([], [])
    assert master.state().publishers == {"/t": {"/talker": NEW}}
    assert master.call("lookupService", ["/x", "/s"]).code == -1
    # The old one's late words do not hit the new one.
    assert master.call("unregisterPublisher", ["/talker", "/t", TALKER]).value == 0


def test_a_service_that_another_provides_meanwhile_stays_his(master: Master) -> None:
    master.call("registerService", ["/other", "/s", "rosrpc://h:7", NEW])
    master.registrations.confirm("/talker")
    assert master.call("lookupService", ["/x", "/s"]).value == "rosrpc://h:7"
    assert master.state().publishers == {"/t": {"/talker": TALKER}}


def test_unregistered_before_verification_is_not_restored(master: Master) -> None:
    master.registrations.confirm("/hearer")
    assert master.call("unregisterPublisher", ["/talker", "/t", TALKER]).value == 1
    assert master.effects() == [PublisherUpdate(HEARER, "/t", ())]
    assert master.call("unregisterService", ["/talker", "/s", "rosrpc://h:9"]).value == 1
    assert list(master.registrations.unverified) == ["/talker"]
    master.call("unsubscribeParam", ["/talker", TALKER, "/p"])
    assert list(master.registrations.unverified) == []


def test_a_node_that_registers_more_is_recorded_with_both(master: Master) -> None:
    before = master.registrations.revisions["/talker"]
    master.call("registerPublisher", ["/talker", "/more", STRING, TALKER])
    assert master.registrations.revisions["/talker"] != before
    record = master.registrations.record("/talker")
    assert record is not None
    assert record.publishers == {"/more": STRING, "/t": STRING}
    master.registrations.confirm("/talker")
    assert master.registrations.record("/talker") == record


def test_revision_changes_with_the_record_only(master: Master) -> None:
    registrations = master.registrations
    registrations.confirm("/talker")
    marks = copy.copy(registrations.revisions)
    master.call("registerPublisher", ["/talker", "/t", STRING, TALKER])
    master.call("getSystemState", ["/x"])
    master.call("unregisterPublisher", ["/stranger", "/t", NEW])
    assert registrations.revisions == marks
    for call in (
        ["registerPublisher", "/talker", "/t", "std_msgs/Int32", TALKER],
        ["registerSubscriber", "/talker", "/u", STRING, TALKER],
        ["registerService", "/talker", "/s", "rosrpc://h:5", TALKER],
        ["subscribeParam", "/talker", TALKER, "/q"],
        ["unregisterSubscriber", "/talker", "/u", TALKER],
    ):
        master.call(call[0], call[1:])
        assert registrations.revisions["/talker"] > marks["/talker"], call
        marks = copy.copy(registrations.revisions)
    registrations.purge("/talker", TALKER)
    registrations.discard("/hearer")
    assert registrations.revisions == {}
