"""``rmpa_ros``: Smart Resources from nodes of rospy and roscpp that have nothing of RMPA but one file."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Final

import pytest

from lab.bed.agents import RMPA
from lab.bed.processes import Process
from lab.bed.ros import CLIENT_HEADERS
from tests.interop.conftest import ShellFactory
from tests.interop.ros import Ros

RESOURCES: Final = Path(__file__).parent / "resources"
LIBRARY: Final = CLIENT_HEADERS.parent / "src/rmpa_ros/__init__.py"
OK, WARN, ERROR, STALE = range(4)
LONG: Final = 40.0


def test_the_file_for_rospy_is_one_of_python_3_6() -> None:
    ast.parse(LIBRARY.read_text(), feature_version=(3, 6))


@pytest.fixture
def ros(shell: ShellFactory) -> Ros:
    """A shell with a master."""
    made = shell()
    made.master()
    return made


def run_resource(ros: Ros, file: str) -> Process:
    argv: list[str | Path] = [RMPA, "run", RESOURCES / file, "--master", ros.uri, "--no-state"]
    process = ros.start(*argv)
    process.wait_for("active on", LONG)
    return process


def client(ros: Ros, library: str, **options: str) -> Process:
    made = ros.rospy if library == "rospy" else ros.roscpp
    node = made("resource_client", **options)  # type: ignore[arg-type] # of the node
    node.wait_event("up")
    return node


@pytest.mark.ros
@pytest.mark.timeout(150)
@pytest.mark.parametrize("library", ["rospy", pytest.param("roscpp", marks=pytest.mark.long)])
def test_a_node_asks_and_hears_of_responses_profiles_and_alarms(ros: Ros, library: str) -> None:
    run_resource(ros, "camera.py")
    commands = {"commands": True} if library == "rospy" else {"rate": ">= 10 Hz hard"}
    node = client(ros, library, **commands)
    if library == "rospy":
        node.tell(json.dumps({"rate": ">= 10 Hz hard"}))
    node.wait_event("profile", LONG, where=lambda e: e["name"] == "small")
    given = re.compile(r"wanted at least 10 Hz, given [\d.]+ Hz")
    node.wait_event("response", LONG, where=lambda e: e["level"] == OK and given.search(str(e["values"])) is not None)
    if library == "roscpp":
        return
    mark = node.mark_events()
    node.tell(json.dumps({"rate": ">= 500 Hz hard"}))
    node.wait_event("alarm", LONG, where=lambda e: e["level"] == ERROR, since=mark)
    node.tell(json.dumps({"rate": "ten"}))
    node.wait_event("response", LONG, where=lambda e: "is no bound" in str(e["message"]), since=mark)
    node.tell(json.dumps({}))
    node.wait_event("alarm", LONG, where=lambda e: e["level"] == OK, since=mark)


@pytest.mark.ros
@pytest.mark.timeout(150)
@pytest.mark.parametrize("library", [pytest.param("rospy", marks=pytest.mark.long), "roscpp"])
def test_a_node_of_the_resource_says_an_attribute_and_others_cannot(ros: Ros, library: str) -> None:
    resource = run_resource(ros, "wrapped.resource.toml")
    node = client(ros, library, name="driver", say="temperature", value="54.5")
    quality = ros.start("rostopic", "echo", "/camera/quality")
    quality.wait_for("54.5", LONG)
    node.end()
    client(ros, library, name="stranger", say="temperature", value="20")
    resource.wait_for("/stranger: attributes: it is no node of this resource", LONG)
