"""A ROS user's shell whose nodes are those of the tests; see ``lab.bed.ros``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import ClassVar, Final

from lab.bed import ros
from lab.bed.ros import PYTHON, environment, free_port, lacks, why_not

__all__ = ["NODES", "PYTHON", "Ros", "compiled", "environment", "free_port", "lacks", "why_not"]

NODES: Final = Path(__file__).parent / "nodes"
compiled = partial(ros.compiled, headers=NODES)


class Ros(ros.Ros):
    """With the nodes of the tests."""

    nodes: ClassVar[Path] = NODES
