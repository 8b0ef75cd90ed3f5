from __future__ import annotations

import pytest

from tests.web.foxglove.client import Client


@pytest.fixture
def client() -> Client:
    """A client that may do everything, in a graph without topics and services."""
    return Client()
