from __future__ import annotations

import pytest

from tests.web.rosbridge.client import Client


@pytest.fixture
def client() -> Client:
    """A client in a graph without topics and services."""
    return Client()
