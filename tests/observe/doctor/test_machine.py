"""What ``rmpa doctor`` says of clocks, rights and files."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rmpa.observe.doctor.finding import FindingLevel
from rmpa.observe.doctor.machine import KernelRights, WallClock, judge_clock, judge_peer_clock, judge_rights

GOOD = WallClock(stepped=0.00001, synchronised=True, error=0.004, year=2026)
FREE = KernelRights(fifo="", memlock=None, wanted=True, files=65536)


@pytest.mark.parametrize(
    ("clock", "subject", "level"),
    [
        (GOOD, "step", FindingLevel.OK),
        (replace(GOOD, stepped=-0.2), "step", FindingLevel.WARN),
        (GOOD, "synchronised", FindingLevel.OK),
        (replace(GOOD, synchronised=False), "synchronised", FindingLevel.WARN),
        (replace(GOOD, synchronised=None), "synchronised", FindingLevel.SKIPPED),
        (replace(GOOD, year=1970), "date", FindingLevel.FAIL),
    ],
)
def test_clock(clock: WallClock, subject: str, level: FindingLevel) -> None:
    found = {finding.subject: finding for finding in judge_clock(clock)}
    assert found[subject].level is level
    assert bool(found[subject].remedy) is (level in (FindingLevel.WARN, FindingLevel.FAIL))


@pytest.mark.parametrize(
    ("offset", "error", "level"),
    [
        (0.001, 0.0002, FindingLevel.OK),
        (0.5, 0.0002, FindingLevel.WARN),
        (-0.5, None, FindingLevel.WARN),
        (0.5, 0.6, FindingLevel.OK),
    ],
)
def test_clocks_of_two_modules(offset: float, error: float | None, level: FindingLevel) -> None:
    found = judge_peer_clock("base", "joystick", offset, error)
    assert found.level is level
    assert ("ahead of" if offset > 0 else "behind") in found.text
    if level is FindingLevel.WARN:
        assert "extrapolation" in found.remedy


def test_rights_are_missed_only_by_who_asks_for_them() -> None:
    assert {finding.level for finding in judge_rights(FREE)} == {FindingLevel.OK}
    poor = replace(FREE, fifo="Operation not permitted", memlock=65536)
    realtime, files = judge_rights(poor)
    assert realtime.level is FindingLevel.WARN
    assert "Operation not permitted" in realtime.text
    assert "64 KiB" in realtime.text
    assert "LimitRTPRIO" in realtime.remedy
    assert files.level is FindingLevel.OK
    assert judge_rights(replace(poor, wanted=False))[0].level is FindingLevel.OK


def test_few_files() -> None:
    _, files = judge_rights(replace(FREE, files=1024))
    assert files.level is FindingLevel.WARN
    assert "LimitNOFILE" in files.remedy
    assert [found.check for found in judge_rights(replace(FREE, files=None))] == ["realtime"], "agents tell theirs"
