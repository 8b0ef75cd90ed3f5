"""Resources described in TOML: a file says what ``rmpa.resource`` would be told, and each mistake has its line."""

from __future__ import annotations

import json
import random
import re
from pathlib import Path
from typing import Final

import pytest
from click.testing import CliRunner

from rmpa.cli.main import cli
from rmpa.core.errors import ConfigError
from rmpa.resource import limits
from rmpa.resource.declare import Binding, BindingKind, RestartPolicy
from rmpa.resource.description import description_mistakes, read_description, schema_text
from rmpa.runtime.programs import StartRule
from tests.fuzz.target_resource_description import FILES, SEEDS, mistaken, refused

FULL: Final = Path(__file__).with_name("robot.resource.toml")
TEXT: Final = FULL.read_text(encoding="utf-8")
DOCS: Final = Path(__file__).parents[2] / "docs"


def refusal(text: str) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        read_description(text.encode(), Path("robot.resource.toml"))
    return caught.value


def test_a_file_declares_all_that_it_says() -> None:
    robot = read_description(TEXT.encode(), FULL)
    assert (robot.name, robot.role, robot.physical) == ("robot", "controlling", False)
    driver, lamp = robot.nodes["driver"], robot.nodes["lamp"]
    assert (driver.name, driver.run, driver.stop_after, driver.restart) == (
        "/usb_cam", "usb_cam usb_cam_node", 2.0, RestartPolicy.ALWAYS,
    )  # fmt: skip
    assert driver.params == {"width": 640, "mirror": True, "sharpness": 0.5}
    assert (lamp.name, lamp.command) == ("/lamp", ("/usr/bin/env", "lamp"))
    assert {name: one.binding for name, one in robot.parameters.items()} == {
        "fps": Binding(BindingKind.DYNAMIC, "driver", "frame_rate"),
        "device": Binding(BindingKind.PRIVATE, "driver", "video_device", restart=True),
        "speed": Binding(BindingKind.ARGUMENT, "bringup", "max_speed", restart=True),
        "gain": Binding(BindingKind.PRIVATE, "driver", "gain"),
        "own": None,
    }
    assert all(topic.observed for topic in robot.outputs.values())
    assert not robot.inputs["/scan"].observed  # it is measured
    full = robot.profiles["full"]
    assert full.offers == {"rate": 30.0, "path.rate": 5.0, "heat": 10.0}
    assert (full.sets, full.nodes) == ({"fps": 30, "speed": 1.0, "own": False}, ("lamp",))
    assert robot.contexts["docked"].requires["latency"].weight == 2.0
    assert robot.demands["/sonar"].priority == 2
    assert robot.start == StartRule(True, 2.0, ("/scan",), ("base",))
    assert (robot.settings.window, robot.settings.cool_down_max, robot.settings.offers) == (0.5, 60.0, "learnt")


def test_a_file_without_a_name_names_the_resource() -> None:
    nameless = TEXT.replace('name = "robot"\n', "", 1)
    assert read_description(nameless.encode(), Path("/a/lawn_mower.resource.toml")).name == "lawn_mower"
    assert "base name" in str(refusal(nameless.replace("role", "name = '7'\nrole", 1)))


@pytest.mark.parametrize(
    ("right", "wrong", "words"),
    [
        ('role = "controlling"', 'rule = "controlling"', "did you mean role?"),
        ('role = "controlling"', 'role = "moving"', "moving"),
        ('run = "usb_cam usb_cam_node"', "run = 3", "text"),
        ('launch = "navigation nav.launch"', 'launch = "navigation nav.launch"\nrun = "a b"', "three ways"),
        ('dynamic = "frame_rate"', 'dynamic = "frame_rate"\nprivate = "fps"', "two places"),
        ('node = "driver"\nlow', 'node = "drivr"\nlow', "did you mean driver?"),
        ('arg = "max_speed"\nnode = "bringup"', 'arg = "max_speed"\nnode = "driver"', "launch"),
        ("set = { fps = 10 }", "set = { fps = 61 }", "the most is 60"),
        ('offers = { rate = "10 Hz", mode = "night" }', 'offers = { rate = "10 Hx" }', "say it in Hz"),
        ('offers = { rate = "10 Hz", mode = "night" }', 'offers = { rte = "10 Hz" }', "rte"),
        ('nodes = ["lamp"]', 'nodes = ["lmp"]', "did you mean lamp?"),
        ('when = "heat > 40"', 'when = "heat > "', "a value is missing"),
        ('when = "heat > 40"', 'when = "heet > 40"', "did you mean heat?"),
        ('latency = "<= 200 ms weight=2"', 'latency = "< 200 ms"', "no bound"),
        ('deadline = "100 ms"', 'deadline = "soon"', "soon"),
        ('type = "nav_msgs/Path"', 'type = "nav_msgs/Paht"', "Paht"),
        ('window = "500 ms"', 'window = "0 s"', "at least 0.05 s"),
        ('topics = ["/scan"]', 'topics = ["scan"]', "no global name|not a global name"),
        ('after = ["base"]', 'after = ["robot"]', "wait for itself"),
    ],
)  # fmt: skip
def test_a_mistake_is_told_with_its_line(right: str, wrong: str, words: str) -> None:
    assert TEXT.count(right) == 1
    text = TEXT.replace(right, wrong)
    error = refusal(text)
    begin = TEXT[: TEXT.index(right)].count("\n") + 1
    assert begin <= (error.line or 0) <= begin + wrong.count("\n"), error
    assert re.search(words, str(error)), error


def test_all_misspelt_keys_are_told_at_once() -> None:
    text = TEXT.replace("dynamic =", "dynamc =").replace("better =", "beter =").replace("[alarm.hot]", "[alrm.hot]")
    lines = [one.line or 0 for one in description_mistakes(text.encode(), FULL)]
    misspelt = re.compile(r"dynamc|beter|\[alrm")
    assert sorted(lines) == [n for n, line in enumerate(text.split("\n"), 1) if misspelt.match(line)]
    assert description_mistakes(TEXT.encode(), FULL) == []


def test_a_thousand_wrong_files_are_refused_with_their_line() -> None:
    texts = [seed.decode() for seed in SEEDS]
    count = seed = 0
    while count < 1000:
        seed += 1
        rng = random.Random(seed)
        data = mistaken(rng, rng.choice(texts)).encode()
        try:
            count += refused(data) is not None
        except BaseException as error:
            error.add_note(f"seed {seed}")
            raise
    assert seed < 1500


def test_a_file_that_is_too_large_is_refused() -> None:
    assert "more than" in str(refusal(TEXT + "#" * limits.DESCRIPTION_MAX))


@pytest.mark.parametrize("path", FILES[1:], ids=lambda path: str(path.name))
def test_the_examples_are_valid_and_short(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.startswith("#:schema ../../docs/resource.schema.json\n")
    read_description(text.encode(), path)
    assert sum(bool(line) and not line.startswith("#") for line in text.splitlines()) <= 25


def test_the_schema_in_the_docs_is_of_this_version() -> None:
    assert (DOCS / "resource.schema.json").read_text(encoding="utf-8") == schema_text(), "run make reference"
    assert CliRunner().invoke(cli, ["resource", "schema"]).output == schema_text()
    schema = json.loads(schema_text())
    assert set(schema["properties"]["profile"]["additionalProperties"]["properties"]) >= {"set", "offers", "nodes"}
