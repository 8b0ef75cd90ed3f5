"""Direct transport: subscribers move between the transports while messages flow; none comes out of order."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import flows
from tests.interop.transports import (
    AUTO,
    RELAY,
    in_order,
    links,
    on_the_network,
    reload,
    unbroken,
    wait_direct,
    wait_relayed,
)

if TYPE_CHECKING:
    from lab.bed.processes import Event, Process
    from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

CLIENTS: Final = [("roscpp", "rospy"), ("rospy", "roscpp")]
RATE: Final = 100
MOVE_GAP: Final = RATE * 2
"""Messages that may pass while a subscriber is moved: a tenth of a second in general, much more on a busy machine."""


def gaps(report: Event) -> int:
    """Messages that are missing in a listener's report."""
    return int(str(report["gaps"]))


@pytest.mark.parametrize(("subscriber", "publisher"), CLIENTS)
def test_a_changed_contract_moves_a_subscriber_and_back(
    modules: ModuleFactory, subscriber: str, publisher: str
) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.node(publisher, "talker", topic="/chatter", rate=RATE)
    listener = b.ros.node(subscriber, "listener", topic="/chatter")
    wait_direct(listener, talker)
    for changed, turn in ((b, 1), (a, 2)):
        reload(changed, AUTO + RELAY)
        wait_relayed(listener, talker)
        reload(changed, AUTO)
        report = wait_direct(listener, talker)
        in_order(report)
        assert gaps(report) <= 2 * turn * MOVE_GAP


def test_two_subscribers_of_one_publisher_move_each_for_itself(modules: ModuleFactory) -> None:
    """A local node with the caller id of a remote subscriber takes its place at the publisher (trap 12)."""
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.rospy("talker", topic="/chatter", rate=RATE)
    viewer, other = (b.ros.rospy("listener", topic="/chatter", name=name) for name in ("viewer", "other"))
    for listener in (viewer, other):
        wait_direct(listener, talker)
    local = a.ros.rospy("listener", topic="/chatter", name="viewer")
    flows(local)
    in_order(wait_relayed(viewer, talker))
    flows(local)
    local.kill()
    report = wait_direct(viewer, talker)
    in_order(report)
    unbroken(flows(other))


@pytest.mark.parametrize(("subscriber", "publisher"), CLIENTS)
def test_a_latched_message_comes_once_more_only_when_its_topic_becomes_relayed(
    modules: ModuleFactory, subscriber: str, publisher: str
) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.node(publisher, "talker", topic="/chatter", count=1, latch=True)
    talker.wait_event("done")
    beat = a.ros.roscpp("talker", topic="/beat", rate=50)
    listener = b.ros.node(subscriber, "listener", topic="/chatter", each=True)
    heard = b.ros.roscpp("listener", topic="/beat")
    listener.wait_event("report")
    eventually(lambda: links(listener, talker) == 1, what="a direct connection")
    wait_direct(heard, beat)
    reload(b, AUTO + RELAY)
    eventually(lambda: links(listener, talker) == 0, what="no direct connection")
    flows(heard, 50)
    reload(b, AUTO)
    flows(heard, 50)
    _once(listener, doubled=1)
    # A new subscriber is direct, and gets it once as well; so does one that comes while it is relayed.
    late = b.ros.node(subscriber, "listener", topic="/chatter", each=True)
    late.wait_event("report")
    eventually(lambda: links(late, talker) == 1, what="a direct connection")
    reload(a, AUTO + RELAY)
    eventually(lambda: links(late, talker) == 0, what="no direct connection")
    later = b.ros.node(subscriber, "listener", topic="/chatter", each=True)
    later.wait_event("report")
    flows(heard, 50)
    for one, doubled in ((listener, 1), (late, 1), (later, 0)):
        _once(one, doubled=doubled)


def _once(listener: Process, *, doubled: int) -> None:
    """It got the message once, and at most so many times more."""
    report = listener.events("report")[-1]
    again = int(str(report["doubled"]))
    assert (report["count"], report["bad"]) == (1 + again, 0), report
    assert again <= doubled, report


@pytest.mark.parametrize("where", ["subscriber", "publisher"])
def test_a_renamed_topic_is_relayed_until_it_has_its_name_again(modules: ModuleFactory, where: str) -> None:
    renamed = {
        "subscriber": '[[peer]]\nname = "a"\nremap_in = { "/chatter" = "/renamed" }\n',
        "publisher": '[[peer]]\nname = "b"\nremap_out = { "/chatter" = "/renamed" }\n',
    }[where]
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.rospy("talker", topic="/chatter", rate=RATE)
    plain, other = (b.ros.roscpp("listener", topic=topic) for topic in ("/chatter", "/renamed"))
    wait_direct(plain, talker)
    reload(b if where == "subscriber" else a, AUTO + renamed)
    in_order(flows(other))
    eventually(lambda: links(plain, talker) == 0, what="no connection under the old name")
    assert links(other, talker) == 0
    reload(b if where == "subscriber" else a, AUTO)
    in_order(wait_direct(plain, talker))
    eventually(lambda: links(other, talker) == 0, what="no connection under the other name")


@pytest.mark.parametrize(("subscriber", "publisher"), CLIENTS)
def test_a_restarted_publisher_is_direct_again(modules: ModuleFactory, subscriber: str, publisher: str) -> None:
    """It comes back on another port: after kill -9, and after a proper end."""
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.node(publisher, "talker", topic="/chatter", rate=RATE, name="speaker")
    listener = b.ros.node(subscriber, "listener", topic="/chatter")
    wait_direct(listener, talker)
    for source, end in ((2, talker.kill), (3, None)):
        if end is None:
            talker.terminate()
        else:
            end()
        talker = a.ros.node(publisher, "talker", topic="/chatter", rate=RATE, name="speaker", source=source)
        wait_direct(listener, talker)
        report = listener.wait_event("report", where=lambda event, n=str(source): n in event["sources"])  # type: ignore[misc]
        in_order(report)
    settled = gaps(flows(listener))
    assert gaps(flows(listener, 50)) == settled


@pytest.mark.parametrize("client", ["roscpp", "rospy"])
def test_an_ended_subscriber_leaves_nothing_behind(modules: ModuleFactory, client: str) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.node(client, "talker", topic="/chatter", rate=RATE)
    steady = b.ros.roscpp("listener", topic="/chatter")
    wait_direct(steady, talker)
    for end in ("kill", "terminate"):
        # One that comes again under its name finds no refusal of the one before.
        listener = b.ros.node(client, "listener", topic="/chatter", name="again")
        wait_direct(listener, talker)
        getattr(listener, end)()
    unbroken(flows(steady, 50))
