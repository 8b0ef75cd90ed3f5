"""What sites cost: messages node to node across two gateways and a router, faults, idling, conversion to ROS 2.

Two sites stand behind NAT in network namespaces; the router between them is one of RMPA's. A bare pair of Zenoh
programs in Python takes the same cables and a bare router, in turns with the sites.
"""

from __future__ import annotations

import os
import signal
import statistics
import sys
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import psutil

from lab import samples
from lab.bed import namespaces
from lab.bed.bench import TEST_NODES, Bed
from lab.bed.gateways import ROUTER_PORT, GatewayProcess, JoinedSites
from lab.bed.ros import NODES, Ros
from lab.bench.contenders import RoundTripPath, nodes, through
from lab.bench.throughput import Count, FloodWay, rate_of
from lab.findings import Claim
from lab.results import finish
from lab.tables import percentiles, size, table_of, usage_table
from lab.usage import Meter, Usage, add

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rich.console import Console

    from lab.bed.processes import Process

# What ``--only`` can choose.
PARTS: Final = ("latency", "throughput", "faults", "idle", "conversion")
_MB: Final = 1024 * 1024
_MODULES: Final = {"warehouse": "arm", "yard": "base"}
_BARE_PORT: Final = 7448
_PAIR_FACTOR: Final = 2.5
_RATE_TARGET: Final = 25_000.0
_STREAM_TARGET: Final = 150.0
_PACE: Final = 30_000.0
_PACE_ALONE: Final = 45_000.0
_KILLED_TARGET: Final = 0.2
_FROZEN_TARGET: Final = 1.5
_START_TARGET: Final = 1.0
_CPU_TARGET: Final = 1.0
_RSS_TARGET: Final = 90.0
_ODOMETRY_TARGET: Final = 15.0
_IMAGE_TARGET: Final = 300.0
_SETTLE: Final = 2.0
_DEADLINE: Final = 30.0


@dataclass(frozen=True, slots=True)
class GatewayPlan:
    """How much is measured.

    Args:
        trips: Round trips of each way at 64 B, over all rounds.
        rounds: Turns of each way.
        seconds: Of each window of throughput, and of idling four times that.
        faults: Kills and freezes.
        conversions: Of each message.
    """

    trips: int
    rounds: int
    seconds: float
    faults: int
    conversions: int


FULL: Final = GatewayPlan(6000, 6, 5.0, 15, 2000)
QUICK: Final = GatewayPlan(600, 2, 2.0, 3, 200)


@dataclass(slots=True)
class _Run:
    """What the parts share."""

    plan: GatewayPlan
    console: Console
    result: dict[str, object] = field(default_factory=dict)
    claims: list[Claim] = field(default_factory=list)


def why_no_sites() -> str:
    """Why sites cannot be measured here, or an empty string."""
    try:
        import zenoh  # noqa: F401 - whether it is there
    except ImportError:
        return "no eclipse-zenoh here (pip install -c constraints.txt -e '.[zenoh]')"
    return namespaces.why_no_nat()


def measure(quick: bool, console: Console, json: Path | None = None, only: Sequence[str] = ()) -> dict[str, object]:
    """Measure all parts or ``only`` these, print the tables, write the file; return the result."""
    run = _Run(QUICK if quick else FULL, console)
    for name, part in _PARTS.items():
        if name in (only or PARTS):
            console.print(name, style="dim")
            part(run)
    return finish(console, "gateway", asdict(run.plan), run.result, json, claims=run.claims)


def _sites(bed: Bed, stack: ExitStack) -> tuple[JoinedSites, list[Ros]]:
    """Both sites, linked, with a user's shell at each module."""
    net = JoinedSites(bed.lab, bed.home, stack, _MODULES, log_level="warning")
    for site in net.sites:
        site.module.wait_peer(site.gateway.name)
    return net, [bed.shell(site.module.host) for site in net.sites]


# --- latency ------------------------------------------------------------------------------------------------------


def _latency(run: _Run) -> None:
    """Ways take turns: two sites, a bare pair through a router and straight, two agents alone."""
    taken: dict[str, list[float]] = {}
    lost: dict[str, int] = {}
    usage: dict[str, dict[str, Usage]] = {}
    with Bed() as bed, ExitStack() as stack:
        net, shells = _sites(bed, stack)
        between = {"router": net.router.process}
        for site in net.sites:
            between |= {site.module.name: site.module.process, site.gateway.name: site.gateway.process}
        ways = [
            nodes("sites", "roscpp, two gateways and a router", shells[0], shells[1], "roscpp", between),
            _bare_pair(bed, net, "routed"),
            _bare_pair(bed, net, "direct"),
            through("agents", "roscpp, two agents, two hosts", "relay", network=9)(bed),
        ]
        for turn in range(run.plan.rounds):
            for way in [*ways[turn % len(ways) :], *ways[: turn % len(ways)]]:
                with way.awake():
                    way.round(64, 20, bed.home / "trips")
                    trips, gone, used = way.round(64, run.plan.trips // run.plan.rounds, bed.home / "trips")
                taken.setdefault(way.key, []).extend(trip / 2000 for trip in trips)
                lost[way.key] = lost.get(way.key, 0) + gone
                usage[way.key] = add(usage.get(way.key, {}), used)
    titles = {way.key: way.title for way in ways}
    found = {key: samples.summary(times, lost[key]) for key, times in taken.items()}
    table = table_of("one way, 64 B, µs", ("between",), ("p50", "p95", "p99", "p99.9", "max", "trips", "lost"))
    for key, title in titles.items():
        table.add_row(title, *percentiles(found[key]), str(found[key].count), str(found[key].lost))
    run.console.print(table)
    rows = [(title, usage[key], len(taken[key])) for key, title in titles.items()]
    run.console.print(usage_table("processes on the path, 64 B", rows, "round trip"))
    run.result["latency_us"] = {key: asdict(one) for key, one in found.items()}
    sites, routed, agents = (found[key].p50 or 0.0 for key in ("sites", "routed", "agents"))
    text = "64 B, p50, (two sites less a relay at each) / a bare Zenoh pair by a router"
    run.claims.append(Claim(text, round((sites - 2 * agents) / routed, 3), _PAIR_FACTOR))


def _bare_pair(bed: Bed, net: JoinedSites, kind: str) -> RoundTripPath:
    """Two Zenoh programs: clients of a bare router, one at each site; or two peers at the router's host."""
    shells = [bed.shell(site.network.host(bed.lab, f"{kind}-{site.name}")) for site in net.sites]
    fleet = bed.shell(net.fleet)
    python: list[str | Path] = [sys.executable]
    processes: dict[str, Process] = {}
    if kind == "routed":
        listen = f"tcp/0.0.0.0:{_BARE_PORT}"
        processes["router"] = fleet.start(*python, NODES / "zenoh_router.py", listen, name="bare router")
        processes["router"].wait_event("up")
        words = [f"tcp/{net.fleet.address}:{_BARE_PORT}", "--through"]
    else:
        shells, words = [fleet, fleet], [str(_BARE_PORT + 1)]
    pong = shells[1].start(*python, NODES / "ping_zenoh.py", "serve", *words, name=f"{kind} pong")
    pong.wait_event("up")
    ping = shells[0].start(*python, NODES / "ping_zenoh.py", "ping", *words, name=f"{kind} ping", commands=True)
    ping.wait_event("ready", _DEADLINE)
    title = "bare Zenoh pair, by a router, behind NAT" if kind == "routed" else "bare Zenoh pair, straight, one host"
    return RoundTripPath(kind, title, ping, {"ping": ping, **processes, "pong": pong})


# --- throughput ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Load:
    """One way of messages from a node to a Zenoh program that is connected to a gateway.

    Args:
        title: What tables call it.
        size: Bytes of a message.
        rate: Messages a second; 0: as fast as roscpp takes them.
        alone: Whether the gateway has a core of its own, and all others share the other one.
    """

    title: str
    size: int = 64
    rate: float = 0.0
    alone: bool = False


_LOADS: Final = (
    _Load("a gateway, flat out"),
    _Load("a gateway, paced", rate=_PACE),
    _Load("the same, the gateway with a core of its own", rate=_PACE_ALONE, alone=True),
    _Load("a gateway, flat out", size=_MB),
)


def _throughput(run: _Run) -> None:
    """To a far node across both gateways, and to a Zenoh program that is connected to one gateway.

    All processes share the cores of this machine. Flat out, roscpp makes several times what arrives, and the cores
    are busy with that: so the rate through a gateway is measured with a publisher paced a little above the target.
    """
    table = table_of("throughput", ("way", "size"), ("messages/s", "MB/s", "sent/s", "not arrived, %"))
    rows: list[dict[str, object]] = []
    usages: list[tuple[str, dict[str, Usage], int]] = []
    for bytes_each in (64, _MB):
        with Bed() as bed, ExitStack() as stack:
            net, shells = _sites(bed, stack)
            path = [net.sites[0].module, net.sites[0].gateway, net.router, net.sites[1].gateway, net.sites[1].module]
            way = FloodWay(shells[0], shells[1], path)
            window = way.window(bytes_each, run.plan.seconds)
        named = {f"agent {number}": one.name for number, one in enumerate(path, 1)}
        used = {named.get(name, name): one for name, one in window.usage.items()}
        usages.append((f"two gateways, {size(bytes_each)}", used, int(window.received * run.plan.seconds)))
        figures = [window.received, window.received * bytes_each / 1e6, window.sent, 100 * window.lost]
        table.add_row("node to node, two gateways, flat out", size(bytes_each), *(f"{one:.1f}" for one in figures))
        rows.append({"way": "sites", "bytes": bytes_each, "messages_per_s": window.received, "lost": window.lost})
    for load in _LOADS:
        with Bed() as bed, ExitStack() as stack:
            received, sent, usage = _through_one(bed, stack, load, run.plan.seconds)
        figures = [received, received * load.size / 1e6, sent, 100 * max(0.0, 1 - received / sent)]
        table.add_row(f"node to a Zenoh program, {load.title}", size(load.size), *(f"{one:.1f}" for one in figures))
        rows.append({"way": load.title, "bytes": load.size, "messages_per_s": received, "sent_per_s": sent})
        rows[-1]["us_per_message"] = {name: 1e6 * one.cpu / one.wall / received for name, one in usage.items()}
        usages.append((f"{load.title}, {size(load.size)}", usage, int(received * run.plan.seconds)))
        if load.rate and not load.alone:
            text = "through a gateway, 64 B, all processes on the same cores, messages/s"
            run.claims.append(Claim(text, round(received), _RATE_TARGET, at_least=True))
        elif load.size == _MB:
            text = f"through a gateway, {size(load.size)}, MB/s"
            run.claims.append(Claim(text, round(received * load.size / 1e6), _STREAM_TARGET, at_least=True))
    run.console.print(table)
    run.console.print(usage_table("processes, which share the cores", usages, "message that arrived"))
    run.result["throughput"] = rows


def _through_one(bed: Bed, stack: ExitStack, load: _Load, seconds: float) -> tuple[float, float, dict[str, Usage]]:
    """Messages a second that a Zenoh program counts and that the node sent, and the usage between."""
    here, there = bed.lab.hosts("arm", "reader")
    agent = bed.agent(here, name="arm")
    flags = ["--site", "warehouse", "--router", "--listen", f"tcp/0.0.0.0:{ROUTER_PORT}", "--insecure"]
    gateway = GatewayProcess(bed.lab.host("gate", 0), bed.home, name="gate", log_level="warning", flags=flags)
    stack.enter_context(gateway)
    gateway.start()
    gateway.wait_ready()
    agent.wait_peer(gateway.name)
    words = [f"tcp/{gateway.host.address}:{ROUTER_PORT}", "rmpa/1/warehouse/arm/t/*/flood"]
    counter = bed.shell(there).start(sys.executable, NODES / "zenoh_counter.py", *words, name="zenoh counter")
    counter.wait_event("up", _DEADLINE)
    flood = bed.shell(here).roscpp("flood", size=load.size, queue=10_000 if load.size == 64 else 50, rate=load.rate)
    counter.wait_event("window", _DEADLINE, where=lambda event: int(str(event["count"])) > 0)
    pids = {"publisher": flood.pid, "agent": agent.pid, "gateway": gateway.pid, "reader": counter.pid}
    if load.alone:
        _part_cores(gateway.pid, [pid for name, pid in pids.items() if name != "gateway"])
    time.sleep(_SETTLE)
    meter = Meter(pids)
    before = len(counter.events("window")), len(flood.events("sent"))
    time.sleep(seconds)
    usage = meter.read()
    came, went = ([_count(e) for e in one.events(kind)] for one, kind in ((counter, "window"), (flood, "sent")))
    return rate_of(came[before[0] - 1], came[-1]), rate_of(went[before[1] - 1], went[-1]), usage


def _part_cores(alone: int, others: Sequence[int]) -> None:
    """Give one process a core, with all its threads, and the others the remaining ones."""
    first, *rest = sorted(os.sched_getaffinity(0))
    for pid, cores in ((alone, [first]), *((pid, rest or [first]) for pid in others)):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            os.sched_setaffinity(int(thread.name), cores)


def _count(event: dict[str, object]) -> Count:
    return Count(int(str(event["ns"])), int(str(event["count"])), 0)


# --- faults -------------------------------------------------------------------------------------------------------


def _faults(run: _Run) -> None:
    """From the signal until the far master no longer lists the node: a module killed, a site frozen."""
    taken: dict[str, list[float]] = {"module killed": [], "site frozen": []}
    with Bed() as bed, ExitStack() as stack:
        net, shells = _sites(bed, stack)
        watcher = shells[1].rospy("watcher", nodes=TEST_NODES, period=0.005)
        watcher.wait_event("up")
        shells[0].roscpp("talker", "__name:=steady", nodes=TEST_NODES, topic="/steady", rate=50)
        proxy = "/rmpa/warehouse/arm/steady"
        warehouse = net.sites[0]
        for _ in range(run.plan.faults):
            for what, times in taken.items():
                _wait(watcher, "there", proxy)
                time.sleep(_SETTLE)  # the core has stored the talker, which does not register anew
                since = watcher.mark_events()
                begun = time.monotonic_ns()
                if what == "module killed":
                    warehouse.module.process.send(signal.SIGKILL)
                else:
                    warehouse.gateway.freeze()
                times.append((_wait(watcher, "gone", proxy, since) - begun) / 1e9)
                if what == "module killed":
                    warehouse.module.restart()
                    warehouse.module.wait_peer(warehouse.gateway.name)
                else:
                    warehouse.gateway.thaw()
                watcher.wait_event("there", _DEADLINE, where=lambda e: e["node"] == proxy, since=since)
    table = table_of("until the other site knows, s", ("what",), ("median", "best", "worst", "times"))
    for what, times in taken.items():
        cells = (f"{one:.3f}" for one in (statistics.median(times), min(times), max(times)))
        table.add_row(what, *cells, str(len(times)))
    run.console.print(table)
    run.result["faults_s"] = taken
    for what, limit in (("module killed", _KILLED_TARGET), ("site frozen", _FROZEN_TARGET)):
        text = f"{what}, seen at the other site, median, s"
        run.claims.append(Claim(text, round(statistics.median(taken[what]), 3), limit))


def _wait(watcher: Process, kind: str, node: str, since: int = 0) -> int:
    event = watcher.wait_event(kind, _DEADLINE, where=lambda e: e["node"] == node, since=since)
    return int(str(event["ns"]))


# --- start and idle -----------------------------------------------------------------------------------------------


def _idle(run: _Run) -> None:
    """From exec to READY=1, and what gateways cost while nothing happens."""
    span = 4 * run.plan.seconds
    with Bed() as bed, ExitStack() as stack:
        net, _ = _sites(bed, stack)
        gateways = {one.name: one for one in (net.router, *(site.gateway for site in net.sites))}
        starts, busy = [], []
        for _ in range(run.plan.rounds):
            net.sites[1].gateway.terminate()
            net.sites[1].gateway.restart()
            starts.append(net.sites[1].gateway.ready_after)
            times = psutil.Process(net.sites[1].gateway.pid).cpu_times()
            busy.append(times.user + times.system)
        far = net.sites[1].module
        far.wait_peer(net.sites[1].gateway.name)
        time.sleep(2 * _SETTLE)
        meter = Meter({name: one.pid for name, one in gateways.items()})
        time.sleep(span)
        usage = meter.read()
    table = table_of(f"idle over {span:.0f} s", ("gateway",), ("CPU, %", "RSS, MB"))
    for name, used in usage.items():
        table.add_row(name, f"{used.percent:.2f}", f"{used.rss / 1e6:.1f}")
    run.console.print(table)
    start = statistics.median(starts)
    run.result["idle"] = {name: {"cpu_percent": one.percent, "rss_mb": one.rss / 1e6} for name, one in usage.items()}
    run.result["start_s"], run.result["start_cpu_s"] = starts, busy
    run.console.print(f"gateway, processor time until READY=1, median: {statistics.median(busy):.2f} s")
    run.claims += [
        Claim("gateway, exec to READY=1, median, s", round(start, 3), _START_TARGET),
        Claim("worst idle gateway, % of a core", round(max(one.percent for one in usage.values()), 3), _CPU_TARGET),
        Claim("worst idle gateway, RSS, MB", round(max(one.rss for one in usage.values()) / 1e6, 1), _RSS_TARGET),
    ]


# --- conversion ---------------------------------------------------------------------------------------------------


def _conversion(run: _Run) -> None:
    """In this process: there and back, each call timed by processor time."""
    from rmpa.gateway.ros2.conversion import Conversion
    from rmpa.gateway.ros2.pairs import TypeMapping
    from rmpa.gateway.ros2.types import Ros2Types
    from rmpa.ros.types.messages import MessageType

    types, mapping = Ros2Types("jazzy"), TypeMapping()
    image = {"height": 512, "width": 683, "encoding": "rgb8", "step": 2049, "data": bytes(range(256)) * 4098}
    table = table_of("conversion, µs of processor time, median", ("message", "bytes"), ("to ROS 2", "to ROS 1"))
    result: dict[str, object] = {}
    cases: tuple[tuple[str, dict[str, Any], float], ...] = (
        ("std_msgs/String", {"data": "hello"}, 0.0),
        ("nav_msgs/Odometry", {}, _ODOMETRY_TARGET),
        ("sensor_msgs/CameraInfo", {}, 0.0),
        ("visualization_msgs/Marker", {}, 0.0),
        ("sensor_msgs/Image", image, _IMAGE_TARGET),
    )
    for name, values, limit in cases:
        kind = MessageType(name)
        pair = mapping.message(name, types)
        assert pair is not None, name
        conversion = Conversion(kind, pair.name, types, pair.fields)
        raw = bytes(kind.serialize(kind.make(values)))
        cdr = conversion.to_ros2(raw)
        there = _median_us(partial(conversion.to_ros2, raw), run.plan.conversions)
        back = _median_us(partial(conversion.to_ros1, cdr), run.plan.conversions)
        table.add_row(name, size(len(raw)), f"{there:.1f}", f"{back:.1f}")
        result[name] = {"bytes": len(raw), "to_ros2_us": there, "to_ros1_us": back}
        if limit:
            run.claims.append(Claim(f"{name}, conversion, µs, the slower way", round(max(there, back), 1), limit))
    run.console.print(table)
    run.result["conversion"] = result


def _median_us(call: Callable[[], object], count: int) -> float:
    times = []
    for _ in range(count):
        begun = time.thread_time_ns()
        call()
        times.append((time.thread_time_ns() - begun) / 1000)
    return statistics.median(times)


_PARTS: Final[dict[str, Callable[[_Run], None]]] = dict(
    zip(PARTS, (_latency, _throughput, _faults, _idle, _conversion), strict=True)
)
