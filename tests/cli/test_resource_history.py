from __future__ import annotations

import asyncio
import json
import time
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner

from rmpa.cli.main import cli
from rmpa.resource import Resource
from rmpa.resource.run.descriptor import describe
from rmpa.resource.run.store import ResourceStore

if TYPE_CHECKING:
    from pathlib import Path

SECOND = 1_000_000_000


async def write(path: Path, began: int) -> None:
    resource = Resource("sonar", role="sensing")
    resource.output("ranges", "sensor_msgs/Range")
    resource.attribute("accuracy", better="min", unit="m")
    store = ResourceStore(path)
    await store.open()
    store.descriptor("/sonar", describe(resource, "/sonar").serialize(), began)
    store.event(began, "apply", 0, "the resource starts", '{"profile": "quick"}')
    store.event(began + SECOND, "reacted", 0, "quick runs", '{"profile": "quick", "reaction": 0.5}')
    store.event(began + 60 * SECOND, "alarm", 1, "adaptation: accuracy fell short under quick", "{}")
    store.event(began + 60 * SECOND, "apply", 0, "accuracy fell short", '{"profile": "fine"}')
    store.event(began + 70 * SECOND, "over", 0, "adaptation: accuracy fell short under quick", "damaged")
    quality = '{"accuracy": 0.2, "rate": 20.0, "ranges.rate": 20.0}'
    store.window(began + 59 * SECOND, "quick", 1, "adaptation", quality)
    store.window(began + 71 * SECOND, "fine", 0, "profile fine", '{"accuracy": 0.05}')
    await store.close()


@pytest.fixture
def state(tmp_path: Path) -> Path:
    asyncio.run(write(tmp_path / "robot" / "sonar.sqlite", time.time_ns() - 100 * SECOND))
    return tmp_path


def history(state: Path, *arguments: str) -> Any:
    return CliRunner().invoke(cli, ["resource", "history", *arguments, "--state", str(state)])


def rows(state: Path, *arguments: str) -> list[list[str]]:
    lines = history(state, *arguments).output.splitlines()
    return [line.split() for line in lines]


def test_events_tell_what_happened(state: Path) -> None:
    titles, *found = rows(state, "sonar")
    assert titles == ["TIME", "LEVEL", "EVENT", "PROFILE", "MESSAGE"]
    assert [row[2:5] for row in found] == [
        ["OK", "apply", "quick"],
        ["OK", "reacted", "quick"],
        ["WARN", "alarm", "-"],
        ["OK", "apply", "fine"],
        ["OK", "over", "-"],
    ]


def test_profiles_tell_when_and_why(state: Path) -> None:
    found = json.loads(history(state, "/sonar", "--profiles", "--json").output)
    assert [(run["profile"], run["why"], run["reaction"]) for run in found] == [
        ("quick", "the resource starts", 0.5),
        ("fine", "accuracy fell short", None),
    ]
    assert found[0]["until"] == found[1]["at"]
    assert found[1]["until"] is None
    text = history(state, "--profiles").output
    assert "1 min 0 s" in text
    assert "500 ms" in text


def test_violations_are_alarms_and_their_ends(state: Path) -> None:
    assert [row[3] for row in rows(state, "sonar", "--violations")[1:]] == ["alarm", "over"]


def test_windows_have_a_column_for_each_attribute(state: Path) -> None:
    titles, first, second = rows(state, "sonar", "--windows")
    assert titles == ["TIME", "LEVEL", "PROFILE", "accuracy", "[m]", "rate", "[Hz]"]
    assert (first[2:], second[2:]) == (["WARN", "quick", "0.2", "20"], ["OK", "fine", "0.05", "-"])
    (last,) = json.loads(history(state, "sonar", "--windows", "--since", "35s", "--json").output)
    assert last["quality"] == {"accuracy": 0.05}


def test_the_last_rows_are_shown(state: Path) -> None:
    assert [row[3] for row in rows(state, "sonar", "-n", "1")[1:]] == ["over"]
    assert [row[3] for row in rows(state, "sonar", "--since", "1 h", "-n", "2")[1:]] == ["apply", "over"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nose"], "no history of a resource nose"),
        (["base:/sonar"], "of another module"),
        (["sonar", "--since", "soon"], "not a number with a unit"),
        (["sonar", "--agent", "other"], "no history"),
    ],
)
def test_errors_tell_what_to_do(state: Path, arguments: list[str], said: str) -> None:
    result = history(state, *arguments)
    assert result.exit_code
    assert said in str(result.exception)


def test_several_modules_are_told_apart(state: Path) -> None:
    asyncio.run(write(state / "base" / "sonar.sqlite", time.time_ns()))
    assert "base/sonar, robot/sonar" in str(history(state, "sonar").exception)
    assert history(state, "sonar", "--agent", "base").exit_code == 0


def test_a_file_that_is_no_store_is_an_error(state: Path) -> None:
    (state / "robot" / "sonar.sqlite").write_bytes(b"no data base" * 100)
    for shown in ("--profiles", "--windows"):
        assert "sonar.sqlite" in str(history(state, "sonar", shown).exception)
