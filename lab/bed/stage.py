"""Where one cell of an experiment is measured."""

from __future__ import annotations

import itertools
import tempfile
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from lab.bed import namespaces, ros
from lab.bed.namespaces import Lab
from lab.bed.system import Classic, Place, Rmpa, System

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from lab.bed.plan import Kind, Plan, Transport

# The nodes of ``nodes/``.
PROGRAMS = ("source", "velocity", "sink")


def why_not() -> str:
    """What experiments lack here, and what would install it, or an empty string."""
    return "; ".join(filter(None, (namespaces.why_not(), ros.why_not())))


@contextmanager
def make_stage(plan: Plan) -> Iterator[Stage]:
    """A stage for one cell; all that was started on it has ended after the ``with``."""
    if "roscpp" in plan.clients:
        for program in PROGRAMS:
            ros.compiled(program)
    with tempfile.TemporaryDirectory(prefix="rmpa-experiment-") as made:
        yield Stage(plan, Path(made))


class Stage:
    """Where one cell is measured; all that was started on it has ended when the cell is over.

    Args:
        plan: Says what the cables of hosts carry.
        home: An empty directory.
    """

    def __init__(self, plan: Plan, home: Path) -> None:
        self._plan = plan
        self._home = home
        self._numbers = itertools.count(1)
        self._scratch = home / "scratch"
        self._scratch.mkdir()

    @property
    def plan(self) -> Plan:
        """What the run was asked for."""
        return self._plan

    @property
    def scratch(self) -> Path:
        """An empty directory for files between nodes and us."""
        return self._scratch

    @contextmanager
    def system(
        self,
        kind: Kind,
        hosts: Sequence[str],
        *,
        link: str | None = None,
        bands: bool = True,
        way: Transport = "relay",
        config: str = "",
        flags: Sequence[str] = (),
        linked: bool = True,
    ) -> Iterator[System]:
        """Set a system up; it is torn down at the end of the ``with``.

        Args:
            kind: Which.
            hosts: Their names; classic's roscore runs on ``pc``, else on the last.
            link: What each cable carries (``100mbit``); empty for unshaped; ``None``: as the plan says.
            bands: Whether packets leave by the kernel's usual three bands (``pfifo_fast``), as on a real interface.
            way: The transport of what no contract in ``config`` gives another one; classic ROS has but one.
            config: Further text of every agent's ``rmpa.toml``.
            flags: Further words for ``rmpa up``.
            linked: Whether to wait until every agent is linked with every other (classic: until the master answers).
        """
        home = self._home / f"system{next(self._numbers)}"
        home.mkdir()
        with ExitStack() as stack:
            lab = stack.enter_context(Lab())
            place = Place(lab, hosts, link=self._plan.link if link is None else link, bands=bands)
            made: System
            if kind == "classic":
                made = Classic(place, hosts, home)
            else:
                made = Rmpa(place, hosts, home, way=way, config=config, flags=flags)
            robot = stack.enter_context(made)
            robot.boot(linked=linked)
            yield robot
