"""Statuses of ``/diagnostics``: whose they are, when they are stale, their past; a hostile publisher."""

from __future__ import annotations

import math
from typing import Any

import pytest

from rmpa.observe import limits
from rmpa.observe.diagnostics import StatusKey, StatusTable, history, number_of

ARM = StatusKey("base", "SN 4711", "arm: Battery")


def status(name: str = "arm: Battery", level: int = 0, **values: str) -> dict[str, Any]:
    pairs = [{"key": key, "value": value} for key, value in values.items()]
    return {"name": name, "hardware_id": "SN 4711", "level": level, "message": "said", "values": pairs}


def test_a_status_is_of_the_module_of_its_publisher_and_remembers_its_levels() -> None:
    table = StatusTable()
    table.take("/rmpa/base/arm", [status()], 1.0)
    table.take("/arm", [status(level=1)], 1.0)
    (changed,) = table.take("/rmpa/base/arm", [status(level=2, volts="3")], 2.0)
    assert (changed.key, changed.node, changed.values) == (ARM, "/arm", {"volts": "3"})
    assert [*changed.levels] == [(1.0, "OK"), (2.0, "ERROR")]
    assert table.statuses[StatusKey("", "SN 4711", "arm: Battery")].level == "WARN"
    assert table.worst() == "ERROR"
    assert table.take("/rmpa/base/arm", [status(level=2)], 3.0) == []


def test_what_is_silent_is_stale_with_its_last_level_and_is_forgotten_at_last() -> None:
    table = StatusTable()
    table.take("/rmpa/base/arm", [status(level=2)], 10.0)
    assert table.judge(10.0 + limits.DIAGNOSTIC_STALE) == []
    (stale,) = table.judge(10.1 + limits.DIAGNOSTIC_STALE)
    assert (stale.level, stale.last) == ("STALE", "ERROR")
    assert table.take("/rmpa/base/arm", [status(level=2)], 20.0) == [stale]
    table.judge(20.1 + limits.DIAGNOSTIC_FORGET)
    assert not table.statuses


def test_a_gap_in_which_it_was_not_listened_makes_nothing_stale() -> None:
    table = StatusTable()
    table.take("/arm", [status()], 10.0)
    table.resume(100.0)
    assert table.judge(100.5) == []
    assert table.judge(100.1 + limits.DIAGNOSTIC_STALE) != []


@pytest.mark.parametrize("level", [3, 7, 255, -1])
def test_a_level_that_is_none_of_the_three_counts_as_stale(level: int) -> None:
    table = StatusTable()
    (found,) = table.take("/arm", [status(level=level)], 1.0)
    assert found.level == "STALE"


def test_a_hostile_publisher_pushes_out_its_own_statuses_alone() -> None:
    table = StatusTable()
    table.take("/rmpa/base/arm", [status()], 1.0)
    for number in range(3):
        flood = [status(f"flood {number} {each}") for each in range(limits.DIAGNOSTICS_MAX)]
        table.take("/rmpa/evil/flood", flood, 2.0 + number)
    table.take("/rmpa/base/arm", [status(), status("arm: new")], 9.0)
    assert len(table.statuses) == limits.DIAGNOSTICS_MAX
    assert {ARM, ARM._replace(name="arm: new")} <= table.statuses.keys()
    assert "statuses" in table.problems["/rmpa/evil/flood"]


def test_too_many_and_too_long_messages_are_left_out_and_it_is_said_for_a_while() -> None:
    table = StatusTable()
    taken = [table.admits("/evil", 100, 1.0) for _ in range(1000)].count(True)
    assert taken == 3 * limits.DIAGNOSTIC_RATE
    assert table.admits("/arm", 100, 1.0)
    assert not table.admits("/long", limits.DIAGNOSTIC_BYTES + 1, 1.0)
    assert table.problems.keys() == {"/evil", "/long"}
    table.judge(2.0 + limits.DIAGNOSTIC_PROBLEM)
    assert table.problems == {}


def test_texts_and_values_are_bounded() -> None:
    table = StatusTable()
    many = {f"k{number}": "x" * 5000 for number in range(limits.DIAGNOSTIC_VALUES + 50)}
    (found,) = table.take("/arm", [status("n" * 5000, 0, **many)], 1.0)
    assert (len(found.key.name), len(found.values)) == (257, limits.DIAGNOSTIC_VALUES)
    assert max(map(len, found.values.values())) == 513


def test_the_past_of_numbers_is_kept_within_a_share_for_each_status() -> None:
    table = StatusTable(history=60)
    for second in range(50):
        table.take("/arm", [status(volts=f"{second}.5 V", at="10.0.0.1", bad="nan")], second)
    (found,) = table.statuses.values()
    past = dict(history(found))
    assert past[""] == [float(second) for second in range(30, 50)]
    assert past.keys() == {"", "volts"}
    assert past["volts"][-1] == 49.5
    table.take("/arm", [status(other="1")], 60.0)
    assert dict(history(found)) == {"": [60.0], "other": [1.0]}


@pytest.mark.parametrize(
    ("text", "number"),
    [("12.5 V", 12.5), ("-3", -3.0), ("1e3Hz", 1000.0), (" 7 % ", 7.0), (".5", 0.5)]
    + [
        (text, math.nan)
        for text in ("nan", "inf", "1e999", "10.0.0.1", "12:30", "1-2", "True", "", "v 3", "2026-11-29")
    ],
)
def test_a_value_is_a_number_with_or_without_its_unit(text: str, number: float) -> None:
    assert number_of(text) == pytest.approx(number, nan_ok=True)
