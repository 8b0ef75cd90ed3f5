"""Two sites of the same addresses behind NAT, joined by a Zenoh router: nodes, tools, and faults of each part.

All tests share one set of processes, for that takes seconds to start; each leaves it as it was.
"""

from __future__ import annotations

import json
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

from lab.bed.agents import RMPA, Agent
from lab.bed.processes import Process, eventually
from tests.interop.modules import flows, whole
from tests.interop.recordings import recorded
from tests.interop.ros import lacks
from tests.interop.sites import JoinedModules, ended, joined_modules, nodes

if TYPE_CHECKING:
    from collections.abc import Iterator


pytest.importorskip("zenoh", reason="the extra rmpa[zenoh] is not installed")
pytestmark = [pytest.mark.ros, pytest.mark.nat, pytest.mark.timeout(120)]

LONG: Final = 40.0
# Seconds after which a killed module must be gone at the other site: 0.2 on a machine of its own, see lab/bench.
_DETECTED: Final = 2.0
LAMP: Final = Path(__file__).parent / "resources" / "lamp.py"
# Of both gateways.
RULES: Final = '[[gateway.rule]]\nnames = ["/secret/**"]\ncrossing = "none"\n'
THERE: Final = ("--peer", "warehouse/arm")


@pytest.fixture(scope="module")
def joined(tmp_path_factory: pytest.TempPathFactory) -> Iterator[JoinedModules]:
    """Both sites with their modules, gateways and shells."""
    with joined_modules(tmp_path_factory.mktemp("sites"), config=RULES) as made:
        yield made


def does(agent: Agent, *words: str, status: int = 0) -> str:
    """Run a command of rmpa that has to end with this status; return its output."""
    code, output = agent.rmpa(*words, timeout=LONG)
    assert code == status, f"rmpa {' '.join(words)}: {output}"
    return output


def test_topics_cross_both_ways_whole(joined: JoinedModules) -> None:
    """Every message arrives once, in order, and the publisher is a node of the other site's module."""
    arm, base = joined.arm, joined.base
    ways = [(arm, base, "warehouse", "/out", "roscpp", "rospy"), (base, arm, "yard", "/back", "rospy", "roscpp")]
    with ExitStack() as stack:
        heard = [
            stack.enter_context(there.ros.node(listener, "listener", topic=topic, count=200))
            for _, there, _, topic, _, listener in ways
        ]
        for got, (here, there, site, topic, talker, _) in zip(heard, ways, strict=True):
            name = f"talker_{topic[1:]}"
            options = {"topic": topic, "rate": 200, "count": 200, "size": 3000, "wait": 1}
            stack.enter_context(here.ros.node(talker, "talker", f"__name:={name}", **options))
            proxy = f"/rmpa/{site}/{here.name}/{name}"
            whole(got.wait_event("done", LONG), 200)
            assert proxy in nodes(there)
            assert proxy not in nodes(here), "it comes back to its own site"
            assert there.ros.tool("rostopic", "info", topic).count("/rmpa/") == 1, "two ways to one publisher"


def test_a_late_subscriber_gets_the_latched_message_of_a_type_that_it_has_never_seen(joined: JoinedModules) -> None:
    with joined.arm.ros.rospy("stranger", topic="/gripper", name="stranger") as stranger:
        stranger.wait_event("up")
        joined.base.wait_topic("/gripper")
        for _ in range(2):
            code, output = joined.base.agent.rmpa("topic", "echo", "/gripper", "-n", "1", timeout=LONG)
            assert (code, "force: 1.5" in output, "wrist" in output) == (0, True, True), output
    joined.base.wait_no_topic("/gripper")


def test_services_answer_across_sites_and_their_errors_arrive(joined: JoinedModules) -> None:
    with (
        joined.arm.ros.rospy("worker", service="/work", name="worker") as worker,
        joined.base.ros.rospy("caller", service="/work", wait=True, commands=True) as caller,
    ):
        worker.wait_event("up")
        caller.wait_event("there", LONG)
        for line, ok, errors in (
            ("echo 0 200000 3 once", 3, []),
            ("echo 0 64 20 persistent", 20, []),
            ("echo 0 64 10 parallel", 10, []),
            ("fail 0 0 1 once", 0, ["the gripper is jammed"]),
        ):
            since = caller.mark_events()
            caller.tell(line)
            done = caller.wait_event("done", LONG, since=since)
            assert (done["ok"], done["same"], len(done["errors"])) == (ok, ok, len(errors)), done  # type: ignore[arg-type]
            assert all(text in str(done["errors"]) for text in errors), done
        assert joined.base.ros.tool("rosservice", "node", "/work").strip() == "/rmpa/warehouse/arm/worker"


@pytest.mark.skipif(bool(lacks("actionlib")), reason="no actionlib")
def test_an_action_runs_at_the_other_site(joined: JoinedModules) -> None:
    with (
        joined.arm.ros.rospy("action_server", name="server"),
        joined.base.ros.roscpp("action_client", name="client", commands=True) as client,
    ):
        client.tell("server 30")
        assert client.wait_event("server", LONG)["found"] is True
        since = client.mark_events()
        client.tell("send 10")
        done = client.wait_event("done", LONG, since=since)
        assert (done["state"], done["result"]) == ("SUCCEEDED", 10)
        assert len(client.events("feedback", since=since)) == 10
        since = client.mark_events()
        client.tell("send 100000")
        client.wait_event("feedback", LONG, since=since)
        client.tell("cancel")
        assert client.wait_event("done", LONG, since=since)["state"] == "PREEMPTED"


def test_nothing_crosses_without_a_subscriber(joined: JoinedModules) -> None:
    with joined.arm.ros.roscpp("talker", topic="/unheard", rate=200, size=5000) as talker:
        talker.wait_event("up")
        joined.base.wait_topic("/unheard")
        quiet = joined.crossed()
        time.sleep(1.5)  # what crosses meanwhile is counted
        quiet = joined.crossed() - quiet
        with joined.base.ros.roscpp("listener", topic="/unheard") as listener:
            flows(listener, 200)
            assert joined.crossed() > 1_000_000
        assert quiet < 60_000, f"{quiet} bytes without a subscriber"


def test_a_burst_loses_nothing_uncounted(joined: JoinedModules) -> None:
    with (
        joined.base.ros.roscpp("listener", topic="/burst") as listener,
        joined.arm.ros.rospy("teller", topic="/burst", commands=True, wait=1) as teller,
    ):
        teller.wait_event("connected", LONG)
        teller.tell("64 1 0")
        flows(listener, 1)
        teller.tell("2000 1000 0")
        report = listener.wait_event("report", LONG, where=lambda e: e["last"] == 1001)
        assert report["doubled"] == 0
        assert (report["count"], report["gaps"]) == (1001, 0), "a link of this speed takes them all"


def test_a_command_is_not_late_beside_images_on_a_thin_link(joined: JoinedModules) -> None:
    """1 Mbit/s: images take what is left, and the command is never behind more than one of their pieces."""
    uplink, gateway = joined.warehouse.network.nat, joined.warehouse.gateway
    with ExitStack() as stack:
        start = stack.enter_context
        gateway.terminate()
        gateway.flags = [*gateway.flags, "--uplink", "1 Mbit/s"]
        gateway.restart()
        command = start(joined.base.ros.roscpp("recorder", topic="/command", commands=True))
        images = start(joined.base.ros.roscpp("listener", topic="/image"))
        pilot = start(joined.arm.ros.roscpp("talker", topic="/command", rate=20, size=64))
        flows(command, 5)
        camera = start(joined.arm.ros.roscpp("talker", topic="/image", rate=20, size=50_000, source=2))
        uplink.shape("1mbit", cable=1)
        try:
            flows(images, 3, LONG)
            flows(command, 100, LONG)
            camera.end()
            burst = start(joined.base.ros.roscpp("listener", topic="/thin_burst"))
            teller = start(joined.arm.ros.rospy("teller", topic="/thin_burst", commands=True, wait=1))
            teller.wait_event("connected", LONG)
            teller.tell("1000 300 0")
            whole(burst.wait_event("report", LONG, where=lambda e: e["last"] == 300), 300)
        finally:
            uplink.unshape(cable=1)
        pilot.end()
        report = command.events("report")[-1]
        assert (report["gaps"], report["doubled"]) == (0, 0)
        late = sorted(row.age for row in recorded(command, joined.net.router.home))
        assert late[len(late) // 2] < 0.7, f"half of the commands came later than {late[len(late) // 2]} s"
        gateway.terminate()
        gateway.flags = gateway.flags[:-2]
        gateway.restart()


def test_a_killed_module_is_gone_at_the_other_site_at_once_and_comes_back(joined: JoinedModules) -> None:
    proxy = "/rmpa/warehouse/arm/steady"
    with (
        joined.base.ros.rospy("watcher") as watcher,
        joined.base.ros.roscpp("listener", topic="/steady") as listener,
    ):
        watcher.wait_event("up")
        talker = joined.arm.ros.roscpp("talker", "__name:=steady", topic="/steady", rate=100)
        watcher.wait_event("there", where=lambda e: e["node"] == proxy)
        flows(listener)
        since = watcher.mark_events()
        killed = time.monotonic_ns()
        joined.arm.agent.kill()
        took = (ended(watcher, proxy, since) - killed) / 1e9
        assert took < _DETECTED, took
        since = watcher.mark_events()
        joined.arm.agent.restart()
        watcher.wait_event("there", LONG, where=lambda e: e["node"] == proxy, since=since)
        assert flows(listener, 50, LONG)["doubled"] == 0
        talker.end()


def test_the_router_is_killed_and_comes_back(joined: JoinedModules) -> None:
    with (
        joined.base.ros.rospy("listener", topic="/again") as listener,
        joined.arm.ros.rospy("talker", "__name:=again", topic="/again", rate=50),
    ):
        flows(listener, 10, LONG)
        joined.net.router.kill()
        eventually(lambda: "/rmpa/warehouse/arm/again" not in nodes(joined.base), what="the proxy gone")
        joined.net.router.restart()
        assert flows(listener, 20, LONG)["doubled"] == 0


def test_an_uplink_is_cut_and_comes_back(joined: JoinedModules) -> None:
    """Nothing local changes at either site, the tools say that the site is away, and what crosses goes on."""
    base = joined.base.agent
    with (
        joined.base.ros.rospy("listener", topic="/far") as far,
        joined.arm.ros.rospy("listener", topic="/far") as near,
        joined.arm.ros.rospy("talker", "__name:=far", topic="/far", rate=50),
    ):
        flows(far, 10, LONG)
        joined.warehouse.network.cut()
        eventually(lambda: "/rmpa/warehouse/arm/far" not in nodes(joined.base), what="the proxy gone")
        flows(near, 20)
        eventually(lambda: "unreachable" in base.rmpa("site", "list")[1], LONG, what="unreachable", every=0.5)
        for name in ("warehouse/arm:/far", "/far"):  # whose it was need not be known
            assert "site warehouse is unreachable since" in does(base, "why", name, status=1)
        does(base, "site", "info", "warehouse", status=1)
        joined.warehouse.network.restore()
        report = flows(far, 20, LONG)
        assert (report["bad"], report["doubled"]) == (0, 0)
        report = near.events("report")[-1]
        assert (report["gaps"], report["doubled"]) == (0, 0)


def test_a_frozen_site_is_gone_soon(joined: JoinedModules) -> None:
    proxy = "/rmpa/warehouse/arm/frozen"
    with (
        joined.base.ros.rospy("watcher") as watcher,
        joined.arm.ros.rospy("talker", "__name:=frozen", topic="/frozen", rate=50),
        joined.base.ros.rospy("listener", topic="/frozen") as listener,
    ):
        watcher.wait_event("there", where=lambda e: e["node"] == proxy)
        flows(listener)
        since = watcher.mark_events()
        stopped = time.monotonic_ns()
        joined.warehouse.gateway.freeze()
        try:
            took = (ended(watcher, proxy, since) - stopped) / 1e9
        finally:
            joined.warehouse.gateway.thaw()
        assert took < 5.0, took
        flows(listener, 20, LONG)


def test_a_second_gateway_takes_over(joined: JoinedModules) -> None:
    with (
        joined.base.ros.rospy("listener", topic="/kept") as listener,
        joined.arm.ros.rospy("talker", "__name:=kept", topic="/kept", rate=50),
    ):
        with joined.net.second_gateway(joined.warehouse) as second:
            joined.arm.agent.wait_peer(second.name)
            report = flows(listener, 30, LONG)
            assert (report["gaps"], report["doubled"]) == (0, 0), "one of them alone exports"
            joined.warehouse.gateway.kill()
            flows(listener, 30, LONG)
            assert [node for node in nodes(joined.base) if node.endswith("/kept")] == ["/rmpa/warehouse/arm/kept"]
            joined.warehouse.gateway.restart()
            assert flows(listener, 30, LONG)["doubled"] == 0
        assert flows(listener, 30, LONG)["doubled"] == 0


def test_why_and_site_tell_of_both_sites(joined: JoinedModules) -> None:
    base = joined.base.agent
    with (
        joined.arm.ros.rospy("talker", "__name:=told", topic="/told", rate=20),
        joined.arm.ros.rospy("talker", "__name:=spy", topic="/secret/word", rate=20) as spy,
        joined.base.ros.rospy("listener", topic="/told") as listener,
    ):
        flows(listener, 5, LONG)

        def explained() -> bool:
            """Whether nothing is found wrong; messages may be late for a while on a busy machine."""
            code, output = base.rmpa("why", "/told", timeout=LONG)
            return code == 0 and "/told of /told from warehouse/arm to site yard" in output

        eventually(explained, LONG, what="rmpa why leads to the other site, and finds nothing wrong")
        assert "/rmpa/warehouse/arm/told" in nodes(joined.base)
        spy.wait_event("up")
        output = does(base, "why", "warehouse/arm:/secret/word", status=1)
        assert "it stops at: rule there" in output
        assert "gateway.rule 1 (none: /secret/**)" in output
        assert "no gateway of a site moon" in does(base, "why", "moon/arm:/none", status=1)
    for site, other in ((joined.warehouse, "yard"), (joined.yard, "warehouse")):
        assert other in json.dumps(json.loads(does(site.gateway, "site", "list", "--json")))


def test_smart_resources_of_another_site_are_listed_and_set(joined: JoinedModules) -> None:
    arm, base = joined.arm.agent, joined.base.agent
    arm.kill()
    argv: list[str | Path] = [RMPA, "run", LAMP, "--name", arm.name]
    lamp = Process(joined.arm.host.command(argv), env=arm.env, name="lamp")
    try:
        lamp.wait_for("active on", LONG)

        def listed() -> dict[str, Any] | None:
            rows = json.loads(does(base, "resource", "list", "--json"))
            return next((row for row in rows if row["name"] == "/lamp" and row["state"] == "active"), None)

        row = eventually(listed, LONG, what="the lamp at base", every=0.5)
        assert row is not None
        assert (row["peer"], row["role"]) == ("warehouse/arm", "acting")
        assert "warehouse/arm:/lamp" in does(base, "resource", "list")
        assert "of module warehouse/arm" in does(base, "resource", "info", "warehouse/arm:/lamp")
        does(base, "profile", "set", "warehouse/arm:/lamp", "slow")
        assert does(base, "profile", "get", "warehouse/arm:/lamp").strip() == "slow"
    finally:
        lamp.end()
        print(lamp.output[-4000:])
        arm.restart()
        arm.wait_peer(joined.warehouse.gateway.name)
