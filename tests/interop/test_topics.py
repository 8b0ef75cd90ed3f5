"""Topics between agents: heard once by all, latched, joined late, in order and whole at each rate."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import pytest

from lab.bed.namespaces import Lab
from lab.bed.processes import Event, Process, eventually
from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory
from tests.interop.modules import Module, flows, whole
from tests.interop.recordings import recorded, wait_last

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]
CLIENTS = ["rospy", "roscpp"]


def test_stock_tools_see_the_remote_topic_as_their_own(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", "__name:=speaker", topic="/chatter", rate=50)
    b.wait_topic("/chatter")
    assert b.ros.tool("rostopic", "type", "/chatter").strip() == "std_msgs/UInt8MultiArray"
    info = b.ros.tool("rostopic", "info", "/chatter")
    assert "Publishers:" in info
    assert "speaker" in info
    assert "layout:" in b.ros.tool("rostopic", "echo", "-n1", "/chatter")
    rate = b.ros.start("rostopic", "hz", "/chatter")
    assert float(rate.wait_for(r"average rate: ([\d.]+)").group(1)) > 5.0
    rate.interrupt()
    assert "/chatter" in b.ros.tool("rostopic", "list", "-p")


TOPIC = "/map"
BIG = 1_000_000
DIRECT = f'[[contract]]\ntopics = ["{TOPIC}"]\ntransport = "direct"\n'


def greeted(listener: Process, beyond: int = 0) -> dict[str, dict[str, int]]:
    """What a listener has heard of each source, once it has the greeting, and more than ``beyond`` messages."""

    def enough(event: Event) -> bool:
        sources = cast("dict[str, dict[str, int]]", event["sources"])
        return "2" in sources and sources.get("1", {}).get("last", 0) > beyond

    return cast("dict[str, dict[str, int]]", listener.wait_event("report", where=enough)["sources"])


@pytest.mark.parametrize(
    ("kind", "size", "greeting", "latch", "config"),
    [
        pytest.param("rospy", 64, BIG, False, "", id="map-rospy"),
        pytest.param("roscpp", BIG, 64, False, "", id="images-roscpp", marks=pytest.mark.long),
        pytest.param("roscpp", 64, 1000, True, "", id="latched"),  # rospy latches what it says to one subscriber, too
        pytest.param("roscpp", 64, 1000, False, DIRECT, id="direct-roscpp", marks=pytest.mark.long),
    ],
)
def test_each_subscriber_anywhere_is_a_new_connection(
    modules: ModuleFactory, kind: str, size: int, greeting: int, latch: bool, config: str
) -> None:
    a, b, c = modules("a", "b", "c", config=config)
    options = {"latch": True} if latch else {}
    rate = 5 if size == BIG else 20
    a.ros.node(kind, "greeter", topic=TOPIC, size=size, greeting=greeting, rate=rate, **options).wait_event("up")
    listeners = []
    last = 0
    for module, ear in ((b, "rospy"), (b, "roscpp"), (c, "roscpp"), (c, "rospy"), (b, "roscpp"), (a, "roscpp")):
        listeners.append(module.ros.node(ear, "listener", topic=TOPIC))
        last = greeted(listeners[-1], last)["1"]["last"]
    for listener in listeners:
        sources = greeted(listener, last + 5 * rate)
        assert sources["2"]["count"] == 1, listener.name
        assert (sources["1"]["gaps"], sources["1"]["doubled"]) == (0, 0), listener.name


TF = "/tf_static"
EVERYONE = {"1", "2", "3", "4"}


def hears(module: Module, kind: str, name: str = "") -> Process:
    """A listener that reports each message."""
    return module.ros.node(kind, "listener", topic=TF, each=True, **({"name": name} if name else {}))


def got(listener: Process) -> Event:
    """The report once it has heard of all four sources."""
    return listener.wait_event("report", where=lambda event: set(event["sources"]) == EVERYONE)  # type: ignore[call-overload]


def once(report: Event) -> None:
    """Fail unless the report has one message of each source."""
    assert (report["count"], report["bad"], report["doubled"]) == (4, 0, 0), report


def last(listener: Process) -> Event:
    """The last output of a listener."""
    return listener.events("report")[-1]


@pytest.mark.trap(10)
def test_all_latched_sources_reach_each_late_joiner_once(
    modules: ModuleFactory, lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    a, b, c = modules("a", "b", "c")
    early = hears(a, "rospy", "early")
    early.wait_event("up")
    # Four nodes, two of them of one module, two of one name in two modules.
    for source, (module, kind, name) in enumerate(
        [(a, "rospy", "frames"), (b, "roscpp", "frames"), (c, "rospy", "arm"), (c, "roscpp", "base")], start=1
    ):
        module.ros.node(kind, "talker", topic=TF, count=1, latch=True, source=source, name=name).wait_event("done")
    once(got(early))
    late = [hears(module, kind) for module in (a, b, c) for kind in ("rospy", "roscpp")]
    for listener in late:
        once(got(listener))
    # A module that joins later still.
    host = lab.host("d", 0)
    d = Module(host, agent(host, name="d"), shell(host))
    once(got(hears(d, "roscpp")))
    # The stock tool, which joins late by nature.
    assert a.ros.tool("rostopic", "echo", "-n4", TF).count("layout:") == 4
    # The first subscribers did not get it again.
    for listener in (early, *late):
        once(last(listener))


def test_a_latched_message_is_not_repeated_when_the_link_is_back(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    for kind, source, size in (("rospy", 1, 300), ("roscpp", 2, 2_000_000)):
        a.ros.node(kind, "talker", topic=TF, count=1, latch=True, source=source, size=size).wait_event("done")
    a.ros.roscpp("talker", topic="/beat", rate=50)
    listeners = [hears(b, kind) for kind in ("rospy", "roscpp")]
    beat = b.ros.roscpp("listener", topic="/beat")
    for listener in listeners:
        listener.wait_event("report", where=lambda event: event["count"] == 2)
    flows(beat)
    b.host.outage(1.0)
    flows(beat, 100)
    # A longer one: what is not latched leaves the graph, and a late joiner is told meanwhile what is latched.
    b.host.cut()
    eventually(lambda: "Publishers: None" in b.ros.tool("rostopic", "info", "/beat"), what="no publisher of /beat")
    listeners += [hears(b, kind) for kind in ("rospy", "roscpp")]
    for listener in listeners[2:]:
        listener.wait_event("report", where=lambda event: event["count"] == 2)
    b.host.restore()
    flows(beat, 100)
    for listener in listeners:
        assert (last(listener)["count"], last(listener)["doubled"]) == (2, 0), listener.name
    # Gone in order, or killed, a module leaves nothing behind.
    a.agent.kill()
    eventually(
        lambda: "Publishers: None" in b.ros.tool("rostopic", "info", TF), what="no publisher of a killed module"
    )


@pytest.mark.parametrize(("role", "client"), [("talker", "roscpp"), ("listener", "rospy")])
def test_nodes_that_wait_for_their_master_find_the_agent(
    lab: Lab, agent: AgentFactory, shell: ShellFactory, client: str, role: str
) -> None:
    first, second = lab.hosts("first", "second")
    agent(first, name="first")
    other = "listener" if role == "talker" else "talker"
    programs = {role: shell(second).node(client, role, topic="/chatter")}
    programs[other] = shell(first).node("roscpp", other, topic="/chatter")
    agent(second, name="second")
    assert flows(programs["listener"], 5)["bad"] == 0


def test_a_seed_reaches_across_a_router(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    near, far = lab.host("near", 0), lab.host("far", 1)
    router = lab.router(0, 1)
    lab.route(near, router)
    lab.route(far, router)
    agent(far, name="far", flags=["--port", "45000"])
    a = agent(near, name="near", flags=["--seed", f"{far.address}:45000"])
    a.wait_peer("far")
    heard = shell(near).roscpp("listener", topic="/chatter", count=20)
    shell(far).roscpp("talker", topic="/chatter", rate=100, count=20, wait=1)
    whole(heard.wait_event("done"), 20)


def test_agents_of_different_domains_do_not_meet(lab: Lab, agent: AgentFactory) -> None:
    hosts = lab.hosts("a", "b", "c")
    a, b, c = (
        agent(host, name=host.name, flags=["--domain", domain])
        for host, domain in zip(hosts, ("7", "7", "8"), strict=True)
    )
    a.wait_peer(b.name)
    assert c.name not in a.peers()
    assert not c.peers()


def test_an_interface_that_comes_after_the_agent_is_used(lab: Lab, agent: AgentFactory) -> None:
    alone = lab.host("alone")
    (b,) = lab.hosts("b")
    late = agent(alone, name="alone")
    agent(b, name="b")
    lab.network(0).plug(alone)
    late.wait_peer("b")


MEGABYTE = 1024 * 1024


@pytest.mark.parametrize(
    ("talker", "listener", "rate", "size"),
    [
        pytest.param("roscpp", "roscpp", 1000, 64, marks=pytest.mark.long),
        ("rospy", "rospy", 1000, 64),
        pytest.param("roscpp", "rospy", 100, 3000, marks=pytest.mark.long),
        pytest.param("rospy", "roscpp", 10, MEGABYTE, marks=pytest.mark.long),
    ],
)
def test_rates_from_10_hz_to_1_khz(modules: ModuleFactory, talker: str, listener: str, rate: int, size: int) -> None:
    a, b = modules("a", "b")
    assert "default" not in a.host.ip("route")  # neither a route nor a name service is needed
    count = 3 * rate
    heard = b.ros.node(listener, "listener", topic="/chatter", count=count)
    a.ros.node(talker, "talker", topic="/chatter", rate=rate, count=count, size=size, wait=1)
    whole(heard.wait_event("done"), count)


def test_sizes_around_every_buffer(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    for size in (20, 21, 65515, 65516, 65517, 65536, 5 * MEGABYTE):
        heard = b.ros.roscpp("listener", topic=f"/any{size}", count=10)
        rate = 20 if size < MEGABYTE else 3  # best effort: a busy machine drops what comes quicker
        a.ros.roscpp("talker", topic=f"/any{size}", rate=rate, count=10, size=size, wait=1)
        report = heard.wait_event("done")
        whole(report, 10)
        assert report["bytes"] == 10 * size


def test_a_slow_wire_drops_whole_messages_and_breaks_none(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.host.shape("20mbit")
    heard = b.ros.roscpp("listener", topic="/image")
    a.ros.roscpp("talker", topic="/image", rate=30, size=MEGABYTE, wait=1)
    report = heard.wait_event("report", 40.0, where=lambda event: int(str(event["count"])) >= 10)
    assert (report["bad"], report["doubled"]) == (0, 0)
    a.agent.wait_peer(b.name)


MB = 1 << 20
# What an agent may grow by: 32 MiB wait for a stuck subscriber at the most, and buffers for large messages.
GROWTH = 80 * MB


def rss(module: Module) -> int:
    """Bytes of memory that a module's agent has."""
    status = Path(f"/proc/{module.agent.pid}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) * 1024


def last_heard(listener: Process) -> int:
    """The number of the last message that a listener has."""
    return int(str(listener.events("report")[-1]["last"]))


def total(listener: Process) -> tuple[object, ...]:
    """What a listener has seen of missing, doubled and damaged messages."""
    report = listener.events("report")[-1]
    return report["gaps"], report["doubled"], report["bad"]


@pytest.mark.parametrize(
    ("size", "rate"),
    [pytest.param(MB, 30, marks=pytest.mark.alone), pytest.param(64, 1000, marks=pytest.mark.long)],
    ids=["images", "commands"],
)
def test_a_stopped_subscriber_is_its_own_affair(modules: ModuleFactory, tmp_path: Path, size: int, rate: int) -> None:
    a, b, c = modules("a", "b", "c")
    stuck = b.ros.node("rospy" if size == 64 else "roscpp", "listener", "__name:=stuck", topic="/data")
    beside = [
        b.ros.roscpp("listener", "__name:=beside_1", topic="/data"),
        b.ros.roscpp("listener", "__name:=beside_2", topic="/data"),
        c.ros.roscpp("listener", "__name:=elsewhere", topic="/data"),
    ]
    other = b.ros.roscpp("recorder", topic="/other", nodelay=True, commands=True)
    a.ros.roscpp("talker", "__name:=busy", topic="/data", size=size, rate=rate, wait=1, nodelay=True)
    a.ros.roscpp("talker", "__name:=other", topic="/other", rate=100, wait=1, nodelay=True)
    for listener in (stuck, *beside, other):
        flows(listener, 2)
    recorded(other, tmp_path)
    sizes = {module.name: rss(module) for module in (a, b, c)}
    before = [total(listener) for listener in beside]
    stuck.freeze()
    goals = [last_heard(listener) + 5 * rate for listener in beside]
    for listener, goal in zip(beside, goals, strict=True):
        wait_last(listener, goal)
    flows(other, 50)
    assert [total(listener) for listener in beside] == before
    rows = recorded(other, tmp_path)
    sequences = [row.sequence for row in rows]
    assert sequences == list(range(sequences[0], sequences[-1] + 1))
    assert sorted(row.age for row in rows)[len(rows) // 2] < 0.05
    for module in (a, b, c):
        assert rss(module) - sizes[module.name] < GROWTH
    present = last_heard(beside[0])
    assert present - last_heard(stuck) > 3 * rate
    stuck.thaw()
    wait_last(stuck, present + 1)
    assert total(stuck)[1:] == (0, 0)
    # Old messages fill its socket and, of large ones, no more than its queue; the others gave way to newer ones.
    eventually(
        lambda: last_heard(beside[0]) - last_heard(stuck) < rate,
        what="the stuck subscriber has caught up",
    )
