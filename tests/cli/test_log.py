"""``rmpa log`` beside a fake agent: the order, what is marked, what is said of modules that cannot be read."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import click
import pytest

from rmpa.bridge.log_ring import LogLine, ModuleLog
from rmpa.cli.log import _read_since, _shown
from rmpa.core.errors import ConfigError
from tests.cli.conftest import Place

AT = time.mktime((2026, 3, 4, 12, 0, 1, 0, 0, -1))


def entry(
    text: str, at: float = AT, *, module: str = "arm", error: float | None = 0.0, level: str = "info", **more: Any
) -> tuple[LogLine, str, float | None]:
    return LogLine(1, at, level, more.pop("node", "/hand"), text, **more), module, error


def shown(one: Any, before: Any = None, width: int | None = None) -> list[str]:
    return [click.unstyle(line) for line in _shown(one, before, width)]


def test_a_line_has_its_time_level_module_and_node_and_an_agents_says_so() -> None:
    assert shown(entry("hot", AT + 0.25, level="warn")) == ["2026-03-04 12:00:01.250 warn  arm:/hand: hot"]
    assert shown(entry("= up", agent=True)) == ["2026-03-04 12:00:01.000 info  arm agent: = up"]


def test_a_line_that_may_be_older_than_the_one_above_is_marked() -> None:
    above = entry("a", AT)
    for error, at, marked in ((0.003, 0.002, True), (0.003, 0.004, False), (None, 9.0, True)):
        (line,) = shown(entry("b", AT + at, module="base", error=error), above)
        assert ("±" in line) is marked
    assert "±" not in shown(entry("b", AT), above)[0]  # of one module, whose order is its own


def test_nothing_of_a_text_reaches_the_terminal_as_a_command() -> None:
    (line,) = shown(entry("a\0b\x1b]0;t\x07\r\nc\u202ed"))
    assert line.endswith(r"a\x00b\x1b]0;t\x07\r\nc\u202ed")
    lines = shown(entry("first\nsecond \x1b[2J " + "word " * 40), width=80)
    assert lines[1].startswith(r"    second \x1b[2J")
    assert max(map(len, lines)) <= 80


def test_times_are_read() -> None:
    assert [_read_since(text) for text in ("90", "30s", "5m", "1.5 h", "2d")] == [90, 30, 300, 5400, 172_800]
    for text in ("", "5 weeks", "-1s", "nan"):
        with pytest.raises(ConfigError):
            _read_since(text)


def test_all_modules_are_asked_and_what_cannot_be_read_is_named(place: Place, agent: Callable[..., None]) -> None:
    asked: list[dict[str, Any]] = []
    lines = tuple(entry(text, AT + at)[0] for text, at in (("first", 0.0), ("third", 2.0)))
    second = (entry("second", AT + 1)[0],)

    def log(args: dict[str, Any]) -> Any:
        asked.append(args)
        old = ModuleLog(module="old", problem="its agent is of an earlier release", code="other-release")
        loud = ModuleLog(module="base", lines=second, next=9, lost=("/loud",), error=0.001)
        return (ModuleLog(module="arm", lines=lines, next=9, error=0.0), loud, old)

    agent(log=log)
    code, output, errors = place.run("log", "--level", "warn", "--node", "hand", "--since", "5m")
    assert [line.rpartition(": ")[2] for line in output.splitlines()] == ["first", "second", "third"]
    assert code == 0
    assert "! old: its agent is of an earlier release [other-release]" in errors
    assert "base:/loud writes more than is kept" in errors
    assert asked[0] == {"after": {}, "most": 100, "level": "warn", "node": "/hand", "since": 300.0}
    assert place.run("log", "arm", "old")[0] == 1
    place.run("log", "--node", "arm:/hand")  # as a line has it
    assert (asked[-1]["modules"], asked[-1]["node"]) == (["arm"], "/hand")
    assert [each["text"] for each in place.json("log", "--json", "-n", "2")] == ["second", "third"]
