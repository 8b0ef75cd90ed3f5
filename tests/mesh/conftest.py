"""A clock that tests move, and two ends of a link that is up."""

from __future__ import annotations

import pytest

from tests.mesh.worlds import Side, Time, pair


@pytest.fixture
def time() -> Time:
    return Time()


@pytest.fixture
def up(time: Time) -> tuple[Side, Side]:
    """A dialler and an acceptor."""
    return pair(time)


@pytest.fixture
def dialler(up: tuple[Side, Side]) -> Side:
    return up[0]


@pytest.fixture
def acceptor(up: tuple[Side, Side]) -> Side:
    return up[1]
