"""Gateways run on the loop that agents have in life, with their settings."""

from __future__ import annotations

from tests.agent.conftest import pytest_asyncio_loop_factories, settings

__all__ = ["pytest_asyncio_loop_factories", "settings"]
