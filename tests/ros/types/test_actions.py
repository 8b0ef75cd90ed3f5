from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from rmpa.ros.types.installed import action_message, actions_of

GENACTION: Final = Path("/usr/lib/actionlib_msgs/genaction.py")
TEXT: Final = "# how far\nfloat64 metres\nuint8 FAST=1\n---\nbool done\n---\nfloat64 left  # m"


def test_which_action_a_message_may_be_of() -> None:
    assert list(actions_of("DoActionGoal")) == [("Do", "ActionGoal"), ("DoAction", "Goal")]
    assert list(actions_of("DoAction")) == [("Do", "Action")]
    assert list(actions_of("Goal")) == []
    assert list(actions_of("Pose")) == []


def test_a_file_without_three_parts_is_no_action() -> None:
    assert action_message("Do", "Goal", "int8 a\n---\nint8 b") is None
    assert action_message("Do", "ActionGoal", "---\n---\n---\n") is None


@pytest.mark.skipif(not GENACTION.exists(), reason="ROS 1 is not installed (no genaction.py of actionlib_msgs)")
@pytest.mark.parametrize("text", [TEXT, "---\n---\n", "int8 a\n--- \nint8 b\n----\nint8 c\n"])
def test_the_texts_are_those_of_genaction(tmp_path: Path, text: str) -> None:
    (tmp_path / "Do.action").write_text(text)
    subprocess.run([sys.executable, GENACTION, "Do.action", "-o", tmp_path], cwd=tmp_path, check=True)
    made = sorted(tmp_path.glob("*.msg"))
    assert len(made) == 7
    for path in made:
        (_, part), *_ = actions_of(path.stem)
        assert action_message("Do", part, text) == path.read_text(), part
