"""A short private runtime directory: a socket's path has at most 107 bytes, and pytest's own are long."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def place() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="rmpa-test-") as name:
        yield Path(name)
