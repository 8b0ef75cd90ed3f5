"""A snapshot as an agent named base would show it."""

from __future__ import annotations

from rmpa.monitor.snapshot import AgentInfo, LinkInfo, PeerInfo, RouteInfo, Snapshot, TopicInfo

SNAPSHOT = Snapshot(
    agent=AgentInfo(
        name="base",
        guid="10.0.0.1:40001#7",
        instance="00" * 16,
        domain=3,
        core_uri="http://127.0.0.1:11311/",
        version="0.1.0",
        pid=4242,
        started=1_700_000_000.0,
        uptime=3725.0,
        cpu=0.4,
        rss=41_000_000,
        addresses=("10.0.0.1",),
        interfaces=("wlan0",),
        config_file="/etc/rmpa/rmpa.toml",
    ),
    taken=1_700_003_725.0,
    peers=(
        PeerInfo(
            name="joystick",
            guid="10.0.0.2:40002#1",
            instance="11" * 16,
            state="linked",
            since_ago=61.5,
            addresses=("10.0.0.2", "192.168.7.2"),
            found_ago=62.0,
            beacon_ago=1.25,
            source="multicast",
            link=LinkInfo(
                remote="10.0.0.2:40002",
                dialled=True,
                up_ago=61.5,
                rtt=0.000432,
                clock_offset=-0.00125,
                clock_error=0.000216,
                bytes_in=12_345_678,
                bytes_out=1_234,
                queued=10,
                dropped=2,
                heard_ago=0.1,
            ),
            topics_in=1,
            topics_out=1,
        ),
        PeerInfo(
            name="pc",
            guid="10.0.0.3:40003#1",
            instance="22" * 16,
            state="linking",
            since_ago=5.0,
            last_error="connection refused",
            next_attempt=1.5,
            conflicts=("shares its name with 10.0.0.9:40003#4; give one of them another --name",),
        ),
    ),
    topics=(
        TopicInfo(
            name="/cmd",
            type="sensor_msgs/Joy",
            md5="5a9ea5f83505693b71e785041e67a8bb",
            subscribers=("/velocity",),
            routes=(
                RouteInfo(
                    peer="joystick",
                    node="/joy_node",
                    direction="in",
                    state="open",
                    type="sensor_msgs/Joy",
                    messages=600,
                    bytes=60_000,
                    last_ago=0.05,
                ),
            ),
        ),
        TopicInfo(
            name="/odom",
            type="nav_msgs/Odometry",
            publishers=("/base_driver",),
            routes=(RouteInfo(peer="joystick", node="/base_driver", direction="out", state="idle"),),
        ),
    ),
    counters={"beacon.malformed": 1},
    notes=("no multicast on eth0",),
)
