"""A camera that is described by a file, for the scene ``wrapped``: what it says, its start, and its processes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

from rmpa.core.errors import ConfigError
from rmpa.resource.description import read_description, resource_schema
from rmpa.web.monitor.descriptions import Descriptions, help_of
from rmpa.web.monitor.resources import ResourceFacts

FILE: Final = "camera.resource.toml"
EXAMPLE: Final = Path(__file__).parents[3] / "examples/resources" / FILE
_UNITS: Final = {"rate": "Hz", "latency": "s", "bandwidth": "B/s"}
# What happened so many seconds ago: from, to, why, took.
_PAST: Final = (
    (540, "", "full", "the resource starts", 1.2),
    (410, "full", "small", "disturbance: latency 0.31 s instead of at most 0.2 s", 0.21),
    (290, "small", "full", "full offers more than small, and its cool-down is over", 0.34),
    (150, "full", "compressed", "disturbance: latency 0.42 s instead of at most 0.2 s", 0.46),
    (60, "compressed", "full", "full offers more than compressed, and its cool-down is over", 0.4),
)


def _rate(at: float) -> float:
    return 28.0 + 1.5 * math.sin(at / 17) + 0.4 * math.sin(at * 2) - (13.0 if at % 170 > 155 else 0.0)


def _latency(at: float) -> float:
    return 0.12 + 0.05 * math.sin(at / 11)


def past(started: float) -> dict[str, Any]:
    """The numbers of its status on ``/diagnostics`` before the page was open: a window each second."""
    moments = [started - 540 + number for number in range(540)]
    return {"": moments, "rate": [*map(_rate, moments)], "latency": [*map(_latency, moments)]}


def _offers() -> dict[str, dict[str, float]]:
    return {
        "full": {"rate": 30.0, "latency": 0.1},
        "compressed": {"rate": 30.0, "latency": 0.15},
        "small": {"rate": 10.0, "latency": 0.05},
    }


def camera(started: float, now: float) -> ResourceFacts:
    """The camera at a moment; it began 540 s before ``started``."""
    offers = _offers()
    profiles: list[dict[str, Any]] = [
        {"name": name, "offers": one, "cost": cost, "sets": sets, "nodes": nodes, "description": text}
        for (name, one), cost, sets, nodes, text in zip(
            offers.items(),
            (4.0, 2.0, 1.0),
            ({"fps": 30}, {"fps": 30}, {"fps": 10}),
            ([], ["republish"], []),
            ("As fast as it can.", "By image_transport.", "For a thin line."),
            strict=True,
        )
    ]
    history = [
        {"at": started - ago, "from": before, "to": after, "why": why, "took": took}
        for ago, before, after, why, took in _PAST
    ]
    failed = {"at": started - 220, "from": "full", "to": "compressed", "why": "asked by /tracker", "took": 5.0}
    history.insert(3, failed | {"failed": "node /republish: it does not come up"})
    wanted = {"rate": "at least 20 Hz", "latency": "at most 0.2 s"}
    scores = [
        {
            "profile": name,
            "distance": 0.004 if name == "full" else 0.41,
            "hard_shortfall": 0.0 if name != "small" else 0.5,
            "excluded": "cool-down for 12 s" if name == "compressed" else "",
            "feasible": name == "full",
            "terms": [
                {
                    "attribute": key,
                    "wanted": text,
                    "offered": one[key],
                    "delta": 0.0,
                    "weight": 1.0,
                    "hard": key == "rate",
                }
                for key, text in wanted.items()
            ],
        }
        for name, one in offers.items()
    ]
    learnt = {
        "full": {
            "rate": {"median": 28.7, "spread": 1.1, "n": 312},
            "latency": {"median": 0.12, "spread": 0.03, "n": 312},
        }
    }
    now = math.floor(now)  # a window each second
    rate = _rate(now)
    values = {"rate": f"{rate:.4g} Hz", "latency": f"{_latency(now):.3g} s", "level_for": "12.0 s"}
    attributes = [
        {"name": name, "better": "max" if name == "rate" else "min", "unit": unit, "category": "temporal"}
        for name, unit in _UNITS.items()
    ]
    return ResourceFacts(
        name="/camera",
        state="active",
        profile="full",
        health={"name": "camera", "level": "OK", "message": "profile full", "values": values},
        parameters={"fps": 24},
        clients=({"name": "/tracker", "level": "OK" if rate >= 20 else "WARN", "message": "profile full",
                  "values": {"rate": f"wanted at least 20 Hz, given {rate:.4g} Hz"}},),
        descriptor={
            "name": "camera", "node": "/camera", "role": "sensing", "physical": True, "file": FILE,
            "description": "the camera in front, by usb_cam",
            "attributes": attributes, "profiles": profiles,
            "outputs": [{"name": "image", "topic": "/usb_cam/image_raw", "type": "sensor_msgs/Image"}],
            "parameters": [{"name": "fps", "type": "int", "default": 30, "low": 1, "high": 60, "unit": "Hz",
                            "description": "profiles set it", "binding": "driver dynamic frame_rate"}],
            "nodes": [
                {"key": "driver", "name": "/usb_cam", "how": "run usb_cam usb_cam_node"},
                {"key": "republish", "name": "/republish", "how": "run image_transport republish"},
            ],
        },
        decision={
            "profile": "full", "applying": "", "chosen": "", "reaction": 0.4, "alarm": "", "conflicts": [],
            "clients": ["/tracker"], "scores": scores, "history": history, "by_hand": {"fps": 24}, "learnt": learnt,
        },
    )  # fmt: skip


def launches(started: float, now: float) -> list[dict[str, Any]]:
    """What the agents of the modules can start."""
    driver = {"node": "/usb_cam", "pid": 4711, "cpu": 0.31 + 0.02 * math.sin(now), "rss": 84_000_000, "restarts": 1,
              "since": started - 300, "state": "running", "own": True}  # fmt: skip
    own = [
        {"name": "camera", "file": FILE, "state": "active", "pid": 4700, "since": started - 540, "restarts": 0,
         "processes": [driver]},
        {"name": "laser", "file": "laser.resource.toml", "state": "failed", "restarts": 3, "since": started - 20,
         "why": "node /laser ended with 1: cannot open /dev/ttyUSB0", "processes": []},
    ]  # fmt: skip
    base = [{"name": "base", "file": "base.resource.toml", "state": "stopped", "processes": []}]
    return [
        {"module": "pc", "resources": own},
        {"module": "base", "resources": base},
        {
            "module": "joystick",
            "problem": "its agent is of an earlier release, which starts nothing",
            "resources": [],
        },
    ]


def top(started: float, now: float) -> dict[str, Any]:
    """The processes of the nodes of all modules."""

    def one(node: str, pid: int, cpu: float, rss: float, by: str) -> dict[str, Any]:
        about = {"node": node, "pid": pid, "cpu": cpu, "rss": int(rss * 1e6), "threads": 4}
        return about | {"since": started - pid / 10, "started_by": by}

    cpu = 0.31 + 0.02 * math.sin(now)
    own = [one("/usb_cam", 4711, cpu, 84, "camera"), one("/tracker", 3100, 0.62, 210, "")]
    base = [one("/base", 990, 0.08, 41, ""), one("/laser_filter", 1020, 0.11, 37, "laser")]
    base.append({"node": "/far", "pid": None, "cpu": 0.0, "rss": 0, "threads": 0, "since": 0.0, "started_by": ""})
    return {"pc": own, "base": base, "joystick": "its agent is of an earlier release, which does not tell it"}


def check(path: Path) -> list[dict[str, Any]]:
    """What ``rmpa resource check --offline --json`` says of a file."""
    try:
        read_description(path.read_bytes(), path)
    except ConfigError as error:
        return [{"line": error.line, "problem": f"{error.source}: {error.problem}", "remedy": error.remedy}]
    return []


class CheckedHere(Descriptions):
    """The files of a folder, checked in this process.

    Args:
        folder: The folder, which gets the example's file.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(str(folder), check)
        self._help = help_of(resource_schema())
        (folder / FILE).write_bytes(EXAMPLE.read_bytes())
