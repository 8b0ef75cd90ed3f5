"""What needs the extra ``rmpa[zenoh]`` is skipped without it: GIDs of ROS 2 are hashes that xxhash makes."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest


def _is_there(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:
        return False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of this folder."""
    if not _is_there("xxhash"):
        for item in items:
            if Path(__file__).parent in item.path.parents:
                item.add_marker(pytest.mark.skip(reason="the extra rmpa[zenoh] is not installed"))
