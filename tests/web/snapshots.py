"""A snapshot with everything in it, and an agent that shows it."""

from __future__ import annotations

import threading

import msgspec

from rmpa.core.errors import UnreachableError
from rmpa.core.facts import (
    BoundInfo,
    EventInfo,
    FilesInfo,
    LatencyInfo,
    LinkInfo,
    RouteInfo,
    ServiceInfo,
    TopicInfo,
    UnreachableInfo,
)
from rmpa.core.statistics import SampleSpread
from rmpa.observe.snapshot import AgentInfo, PeerInfo, Snapshot
from tests.waiting import DEADLINE

SPREAD = SampleSpread(count=60, mean=0.1, sd=0.01, min=0.08, max=0.2, p50=0.1, p99=0.15)
LATENCY = LatencyInfo(
    count=60, mean=0.002, sd=0.001, min=0.001, max=0.01, p50=0.002, p99=0.009, last=0.002, error=0.0005
)
AGENT = AgentInfo(
    name="base",
    guid="10.0.0.1:40001#7",
    instance="0" * 32,
    domain=3,
    core_uri="http://127.0.0.1:11311/",
    version="0.1.0",
    pid=1,
    started=1_000_000.0,
    uptime=100.0,
    cpu=12.5,
    rss=50_000_000,
    files=FilesInfo(open=40, limit=1024, hard=4096, reserved=64, refused=2),
    proxies=4,
)
LINK = LinkInfo(
    remote="10.0.0.2:40001",
    dialled=True,
    up_ago=50.0,
    rtt=0.001,
    clock_offset=-0.25,
    clock_error=0.0005,
    bytes_in=1000,
    bytes_out=2000,
    queued=30,
    dropped=4,
    heard_ago=0.5,
)


def peer(name: str = "arm", **more: object) -> PeerInfo:
    """A linked peer."""
    given: dict[str, object] = {"state": "linked", "link": LINK, "topics_in": 5, "topics_out": 6, **more}
    return PeerInfo(name=name, guid="g", instance="i", since_ago=1.0, **given)  # type: ignore[arg-type]


def route(peer: str = "arm", node: str = "/camera", direction: str = "in") -> RouteInfo:
    """An open route with all figures."""
    return RouteInfo(
        peer=peer,
        node=node,
        direction=direction,
        state="open",
        messages=600,
        bytes=60_000,
        dropped=1,
        lost=2,
        kept=3,
        oversized=4,
        late=5,
        expired=6,
        age=0.05,
        period=SPREAD,
        jitter=0.05,
        latency=LATENCY,
        events={"deadline_missed": 7},
        recent=(EventInfo(kind="deadline_missed", count=1, text="late", ago=3.0),),
    )


BOUND = BoundInfo(kind="topics", limit=10, hidden=8, text="too many")
SERVICE = ServiceInfo(
    name="/set_bool", node="/server", direction="in", peer="arm", calls=9, failed=1, active=1, latency=SPREAD
)
FULL = Snapshot(
    agent=AGENT,
    taken=1_000_100.0,
    peers=(peer(beyond=(BOUND,)), peer("hand", state="linking", link=None)),
    topics=(
        TopicInfo(name="/image", type="sensor_msgs/Image", routes=(route(), route("hand", "/n", "out"))),
        TopicInfo(name="/quiet", crosses=False, mismatches=("md5 sums differ",)),
    ),
    services=(
        SERVICE,
        ServiceInfo(name="/camera/get_loggers", node="/camera", direction="out"),
        ServiceInfo(name="/home", node="/n", direction="out", state="home"),
    ),
    counters={"beacon.malformed": 11},
    notes=("port taken",),
    unreachable=(UnreachableInfo(node="/dead", uri="http://x:1/", problem="refused", ago=20.0),),
)


class Agent:
    """An agent that answers with one snapshot, which a test can stop; counts the questions to it."""

    def __init__(self, core_uri: str = AGENT.core_uri) -> None:
        self.snapshot = msgspec.structs.replace(FULL, agent=msgspec.structs.replace(AGENT, core_uri=core_uri))
        self.now = 0.0
        self.up = True
        self.asked = 0
        self.may_answer = threading.Event()
        self.may_answer.set()

    def clock(self) -> float:
        return self.now

    def read(self) -> Snapshot:
        self.asked += 1
        assert self.may_answer.wait(DEADLINE)
        if not self.up:
            raise UnreachableError("agent", "its socket", "start one with `rmpa up`")
        return self.snapshot
