"""``rmpa resource``, ``profile``, ``context`` and ``alarm`` against a resource of this module and one of a peer."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from rmpa.core.errors import ConfigError
from rmpa.resource.actuation import read_config
from rmpa.resource.client import ResourceClient
from rmpa.resource.node import ResourceNode
from rmpa.resource.quality import at_least, at_most
from rmpa.resource.resource import Resource
from rmpa.resource.runtime import describe
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from tests.cli.conftest import Background, Rmpa
from tests.resource.driver import Driver
from tests.resource.test_actuation import camera
from tests.resource.test_node import echo

GROUP = ()
ARRAY = "diagnostic_msgs/DiagnosticArray"


def sonar() -> Resource:
    one = Resource("sonar", role="sensing", physical=False, description="three rings\x1b[2J")
    one.output("ranges", "sensor_msgs/Range", deadline="100 ms")
    one.adaptation(window=0.2)
    one.parameter("gain", 1.0, low=0.5, unit="dB", description="of the amplifier")
    one.parameter("beam", "wide", choices=("wide", "narrow"))
    pace = one.parameter("pace", 2.0, low=0.5, high=9)
    one.task(rate=pace, name="measure")(lambda: None)
    one.task(rate="0.1 Hz", name="clean")(lambda: None)
    one.attribute("accuracy", better="min", unit="m")
    one.profile(offers={"rate": 10, "accuracy": "5 cm"}, cost=1, name="slow", description="cheap")(lambda: None)
    one.profile(offers={"rate": 40, "accuracy": "1 cm"}, cost=3, name="fast")(lambda: None)

    @one.profile(offers={"rate": 40, "accuracy": "1 cm"}, cost=9, best_effort=True)
    def broken() -> None:
        raise OSError("no such device")

    one.asks("eye", priority=3)
    one.context("docked", when="/battery.charging and ~gain > 3")
    one.context("away", requires={"rate": at_least("20 Hz")}, profiles=["fast"])
    return one


@pytest.fixture
def run(core: RosCore, background: Background) -> Iterator[Callable[[Resource], ResourceNode]]:
    """Runs resources of this module."""
    made: list[ResourceNode] = []

    def start(resource: Resource) -> ResourceNode:
        made.append(ResourceNode(resource, core.uri))
        background.do(made[-1].start())
        return made[-1]

    yield start
    for each in reversed(made):
        background.do(each.close())


@pytest.fixture
def running(run: Callable[[Resource], ResourceNode]) -> ResourceNode:
    """The resource of this module."""
    return run(sonar())


@pytest.fixture
def remote(node: Callable[..., Node], background: Background) -> list[dict[str, Any]]:
    """What a bridge would show of peer base: another sonar (its services hidden by ours), and a lidar."""
    asked: list[dict[str, Any]] = []

    def configured(request: Any) -> dict[str, Any]:
        asked.append(read_config(request.config))
        if asked[-1].get("profile") == "fast":
            raise ConfigError("profile fast", "it could not be applied: jammed")
        return {}

    def latched(one: Node, topic: str, text: str) -> None:
        publisher = background.do(one.advertise(topic, "std_msgs/String", latch=True))
        background.call(publisher.publish, publisher.make({"data": text}))

    proxies = {name: node(f"/rmpa/base/{name}") for name in ("sonar", "lidar")}
    for name, proxy in proxies.items():
        decision = {"profile": "fast", "chosen": "", "scores": []}
        latched(proxy, f"/{name}/descriptor", describe(sonar(), f"/{name}").serialize())
        for topic, text in (("state", "active"), ("profile", "fast"), ("context", "away")):
            latched(proxy, f"/{name}/{topic}", text)
        latched(proxy, f"/{name}/decision", json.dumps(decision))
    lidar = proxies["lidar"]
    background.do(lidar.advertise_service("/lidar/set_parameters", "dynamic_reconfigure/Reconfigure", configured))
    latched(lidar, "/strange/descriptor", "{}")
    return asked


def as_json(rmpa: Rmpa, *words: str) -> Any:
    code, out, err = rmpa(*words, "--json")
    assert code == 0, err
    return json.loads(out)


def rows(rmpa: Rmpa, *words: str) -> list[list[str]]:
    """A table's rows, each with its first three cells."""
    code, out, err = rmpa(*words)
    assert code == 0, err
    return [line.split()[:3] for line in out.splitlines()]


def test_resources_here_and_at_peers(rmpa: Rmpa, running: ResourceNode, remote: object) -> None:
    assert "\x1b" not in rmpa("resource", "list")[1]
    assert (
        "2 modules have a resource /sonar: a request to that name reaches all of them" in rmpa("resource", "list")[2]
    )
    listed = as_json(rmpa, "resource", "list")
    assert [(one["name"], one["peer"], one["profile"], one["context"]) for one in listed] == [
        ("/sonar", None, "slow", ""), ("/lidar", "base", "fast", "away"), ("/sonar", "base", "fast", "away"),
    ]  # fmt: skip
    # One that is named without its peer is this module's, if there is one; else whose it is is known.
    for name, peer in (("sonar", None), ("base:/sonar", "base"), ("/lidar", "base")):
        assert as_json(rmpa, "profile", "get", name)["peer"] == peer
    assert rmpa("profile", "get") == (0, "slow\n", "")
    assert rmpa("resource", "info", "sonra")[2] == "rmpa: no resource /sonra; did you mean /sonar? [unknown-name]\n"
    assert rmpa("resource", "info", "other:/sonar")[0] == 1
    assert rmpa("resource", "info", "a b")[0] == 2


def test_all_of_a_resource(rmpa: Rmpa, running: ResourceNode) -> None:
    about = as_json(rmpa, "resource", "info", "sonar")
    assert about["parameters"] == {"gain": 1.0, "beam": "wide", "pace": 2.0, "profile": "", "context": ""}
    assert about["health"]["values"]["profile"] == "slow"
    assert about["descriptor"]["profiles"][1]["name"] == "fast"
    running.resource.demands["/eye"].ask(blur=at_most("2 px", hard=True), sight__rate=at_least("5 Hz"))
    wishes = {"blur": "<= 2 px hard", "sight.rate": ">= 5 Hz"}
    deadline = time.monotonic() + 30
    while as_json(rmpa, "resource", "info", "sonar")["descriptor"]["asks"][0]["wishes"] != wishes:
        assert time.monotonic() < deadline
    text = " ".join(rmpa("resource", "info")[1].split())
    assert "ASKS OF FOR PRIORITY /eye blur <= 2 px hard; sight.rate >= 5 Hz 3" in text


def test_a_profile_by_hand(rmpa: Rmpa, running: ResourceNode, remote: list[dict[str, Any]]) -> None:
    assert as_json(rmpa, "profile", "set", "sonar", "fast") == {"resource": "/sonar", "peer": None, "chosen": "fast"}
    assert rmpa("profile", "set", "sonar", "fast") == (0, "", "")
    assert ["fast", "runs,", "by"] in rows(rmpa, "profile", "explain", "sonar")
    assert running.adapter.adaptation.profile == "fast"
    assert rows(rmpa, "profile", "list", "sonar")[2] == ["fast", "runs,", "by"]
    code, out, err = rmpa("profile", "set", "sonar", "broken")
    assert (code, out) == (1, "")
    assert err == (
        "rmpa: /sonar: profile broken: it could not be applied: OSError: no such device; "
        "what was chosen before stays [service-failed]\n"
    )
    assert as_json(rmpa, "profile", "get", "sonar")["chosen"] == "fast"
    assert as_json(rmpa, "profile", "list", "sonar")["left_out"] == {"broken": "OSError: no such device"}
    assert rmpa("profile", "set", "sonar", "fsat") == (
        2, "", "rmpa: PROFILE: there is no profile 'fsat'; did you mean fast? [invalid-value]\n"
    )  # fmt: skip
    assert rmpa("profile", "set", "sonar")[0] == rmpa("profile", "set", "sonar", "fast", "--auto")[0] == 2
    assert rmpa("profile", "set", "sonar", "--auto")[0] == 0
    assert rmpa("profile", "get", "sonar")[1] == "slow\n"
    # A peer's is set at the peer; one whose services ours hide cannot be.
    assert rmpa("profile", "set", "base:/lidar", "slow")[0] == 0
    assert rmpa("profile", "set", "lidar", "fast")[2] == (
        "rmpa: base:/lidar: profile fast: it could not be applied: jammed [service-failed]\n"
    )
    assert remote == [{"profile": "slow"}, {"profile": "fast"}]
    code, _, err = rmpa("profile", "set", "base:/sonar", "slow")
    assert code == 1
    assert "/sonar/set_parameters is served by /sonar, not by peer base" in err


async def ask(driver: Node, member: ResourceNode | None = None, **wishes: Any) -> None:
    """Ask the sonar for qualities; with ``member`` until it has decided."""
    client = await ResourceClient(driver, "sonar").__aenter__()
    await client.require(**wishes)
    if member is not None:
        await member.adapter.settled()


def test_a_decision_is_explained(
    rmpa: Rmpa, run: Callable[[Resource], ResourceNode], node: Callable[..., Node], background: Background
) -> None:
    one = sonar()
    one.adaptation(window=60)  # nothing is measured meanwhile
    wishes = {"rate": at_least("20 Hz", hard=True), "accuracy": at_most("2 cm", weight=2)}
    background.do(ask(node("/driver"), run(one), **wishes))
    code, out, _ = rmpa("profile", "explain", "sonar")
    assert code == 0
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert lines[:2] == ["/sonar: profile fast", "asked by /driver"]
    assert any(line.startswith("slow falls short") and line.endswith("10 Hz 0.5 1") for line in lines), out
    assert any(line.startswith("fast runs") and "rate at least 20 Hz hard 40 Hz 0 1" in line for line in lines), out
    assert any(line == "accuracy at most 0.02 m 0.01 m 0 2" for line in lines), out
    scores = {score["profile"]: score for score in as_json(rmpa, "profile", "explain")["scores"]}
    assert scores["slow"]["feasible"] is False
    assert scores["slow"]["terms"][0]["delta"] == pytest.approx(0.5)


def test_what_people_set_at_a_node_and_what_was_learnt_is_shown(
    rmpa: Rmpa, run: Callable[[Resource], ResourceNode], node: Callable[..., Node], background: Background
) -> None:
    cam = Driver(node("/cam"), {"frame_rate": 25.0, "gain": 1.0})
    background.do(cam.start())
    one = run(camera())
    background.call(one.adapter.learnt.window, "small", {"sharpness": 3.0})
    background.do(one.configuration.set({"gain": 2.5}))
    background.do(one.configuration.set({"fps": 12, "profile": "full"}))
    explained = [" ".join(line.split()) for line in rmpa("profile", "explain", "camera")[1].splitlines()]
    assert "by hand: gain = 2.5, fps = 12; `rmpa profile set /camera --auto` gives it back" in explained
    assert explained[-2].split()[1:] == ["-", "small", *explained[-2].split()[3:]]
    assert explained[-2].endswith("s the resource starts")
    assert explained[-1].split()[1:3] == ["small", "full"]
    assert explained[-1].endswith("s full was chosen by hand")
    listed = as_json(rmpa, "profile", "list", "camera")
    assert listed["by_hand"] == {"gain": 2.5, "fps": 12}
    assert listed["learnt"]["small"]["sharpness"] == {"median": 3.0, "spread": 0.0, "n": 1}
    assert "sharpness 3 (spread 0, n 1)" in rmpa("profile", "list", "camera")[1]
    info = [" ".join(line.split()) for line in rmpa("resource", "info", "camera")[1].splitlines()]
    assert "fps 12 by hand 1 .. 60 [cam dynamic frame_rate]" in info
    assert "cam /cam attached" in info
    assert rmpa("profile", "set", "camera", "--auto")[0] == 0
    assert as_json(rmpa, "profile", "list", "camera")["by_hand"] == {}


def test_a_context_by_hand(rmpa: Rmpa, running: ResourceNode) -> None:
    assert rmpa("context", "get") == (0, "\n", "")
    assert as_json(rmpa, "context", "set", "sonar", "away")["chosen"] == "away"
    assert rmpa("context", "set", "sonar", "away") == (0, "", "")
    assert running.adapter.adaptation.profile == "fast"
    assert rmpa("context", "get", "sonar") == (0, "away\n", "")
    code, _, err = rmpa("context", "set", "sonar", "awya")
    assert (code, err) == (2, "rmpa: CONTEXT: there is no context 'awya'; did you mean away? [invalid-value]\n")
    assert rmpa("context", "set", "sonar", "--auto")[0] == 0
    assert as_json(rmpa, "context", "get")["context"] == ""


def test_alarms(
    rmpa: Rmpa,
    running: ResourceNode,
    run: Callable[[Resource], ResourceNode],
    node: Callable[..., Node],
    background: Background,
) -> None:
    assert rmpa("alarm", "list")[1].split() == ["RESOURCE", "LEVEL", "MESSAGE"]
    assert rows(rmpa, "alarm", "list", "--all")[1] == ["/sonar", "OK", "profile"]
    driver = node("/driver")

    def when_heard() -> None:
        """From a thread: the command runs in the main one."""
        deadline = time.monotonic() + 30
        while not running.adapter.publishers["alarms"].subscribers and time.monotonic() < deadline:
            time.sleep(0.02)
        background.do(ask(driver, accuracy=at_most("1 mm", hard=True)))

    asking = threading.Thread(target=when_heard)
    asking.start()
    code, out, _ = rmpa("alarm", "echo", "sonar", "-n", "1", "--json")
    asking.join()
    assert code == 0
    alarm = json.loads(out)
    assert (alarm["resource"], alarm["level"]) == ("/sonar", "ERROR")
    assert alarm["message"].startswith("non-adaptable: no profile gives accuracy as asked")
    run(echo())
    table = rows(rmpa, "alarm", "list", "-a")
    assert table[1] in (["/echo", "STALE", "no"], ["/echo", "STALE", "it"])
    assert table[2:] == [["/sonar", "ERROR", "non-adaptable:"]]


def test_no_resource(rmpa: Rmpa, core: RosCore) -> None:
    assert as_json(rmpa, "resource", "list") == []
    text = "rmpa: there is no resource; `rmpa run` runs one, `rmpa resource list` shows all [unknown-name]\n"
    assert rmpa("profile", "list") == (1, "", text)
