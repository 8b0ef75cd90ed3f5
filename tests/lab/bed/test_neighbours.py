from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.neighbours import room_for

if TYPE_CHECKING:
    from pathlib import Path

LIMITS = {"gc_thresh1": "128\n", "gc_thresh2": "512\n", "gc_thresh3": "1024\n"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, value in LIMITS.items():
        (tmp_path / name).write_text(value, encoding="ascii")
    return tmp_path


def shown(folder: Path) -> dict[str, str]:
    return {name: (folder / name).read_text(encoding="ascii") for name in LIMITS}


def test_the_limits_are_raised_and_put_back(folder: Path) -> None:
    with room_for(64, folder):
        raised = {name: int(value) for name, value in shown(folder).items()}
    assert raised == {"gc_thresh1": 4096, "gc_thresh2": 4096, "gc_thresh3": 8192}
    assert shown(folder) == LIMITS


def test_limits_that_are_enough_stay(folder: Path) -> None:
    with room_for(8, folder):
        assert shown(folder) == LIMITS


def test_a_machine_that_does_not_show_them_is_left_alone(tmp_path: Path) -> None:
    with room_for(64, tmp_path / "missing"):
        pass
