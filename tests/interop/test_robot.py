"""The story of examples/robot: three modules of described resources adapt to a thin line, a battery and a death."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any, Final

import pytest

STORY: Final = Path(__file__).parents[2] / "examples/robot/story.py"

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.long, pytest.mark.timeout(300)]


def test_three_modules_adapt_and_say_why(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("story", STORY)
    assert spec is not None
    assert spec.loader is not None
    story: Any = importlib.util.module_from_spec(spec)
    sys.modules["story"] = story
    spec.loader.exec_module(story)
    with story.Robot(tmp_path) as robot:
        well, line, battery, laser = (said for _, said in robot.story())
        output = "\n".join(process.output for process in robot.resources.values())
    assert all(f"{path} " in well for path in ("/pilot", "base:/base", "eyes:/camera"))
    assert "latency fell short" in line
    assert "asked by /rmpa/head/pilot" in line
    assert "left out: not in context tired" in battery
    assert "node /laser was ended by SIGKILL" in laser
    assert "Traceback" not in output
