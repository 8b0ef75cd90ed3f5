"""``rmpa why`` beside a fake agent."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import ConfigError
from rmpa.observe.control_server import ControlServer, Handler
from rmpa.observe.peer_info import Check, CheckLevel
from rmpa.observe.why.diagnosis import Diagnosis
from tests.observe.samples import SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.observe.snapshot import Snapshot
    from tests.cli.conftest import Background, Place

FLOWS = Diagnosis(
    name="/cmd",
    peer="joystick",
    to="base",
    node="/joy",
    flows=True,
    stages=(
        Check("peer", CheckLevel.OK, "joystick is known"),
        Check("contract", CheckLevel.WARN, "3 lost", "`rmpa topic info`"),
    ),
)
STOPS = Diagnosis(
    name="/cmd",
    peer="joystick",
    to="base",
    flows=False,
    stages=(
        Check("peer", CheckLevel.OK, "joystick is known"),
        Check("publisher", CheckLevel.FAIL, "no node of joystick\x1b[2J publishes /cmd", "start it"),
    ),
)


@pytest.fixture
def answers(place: Place, background: Background) -> Iterator[Callable[[Handler], None]]:
    servers: list[ControlServer] = []

    def start(handler: Handler) -> None:
        def snapshot(_: dict[str, object]) -> Snapshot:
            return SNAPSHOT

        server = ControlServer(place.path, "base", {"snapshot": snapshot, "why": handler})
        background.do(server.start())
        servers.append(server)

    yield start
    for server in servers:
        background.do(server.close())


def test_a_module_is_asked_about_by_its_name_alone(place: Place, answers: Callable[[Handler], None]) -> None:
    asked: list[dict[str, object]] = []

    def handler(args: dict[str, object]) -> tuple[Diagnosis, ...]:
        asked.append(args)
        stages = (Check("link", CheckLevel.OK, "linked by 10.0.0.2:40002"),)
        return (Diagnosis.of(stages, name="joystick", peer="joystick", to="base", kind="module"),)

    answers(handler)
    code, out, err = place.run("why", "--module", "joystick")
    assert (code, err) == (0, "")
    assert out.splitlines() == ["joystick to base:", "  ok       link  linked by 10.0.0.2:40002", "it is linked"]
    assert asked == [{"module": "joystick"}]


def test_what_does_not(place: Place, answers: Callable[[Handler], None]) -> None:
    asked: list[dict[str, object]] = []

    def answer(args: dict[str, object]) -> tuple[Diagnosis, ...]:
        asked.append(args)
        return (FLOWS, STOPS)

    answers(answer)
    code, out, err = place.run("why", "joystick:cmd")
    assert (code, err) == (1, "")
    assert asked == [{"name": "/cmd", "peer": "joystick", "service": False}]
    assert out.splitlines()[-3:] == [
        "  fail     publisher  no node of joystick\\x1b[2J publishes /cmd",
        "it stops at: publisher",
        "what to do: start it",
    ]
    assert "" in out.splitlines(), "one way apart from the other"


def test_json(place: Place, answers: Callable[[Handler], None]) -> None:
    answers(lambda _: (STOPS,))
    code, out, _ = place.run("why", "/cmd", "--json")
    assert code == 1
    (found,) = json.loads(out)
    assert (found["flows"], found["stages"][-1]["name"]) == (False, "publisher")
    assert found["stages"][-1]["verdict"] == "fail"


def test_errors(place: Place, answers: Callable[[Handler], None]) -> None:
    assert place.run("why", "a b")[0] == 2
    code, _, err = place.run("why", "/cmd")
    assert code == 1
    assert "start one with `rmpa up`" in err

    def refuse(_: dict[str, object]) -> object:
        raise ConfigError("name", "is not a topic")

    answers(refuse)
    code, _, err = place.run("why", "/cmd")
    assert code == 1
    assert "is not a topic" in err
