"""What ``rmpa doctor`` says of clocks, rights and files."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rmpa.observe.doctor.machine import (
    KernelRights,
    WallClock,
    judge_clock,
    judge_peer_clock,
    judge_rights,
    judge_sim_time,
)
from rmpa.observe.peer_info import CheckLevel

GOOD = WallClock(stepped=0.00001, synchronised=True, error=0.004, year=2026)
FREE = KernelRights(fifo="", memlock=None, wanted=True, files=65536)


@pytest.mark.parametrize(
    ("clock", "subject", "level"),
    [
        (GOOD, "step", CheckLevel.OK),
        (replace(GOOD, stepped=-0.2), "step", CheckLevel.WARN),
        (GOOD, "synchronised", CheckLevel.OK),
        (replace(GOOD, synchronised=False), "synchronised", CheckLevel.WARN),
        (replace(GOOD, synchronised=None), "synchronised", CheckLevel.SKIPPED),
        (replace(GOOD, year=1970), "date", CheckLevel.FAIL),
    ],
)
def test_clock(clock: WallClock, subject: str, level: CheckLevel) -> None:
    found = {finding.where: finding for finding in judge_clock(clock)}
    assert found[subject].level is level
    assert bool(found[subject].remedy) is (level in (CheckLevel.WARN, CheckLevel.FAIL))


def test_simulated_time_needs_a_clock() -> None:
    assert judge_sim_time("base", None) == []
    (runs,) = judge_sim_time("base", ["/gazebo"])
    (stands,) = judge_sim_time("base", [])
    assert (runs.level, stands.level) == (CheckLevel.OK, CheckLevel.WARN)
    assert "nodes that start stand still at time 0" in stands.text


@pytest.mark.parametrize(
    ("offset", "error", "level"),
    [
        (0.001, 0.0002, CheckLevel.OK),
        (0.5, 0.0002, CheckLevel.WARN),
        (-0.5, None, CheckLevel.WARN),
        (0.5, 0.6, CheckLevel.OK),
    ],
)
def test_clocks_of_two_modules(offset: float, error: float | None, level: CheckLevel) -> None:
    found = judge_peer_clock("base", "joystick", offset, error)
    assert found.level is level
    assert ("ahead of" if offset > 0 else "behind") in found.text
    if level is CheckLevel.WARN:
        assert "extrapolation" in found.remedy


def test_missing_rights_matter_only_where_wanted() -> None:
    assert {finding.level for finding in judge_rights(FREE)} == {CheckLevel.OK}
    poor = replace(FREE, fifo="Operation not permitted", memlock=65536)
    realtime, files = judge_rights(poor)
    assert realtime.level is CheckLevel.WARN
    assert "Operation not permitted" in realtime.text
    assert "64 KiB" in realtime.text
    assert "LimitRTPRIO" in realtime.remedy
    assert files.level is CheckLevel.OK
    assert judge_rights(replace(poor, wanted=False))[0].level is CheckLevel.OK


def test_few_files() -> None:
    _, files = judge_rights(replace(FREE, files=1024))
    assert files.level is CheckLevel.WARN
    assert "LimitNOFILE" in files.remedy
    assert [found.name for found in judge_rights(replace(FREE, files=None))] == ["realtime"], "agents tell theirs"
