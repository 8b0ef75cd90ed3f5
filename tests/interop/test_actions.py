"""actionlib's unmodified clients and servers in different modules: rospy's and roscpp's, each with each."""

from __future__ import annotations

import pytest

from lab.bed.processes import Event, Process, eventually
from tests.interop.conftest import ModuleFactory
from tests.interop.modules import Module
from tests.interop.ros import lacks

pytestmark = [
    pytest.mark.ros,
    pytest.mark.netns,
    pytest.mark.timeout(120),
    pytest.mark.skipif(bool(lacks("actionlib")), reason=lacks("actionlib")),
]

SURE = """
[[contract]]
types = ["*/*ActionGoal", "*/*ActionResult", "actionlib_msgs/GoalID"]
reliability = "reliable"
"""


def finds(client: Process, *, found: bool = True, wait: float = 20.0) -> None:
    """Fail unless the client says, within its own time, that there is a server, or that there is none."""
    since = client.mark_events()
    client.tell(f"server {wait}")
    assert client.wait_event("server", wait + 10.0, since=since)["found"] is found


def ends(client: Process, *, since: int) -> tuple[object, object]:
    """How the client's goal ended: its state and its result."""
    done = client.wait_event("done", since=since)
    return done["state"], done["result"]


def fed(client: Process, value: int, *, since: int = 0) -> Event:
    """Wait for one feedback."""
    return client.wait_event("feedback", where=lambda event: event["value"] == value, since=since)


def fed_in_order(client: Process, goal: int, *, connected: bool, since: int = 0) -> None:
    """Fail unless feedback came without a gap; the last of it may be behind the result, which is another topic.

    Args:
        client: The action client.
        goal: How many feedbacks its server sends.
        connected: The first one counts too: it does with roscpp's client once feedback has come before. Until then
            that client may miss the first, because its ``waitForServer`` counts a publisher from ``connect()`` on,
            before the TCPROS handshake ends. rospy's client always may: see ``active_at_most_once``.
        since: A mark of the client's events.
    """
    values = [int(str(event["value"])) for event in client.events("feedback", since=since)]
    first = 1 if connected else values[0]
    assert first <= 3
    assert 1 <= len(values) <= goal
    assert values == list(range(first, first + len(values)))


def active_at_most_once(client: Process, kind: str) -> None:
    """Fail unless the client was told that its one goal is active.

    rospy's client may miss it: ``SimpleActionClient`` ignores what its other threads receive before ``send_goal`` has
    stored the goal's handle ("Got a transition callback on a goal handle that we're not tracking").
    """
    told = len(client.events("active"))
    assert told == 1 or (kind == "rospy" and told == 0)


def client_in(module: Module, kind: str, name: str = "client") -> Process:
    """An action client that follows the commands of a test."""
    return module.ros.node(kind, "action_client", name=name, commands=True)


@pytest.mark.parametrize(
    ("server_kind", "client_kind"), [("rospy", "roscpp"), pytest.param("roscpp", "rospy", marks=pytest.mark.long)]
)
def test_goals_of_one_module_are_done_in_another(modules: ModuleFactory, client_kind: str, server_kind: str) -> None:
    a, b = modules("a", "b")
    client = client_in(a, client_kind)
    server = b.ros.node(server_kind, "action_server", name="server")
    finds(client)

    # To the end: feedback in order, and the result.
    since = client.mark_events()
    client.tell("send 20")
    assert ends(client, since=since) == ("SUCCEEDED", 20)
    active_at_most_once(client, client_kind)
    fed_in_order(client, 20, connected=False)
    since = client.mark_events()
    client.tell("send 20")
    assert ends(client, since=since) == ("SUCCEEDED", 20)
    fed_in_order(client, 20, connected=client_kind == "roscpp", since=since)

    # Cancelled by the client.
    since = client.mark_events()
    client.tell("send 100000")
    fed(client, 3, since=since)
    client.tell("cancel")
    state, result = ends(client, since=since)
    ended = server.wait_event("ended", where=lambda event: event["how"] == "preempted")
    assert (state, result) == ("PREEMPTED", ended["last"])

    # Aborted by the server.
    since = client.mark_events()
    client.tell("send -1")
    assert ends(client, since=since) == ("ABORTED", -1)

    # Preempted by another client, in the server's own module; that one's goal is done, too.
    since = client.mark_events()
    client.tell("send 100000")
    fed(client, 3, since=since)
    other = client_in(b, server_kind, "other")
    finds(other)
    other.tell("send 3")
    assert ends(client, since=since)[0] == "PREEMPTED"
    assert ends(other, since=0) == ("SUCCEEDED", 3)

    # Killed, it is believed in no more; started again, it is.
    server.kill()
    eventually(lambda: "/server" not in b.ros.tool("rostopic", "info", "/count/goal"), what="the killed server gone")
    eventually(lambda: not _found_at_once(client), what="no server any more")
    b.ros.node(server_kind, "action_server", name="server")
    finds(client)
    since = client.mark_events()
    client.tell("send 5")
    assert ends(client, since=since) == ("SUCCEEDED", 5)


def _found_at_once(client: Process) -> bool:
    since = client.mark_events()
    client.tell("server 0.3")
    return bool(client.wait_event("server", since=since)["found"])


def test_each_of_several_clients_gets_its_own_result(modules: ModuleFactory) -> None:
    a, b, c = modules("a", "b", "c")
    clients = [client_in(a, "rospy"), client_in(c, "roscpp")]  # nodes of one name in two modules
    server = b.ros.roscpp("action_server", name="server")
    for client in clients:
        finds(client)
    for client, goal in zip(clients, (4, 6), strict=True):
        client.tell(f"send {goal}")
        assert ends(client, since=0) == ("SUCCEEDED", goal)
        fed_in_order(client, goal, connected=False)
    assert [event["goal"] for event in server.events("goal")] == [4, 6]
    # The stock tools say who listens to a client's goals, and whose node it stands for.
    assert "/rmpa/a/client" in b.ros.tool("rostopic", "info", "/count/goal")
    assert "/rmpa/c/client" in b.ros.tool("rostopic", "info", "/count/goal")
    assert "to: /rmpa/b/server" in a.ros.tool("rosnode", "info", "/client")


def test_a_long_goal_outlives_the_loss_of_the_link(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=SURE)
    server = b.ros.rospy("action_server", name="server", period=0.1)
    client = client_in(a, "rospy")
    finds(client)
    client.tell("send 30")
    fed(client, 5)
    # The cable is out when the server comes to its end: the result waits for it.
    b.host.cut()
    server.wait_event("ended")
    assert not client.events("done")
    b.host.restore()
    assert ends(client, since=0) == ("SUCCEEDED", 30)
    finds(client)
    # And a goal after it is done as before.
    since = client.mark_events()
    client.tell("send 3")
    assert ends(client, since=since) == ("SUCCEEDED", 3)
