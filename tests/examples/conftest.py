"""A place for demos, which must be empty in the end."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def tidy(tmp_path: Path) -> Iterator[dict[str, str]]:
    """The demo's environment, its temporary files in a directory that must be empty in the end."""
    place = tmp_path / "t" if len(str(tmp_path)) < 50 else Path(f"/tmp/rmpa-demo-test-{os.getpid()}")
    place.mkdir()
    env = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "RMPA_"))}
    try:
        yield {**env, "TMPDIR": str(place)}
        assert not list(place.iterdir()), "files are left"
    finally:
        shutil.rmtree(place, ignore_errors=True)
