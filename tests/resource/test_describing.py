"""``rmpa resource describe`` and ``check``: what a live node shows, and what does not fit it."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any, Final

import pytest

from rmpa.resource.checking import GraphCheck, Misfit
from rmpa.resource.describing import Flow, Found, Knob, LiveGraph, describe, look, started_by
from rmpa.resource.description import read_description
from rmpa.resource.node import ResourceNode
from rmpa.resource.resource import Resource
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.environment import NodeFacts
from rmpa.ros.node.node import Node

PATH: Final = Path("camera.resource.toml")
IMAGE, INFO, SCAN = "sensor_msgs/Image", "sensor_msgs/CameraInfo", "sensor_msgs/LaserScan"


def flow(rate: float, size: int) -> Flow:
    """What a second of messages leaves."""
    return Flow(count=int(rate) + 1, size=(int(rate) + 1) * size, first=1.0, last=1.0 + int(rate) / rate)


CAMERA: Final = Found(
    "/usb_cam",
    NodeFacts(
        "/usb_cam",
        publications={
            "/usb_cam/image_raw": IMAGE,
            "/usb_cam/camera_info": INFO,
            "/usb_cam/image_raw/compressed": "sensor_msgs/CompressedImage",
            "/usb_cam/parameter_updates": "dynamic_reconfigure/Config",
            "/rosout": "rosgraph_msgs/Log",
        },
    ),
    LiveGraph(
        flows={
            "/usb_cam/image_raw": {"/usb_cam": flow(30, 900_000)},
            "/usb_cam/camera_info": {"/usb_cam": flow(30, 400)},
        },
        knobs={
            "/usb_cam": {
                "frame_rate": Knob("frame_rate", "int", 30, 1, 60, description="pictures\na second"),
                "gain": Knob("gain", "double", 1.0, 0.0, 4.0),
                "mode": Knob("mode", "int", 1, choices={"Auto": 0, "Manual": 1}),
                "frame": Knob("frame", "str", 'a "cam"'),
            }
        },
        private={"/usb_cam": {"frame_rate": 30, "video_device": "/dev/video0", "calibration": {"a": 1}}},
        diagnostics={"usb_cam: Sensor": {"Temperature": "41.5", "State": "good"}, "other": {"Temperature": "9"}},
        status_of={"usb_cam: Sensor": "/usb_cam", "other": "/other"},
    ),
    server="/usb_cam",
    started={"run": "usb_cam usb_cam_node", "args": ("_video_device:=/dev/video0",)},
    seconds=3.0,
)


def test_a_camera_is_described_in_few_lines_and_the_rest_in_comments() -> None:
    text = describe(CAMERA)
    active = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert len(active) <= 40
    made = read_description(text.encode(), PATH)
    assert [made.name, made.role] == ["camera", "sensing"]
    assert list(made.outputs) == ["/usb_cam/image_raw", "/usb_cam/camera_info"]
    assert list(made.parameters["frame_rate"].bounds) == [1, 60]
    full, small = made.profiles.values()
    assert (full.sets, full.offers) == ({"frame_rate": 30}, {"rate": 30.0})
    assert (small.sets, small.offers, small.best_effort) == ({"frame_rate": 10}, {"rate": 10.0}, True)


def test_what_stands_in_comments_is_valid_too() -> None:
    text = describe(CAMERA)
    whole = "\n".join(
        line.removeprefix("# ") if line.startswith(("# [", *(f"# {key} = " for key in KEYS))) else line
        for line in text.splitlines()
    )
    made = read_description(whole.encode(), PATH)
    assert made.nodes["driver"].run == "usb_cam usb_cam_node"
    assert made.parameters["gain"].type == "double"
    assert made.parameters["mode"].choices == (0, 1)
    assert made.parameters["frame"].default == 'a "cam"'
    assert made.parameters["video_device"].binding is not None
    assert set(made.declared_attributes) == {"temperature", "load"}  # not that of another node


KEYS: Final = (
    "run", "args", "topic", "type", "dynamic", "private", "default", "low", "high", "choices", "value", "better"
)  # fmt: skip


@pytest.mark.parametrize(
    ("publishes", "subscribes", "role", "name"),
    [
        ({"/scan": SCAN}, {}, "sensing", "laser"),
        ({"/odom": "nav_msgs/Odometry"}, {"/cmd_vel": "geometry_msgs/Twist"}, "acting", "base"),
        ({"/cmd_vel": "geometry_msgs/Twist"}, {"/scan": SCAN}, "controlling", "pilot"),
        ({"/points": "sensor_msgs/PointCloud2"}, {"/scan": SCAN}, "controlling", "pilot"),
        ({}, {}, "sensing", "pilot"),
    ],
)
def test_role_and_name_are_guessed(
    publishes: dict[str, str], subscribes: dict[str, str], role: str, name: str
) -> None:
    facts = NodeFacts("/ns/pilot", publications=publishes, subscriptions=subscribes)
    text = describe(Found("/ns/pilot", facts, LiveGraph({}, {}, {}, {}, {})))
    made = read_description(text.encode(), PATH)
    assert [made.role, made.name] == [role, name]


def test_the_node_of_a_peer_is_described_by_its_own_name() -> None:
    facts = NodeFacts("/rmpa/arm/laser", publications={"/scan": SCAN})
    text = describe(Found("arm:/laser", facts, LiveGraph({}, {}, {}, {}, {})))
    assert '# It runs at the module arm.\n[node.driver]\nname = "/laser"' in text


def test_a_resource_is_not_named_as_its_node() -> None:
    facts = NodeFacts("/laser", publications={"/scan": SCAN})
    assert 'name = "laser_resource"' in describe(Found("/laser", facts, LiveGraph({}, {}, {}, {}, {})))


def test_a_process_tells_how_it_was_started() -> None:
    assert started_by(os.getpid())["command"]
    assert started_by(os.getpid())["command"][0].endswith(Path(sys.executable).name)
    assert started_by(0) == {}


async def test_a_live_node_is_looked_at(core: RosCore, node: Node) -> None:
    """A resource of ours stands for a driver: its dynamic_reconfigure is that of any server."""
    driver = Resource("driver", role="sensing")
    driver.parameter("rate", 20, low=1, high=50, description="how often")
    driver.parameter("colour", "red", choices=["red", "blue"])
    said = driver.output("said", "std_msgs/String")
    driver.profile(offers={}, name="only")(lambda: None)
    driver.task(rate=50, name="speak")(lambda: said.publish(data="hello"))
    one = ResourceNode(driver, core.uri)
    await one.learn()
    await one.start()
    try:
        seen = await look(
            node,
            topics=["/driver/said"],
            servers=["/driver", "/nothing"],
            owners=["/driver"],
            diagnostics=True,
            seconds=1.0,
        )
    finally:
        await one.close()
    assert 40 < seen.rate("/driver/said") < 60
    assert seen.rate("/driver/said", "/other") == 0
    knobs = seen.knobs["/driver"]
    assert knobs["rate"] == Knob("rate", "int", 20, 1, 50, {}, "how often")
    assert knobs["colour"].choices == {"red": "red", "blue": "blue"}
    assert "/nothing" not in seen.knobs
    assert seen.private["/driver"]["rate"] == 20
    assert seen.status_of["driver"] == "/driver"


HEAD: Final = 'role = "sensing"\n[node.driver]\nname = "/usb_cam"\n[output.image]\ntopic = "/usb_cam/image_raw"\n'
FITS: Final = HEAD + (
    'type = "sensor_msgs/Image"\n[parameter.fps]\ndynamic = "frame_rate"\ndefault = 30\nlow = 1\nhigh = 60\n'
    '[profile.full]\nset = { fps = 30 }\noffers = { rate = "30 Hz" }\n'
)


def check(text: str, **graph: Any) -> list[Misfit]:
    """What does not fit the camera above."""
    topics = {**CAMERA.facts.publications, "/battery": "sensor_msgs/BatteryState"} | graph.pop("topics", {})
    resource = read_description(text.encode(), PATH)
    known = {
        "publishers": {topic: ["/usb_cam"] for topic in topics},
        "types": topics,
        "running": ["/usb_cam", "/base"],
    }
    return GraphCheck(resource, text, PATH, seen=CAMERA.live, **(known | graph)).misfits()


def test_a_file_that_fits_has_no_misfit() -> None:
    assert check(FITS) == []


@pytest.mark.parametrize(
    ("right", "wrong", "words", "error"),
    [
        ('"/usb_cam"', '"/usb_cm"', "no node /usb_cm runs; did you mean /usb_cam?", True),
        ('name = "/usb_cam"', 'name = "/usb_cam"\nrun = "usb_cam usb_cam_nod"', "no such executable", True),
        ('name = "/usb_cam"', 'name = "/usb_cam"\ncommand = ["./no_such"]', "no program ./no_such", True),
        ("Image", "CompressedImage", 'is sensor_msgs/Image; write type = "sensor_msgs/Image"', True),
        ("image_raw", "image", "no node publishes /usb_cam/image; did you mean", True),
        ('"frame_rate"', '"framerate"', "no parameter framerate; did you mean frame_rate?", True),
        ("default = 30", "default = 30.0", "frame_rate is of type int, not double; write it like 30", True),
        ("high = 60", "high = 61", "61 is above what the node takes 1 to 60; high = 60", True),
        ("low = 1", "low = 0", "0 is below what the node takes 1 to 60; low = 1", True),
        ('"frame_rate"\ndefault = 30\nlow = 1\nhigh = 60', '"mode"\ndefault = 30', "it has 0 (Auto)", True),
        ('dynamic = "frame_rate"', 'private = "frame"\nrestart = false', "has no /usb_cam/frame", False),
        ('rate = "30 Hz"', 'rate = "60 Hz"', "/usb_cam/image_raw has 30 Hz now", False),
        ("[profile.full]", "[profile.full]\nneeds = '/batery/percentage > 1'", "did you mean /battery?", False),
        ("[profile.full]", "[profile.full]\nneeds = '/battery/percent > 1'", "which has no percent; it has", False),
        ("[profile.full]", "[ask.sonar]\nrate = '>= 1 Hz'\n[profile.full]", "there is no resource /sonar", False),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_told_with_its_line(right: str, wrong: str, words: str, error: bool) -> None:
    text = FITS.replace(right, wrong, 1)
    assert text != FITS
    found = check(text)
    told = [one for one in found if words in f"{one.problem}; {one.remedy}"]
    assert told, found
    begin = FITS[: FITS.index(right)].count("\n") + 1
    assert begin <= told[0].line <= begin + wrong.count("\n")
    assert told[0].error is error


def test_diagnostics_that_no_node_says_are_told() -> None:
    def heat(arguments: str) -> list[str]:
        attribute = f'[attribute.heat]\nvalue = "diagnostics({arguments})"\nbetter = "min"\n'
        return [one.remedy for one in check(FITS + attribute)]

    assert heat("'usb_cam: Sensor', 'Temperature'") == []
    assert heat("'usb_cam: Sensors', 'Temperature'") == ["did you mean usb_cam: Sensor?"]
    assert heat("'usb_cam: Sensor', 'Temp'") == ["it has 'Temperature', 'State'"]


def test_an_argument_that_the_launch_file_does_not_have_is_told(tmp_path: Path) -> None:
    (tmp_path / "cam.launch").write_text('<launch><arg name="fps" default="30"/></launch>')
    text = FITS.replace('dynamic = "frame_rate"', 'arg = "frames"').replace(
        'name = "/usb_cam"', 'name = "/usb_cam"\nlaunch = "cam.launch"'
    )
    resource = read_description(text.encode(), PATH)
    parts: Any = ({"/usb_cam/image_raw": ["/usb_cam"]}, {}, ["/usb_cam"], CAMERA.live)
    (found,) = GraphCheck(resource, text, tmp_path / "x.toml", *parts).misfits()
    assert "has no argument frames" in found.problem
