"""What users import of ``rmpa.ros``."""

from __future__ import annotations

import subprocess
import sys

import pytest

import rmpa.ros
from rmpa.ros.node.node import Node


def test_the_public_names_are_those_of_their_modules() -> None:
    assert rmpa.ros.Node is Node
    assert all(getattr(rmpa.ros, name).__name__ == name for name in rmpa.ros.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Nodes'"):
        _ = rmpa.ros.Nodes


def test_importing_the_room_imports_no_node() -> None:
    program = "import rmpa.ros, sys; print('rmpa.ros.node.node' in sys.modules, 'asyncio' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "False False\n"
