from __future__ import annotations

import pytest

from rmpa.ros.types.messages import MessageType


@pytest.fixture(scope="session", autouse=True)
def _warm() -> None:
    """Import numpy and rosbags before a test watches for blocking calls."""
    kind = MessageType("std_msgs/String")
    kind.deserialize(kind.serialize(kind.make()))
