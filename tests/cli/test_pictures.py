"""What the verbs look like on terminals of 80 and of 120 columns, line by line.

``WRITE_GOLDEN=1 make tests ARGS=tests/cli/test_pictures.py`` writes the files anew, after a change that is meant.
"""

from __future__ import annotations

import io
import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

from rmpa.cli.main import main
from rmpa.observe.snapshot import FollowedInfo
from tests.cli.conftest import with_core
from tests.cli.test_resource import remote, running
from tests.cli.test_site import REPORT
from tests.observe.why import test_topics

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.ros.core.embedded import RosCore
    from tests.cli.conftest import Place

GOLDEN: Final = Path(__file__).with_name("golden")
__all__ = ["remote", "running"]  # fixtures
FOLLOWED: Final = FollowedInfo(key="/map/frame", owner="base", owner_key="/map_frame", state="followed", size=12)
LINES: Final = (
    "peer list",
    "peer list -v",
    "peer info joystick",
    "peer ping joystick -c 2 -i 0.01",
    "topic list",
    "topic list -v",
    "topic info /sonar/state",
    "topic find std_msgs/String",
    "service list",
    "service list -v",
    "service info /sonar/set_parameters",
    "node list",
    "node list -v",
    "node info /sonar",
    "param list /sonar",
    "param get /rosdistro",
    "param followed",
    "resource list",
    "resource info sonar",
    "profile list sonar",
    "profile explain sonar",
    "context list sonar",
    "site list",
    "why joystick:/cmd",
    "topic echo nobody:/x",
    "list",
)


class Terminal(io.StringIO):
    """Standard output of a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def show(
    place: Place,
    agent: Callable[..., None],
    core: RosCore,
    monkeypatch: pytest.MonkeyPatch,
    running: object,
    remote: object,
) -> Callable[[str, int], str]:
    """Runs a verb within this process, on a terminal; returns what both streams show."""
    for name in ("RMPA_AGENT", "ROS_MASTER_URI"):
        monkeypatch.delenv(name, raising=False)
    for name, value in (("RMPA_RUNTIME_DIR", str(place.path)), ("NO_COLOR", "1"), ("TERM", "dumb")):
        monkeypatch.setenv(name, value)
    agent(
        snapshot=with_core(core.uri),
        why=lambda _: test_topics.Case().walk(),
        site=lambda _: [REPORT],
        followed=lambda _: (FOLLOWED,),
        node=lambda _: (),
    )

    def run(line: str, width: int) -> str:
        monkeypatch.setenv("COLUMNS", str(width))
        terminal = Terminal()
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", terminal)
            patch.setattr(sys, "stderr", terminal)
            main(line.split())
        # Ports and process ids have five digits, or the columns behind them would move.
        text = re.sub(r"\x1b\[[0-9;]*m", "", terminal.getvalue())
        text = re.sub(r"(127\.0\.0\.1|localhost):\d{5}", r"\1:40000", text)
        return re.sub(r"Pid: \d+", "Pid: 40000", re.sub(r"took [\d.e-]+ s", "took 0.002 s", text))

    return run


@pytest.mark.parametrize("width", [80, 120])
def test_verbs_on_a_terminal(show: Callable[[str, int], str], width: int) -> None:
    said = "".join(f"$ rmpa {line}\n{show(line, width)}\n" for line in LINES)
    file = GOLDEN / f"{width}.txt"
    if os.environ.get("WRITE_GOLDEN"):
        file.parent.mkdir(exist_ok=True)
        file.write_text(said, encoding="utf-8")
    assert said == file.read_text(encoding="utf-8")
