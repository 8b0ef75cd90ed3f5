"""A snapshot as an agent named base would show it: ``snapshot.json``, as ``--json`` prints it."""

from __future__ import annotations

from pathlib import Path

import msgspec

from rmpa.core.facts import RouteInfo, SubscriberTransport
from rmpa.observe.snapshot import Snapshot

SNAPSHOT = msgspec.json.decode(Path(__file__).with_name("snapshot.json").read_bytes(), type=Snapshot)

VIEWER = SubscriberTransport(
    node="/viewer",
    transport="direct",
    state="direct",
    since_ago=180.0,
    wanted="auto",
    endpoint="10.0.0.2:41234",
    interruptions=2,
    interrupted=39.0,
    interrupted_ago=12.0,
)
"""A subscriber that is connected directly."""
DIRECT = RouteInfo(
    peer="joystick",
    node="/joy_node",
    direction="in",
    state="idle",
    type="sensor_msgs/Joy",
    contract={"transport": "auto"},
    transport="direct",
    subscribers=(VIEWER,),
)
"""A route that no message takes, because its only subscriber is direct."""
