"""Two sites behind NAT, each a secured mesh, by a router with mTLS: what crosses, what is kept back, and intruders.

The router's machine is the authority; modules and gateways of both sites join by ``rmpa trust``, as in
docs/guides/sites.md. All tests share one set of processes; each leaves it as it was.
"""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any, Final

import pytest

from lab.bed.gateways import command
from lab.bed.processes import Process, eventually
from tests.interop.modules import flows, whole
from tests.interop.sites import JoinedModules, joined_modules, nodes

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.bed.agents import Agent

pytest.importorskip("zenoh", reason="the extra rmpa[zenoh] is not installed")
pytestmark = [pytest.mark.ros, pytest.mark.nat, pytest.mark.timeout(180)]

LONG: Final = 40.0
_AT_HOME: Final = """
[trust]
relays = ["{gateway}"]

[[permission]]                          # among each other
modules = ["{module}", "{gateway}"]
publish = ["/**"]
subscribe = ["/**"]
call = ["/**"]
serve = ["/**"]
param = ["/**"]

[params]
remote_set = ["/**"]
"""
WAREHOUSE: Final = (
    _AT_HOME.format(module="arm", gateway="warehouse_gateway")
    + """
[[permission]]
modules = ["yard"]
subscribe = ["/**"]
call = ["/work"]

[[permission]]
modules = ["yard"]
effect = "deny"
subscribe = ["/secret"]
"""
)
YARD: Final = (
    _AT_HOME.format(module="base", gateway="yard_gateway")
    + """
[[permission]]
modules = ["warehouse"]
publish = ["/**"]
serve = ["/**"]
"""
)
CLIENT: Final = """
import sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", '["' + sys.argv[1] + '"]')
if sys.argv[2:]:
    config.insert_json5("transport/link/tls/root_ca_certificate", '"' + sys.argv[2] + '"')
try:
    zenoh.open(config).close()
except zenoh.ZError:
    sys.exit(3)
"""


# A member's program that hears all that it can: it says each new key, of messages and of announcements.
SPY: Final = """
import sys, json, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
tls = {"root_ca_certificate": "ca.crt", "connect_certificate": "module.crt", "connect_private_key": "module.key"}
for key, name in tls.items():
    config.insert_json5("transport/link/tls/" + key, json.dumps(sys.argv[2] + "/" + name))
config.insert_json5("transport/link/tls/enable_mtls", "true")
config.insert_json5("transport/link/tls/verify_name_on_connect", "false")
session, seen = zenoh.open(config), set()
def heard(sample):
    key = str(sample.key_expr)
    if key not in seen:
        seen.add(key)
        print("@", json.dumps({"event": "heard", "key": key}), flush=True)
ears = [session.declare_subscriber("rmpa/1/**", heard)]
ears += [session.liveliness().declare_subscriber("rmpa/1/**", heard, history=True)]
time.sleep(1000)
"""


@pytest.fixture(scope="module")
def joined(tmp_path_factory: pytest.TempPathFactory) -> Iterator[JoinedModules]:
    """Both sites with their modules, gateways and shells."""
    with joined_modules(
        tmp_path_factory.mktemp("secured"), secured={"fleet": "", "warehouse": WAREHOUSE, "yard": YARD}
    ) as made:
        yield made


def sites(agent: Agent) -> dict[str, dict[str, Any]]:
    """What ``rmpa site list`` says of each other site there."""
    lines = agent.rmpa("site", "list", "--json")[1].splitlines()
    reports: list[Any] = next((json.loads(line) for line in lines if line.startswith("[")), [])
    return {str(row["name"]): row for report in reports for row in report["sites"]}


def wait_state(agent: Agent, site: str, state: str) -> None:
    what = f"{site} {state} at {agent.name}"
    eventually(lambda: sites(agent).get(site, {}).get("state") == state, LONG, what=what, every=0.3)


def test_topics_and_a_service_cross(joined: JoinedModules) -> None:
    arm, base = joined.arm, joined.base
    with (
        base.ros.node("rospy", "listener", topic="/out", count=100) as listener,
        arm.ros.node("roscpp", "talker", "__name:=talker", topic="/out", rate=100, count=100, size=3000, wait=1),
    ):
        whole(listener.wait_event("done", LONG), 100)
        assert "/rmpa/warehouse/arm/talker" in nodes(base)
    with (
        arm.ros.rospy("worker", service="/work", name="worker") as worker,
        base.ros.rospy("caller", service="/work", wait=True, commands=True) as caller,
    ):
        worker.wait_event("up")
        caller.wait_event("there", LONG)
        since = caller.mark_events()
        caller.tell("echo 0 20000 5 once")
        done = caller.wait_event("done", LONG, since=since)
        assert (done["ok"], done["same"], done["errors"]) == (5, 5, []), done


def test_what_a_permission_of_the_site_denies_stays_there_and_why_says_so(joined: JoinedModules) -> None:
    arm, base = joined.arm, joined.base
    with (
        arm.ros.roscpp("talker", "__name:=spy", topic="/secret", rate=50),
        arm.ros.roscpp("talker", "__name:=open", topic="/open", rate=50),
        base.ros.roscpp("listener", topic="/secret") as secret,
        base.ros.roscpp("listener", topic="/open") as open_,
    ):
        flows(open_, 100, LONG)
        assert all(report["count"] == 0 for report in secret.events("report"))
        _, output = base.agent.rmpa("why", "warehouse:/secret", timeout=LONG)
        assert "it stops at: permission there" in output, output
        assert "change [[permission]]" in output, output
        code, output = base.agent.rmpa("why", "warehouse:/open", timeout=LONG)
        assert (code, "it flows" in output) == (0, True), output
        counters = joined.warehouse.gateway.snapshot().counters
        assert counters.get("permission.subscribe", 0) > 0, counters


def test_a_members_program_at_the_router_hears_nothing_that_no_site_may_have(joined: JoinedModules) -> None:
    place = joined.warehouse.gateway
    words = [joined.net.endpoint, str(place.home / "state" / place.host.name / place.name / "trust")]
    with (
        joined.arm.ros.roscpp("talker", "__name:=spied", topic="/secret", rate=50),
        joined.arm.ros.roscpp("talker", "__name:=told", topic="/told", rate=50),
        Process(joined.arm.host.command([sys.executable, "-u", "-c", SPY, *words]), name="spy") as spy,
    ):
        keys: set[str] = set()

        def hears(topic: str) -> bool:
            keys.update(str(event["key"]) for event in spy.events("heard"))
            return any(key.endswith(f"/to/yard/t/std_msgs%UInt8MultiArray{topic}") for key in keys)

        eventually(
            lambda: "/secret" in place.rmpa("topic", "list")[1], LONG, what="the topic at the gateway", every=0.3
        )
        eventually(lambda: hears("/told"), LONG, what="what the yard may have", every=0.2)
        assert not any("secret" in key for key in keys), keys


@pytest.mark.parametrize("how", ["plain", "tls", "tls and the CA"])
def test_a_program_without_a_certificate_gets_no_session(joined: JoinedModules, how: str) -> None:
    endpoint = joined.net.endpoint
    words = [endpoint.replace("tls/", "tcp/") if how == "plain" else endpoint]
    if how == "tls and the CA":
        words.append(str(joined.net.router.home / "state" / "fleet" / "fleet" / "trust" / "ca.crt"))
    with Process(joined.arm.host.command([sys.executable, "-c", CLIENT, *words]), name="client") as client:
        assert client.wait(LONG) == 3, client.output


def test_a_gateway_with_a_certificate_of_another_mesh_is_refused_and_told(joined: JoinedModules) -> None:
    eve = joined.net.gateway_of("eve", joined.yard.network, "eve_gateway")
    command(eve, "trust", "init", "--name", eve.name)
    eve.start()
    eve.wait_ready()
    told = "certificates of the same mesh"
    eventually(lambda: told in eve.process.output, LONG, what="the refusal in the log", every=0.3)
    assert told in eve.rmpa("site", "list")[1]
    assert "eve" not in sites(joined.warehouse.gateway)
    eve.terminate()


def test_a_revoked_gateway_is_out_at_once_and_does_not_come_back(joined: JoinedModules) -> None:
    """The router opens its session anew with another table of access; the other sites are back by themselves."""
    stolen = joined.net.gateway_of("stolen", joined.yard.network, "stolen_gateway", YARD)
    joined.net.join(stolen)
    stolen.start()
    stolen.wait_ready()
    watcher = joined.warehouse.gateway
    wait_state(watcher, "stolen", "joined")
    wait_state(stolen, "warehouse", "joined")
    with (
        joined.base.ros.roscpp("listener", topic="/after") as listener,
        joined.arm.ros.roscpp("talker", "__name:=after", topic="/after", rate=50),
    ):
        flows(listener, 20, LONG)
        command(joined.net.router, "trust", "revoke", "stolen_gateway", "--name", "fleet")
        wait_state(watcher, "stolen", "unreachable")
        wait_state(stolen, "warehouse", "unreachable")
        flows(listener, 20, LONG)
        stolen.terminate()
        stolen.restart()
        wait_state(watcher, "yard", "joined")
        assert sites(watcher)["stolen"]["state"] == "unreachable"
        assert "warehouse" not in sites(stolen)
    stolen.terminate()
