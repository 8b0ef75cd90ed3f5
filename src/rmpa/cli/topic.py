"""``rmpa topic list|info|type|find``: the topics of the graph; ``hz|bw|delay``: figures, as rostopic has them."""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import click

from rmpa.cli.graph import (
    Enough,
    marked,
    origin_json,
    origin_text,
    peers_mark,
    peers_of,
    read_name,
    run_stream,
    shown_state,
    unknown_name,
)
from rmpa.cli.options import (
    Options,
    Selection,
    argument,
    by_module,
    count_option,
    flag,
    graph_verb,
    option,
    selection_options,
    topics,
)
from rmpa.cli.output import Painted, Text, duration, print_json, print_text, printable, size, warn
from rmpa.core.errors import RmpaError
from rmpa.core.identity import proxied_peer
from rmpa.core.statistics import SampleSpread
from rmpa.observe.why.diagnosis import UNMEASURED, route_texts, subscriber_text
from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from rmpa.cli.graph import Graph, GraphName, Master
    from rmpa.core.facts import RouteInfo, SubscriberTransport, TopicInfo
    from rmpa.ros.node.node import Received


def ask_agent(master: Master, topic: str) -> TopicInfo | None:
    """What the master's agent knows of a topic; ``None`` without an agent, or if it does not answer."""
    snapshot = master.snapshot(topics=(topic,), peers=False)
    return next((info for info in snapshot.topics if info.name == topic), None) if snapshot is not None else None


def _rate_text(route: RouteInfo) -> str:
    if route.rate is None or route.period is None:
        return "one message, no rate yet" if route.messages == 1 else "nothing in the last minute"
    p = route.period
    return (
        f"{route.rate:.3f} Hz, period {duration(p.mean)} (sd {duration(p.sd)}, min {duration(p.min)}, "
        f"max {duration(p.max)}, p99 {duration(p.p99)}), jitter {duration(route.jitter)}"
    )


def _delay_text(route: RouteInfo) -> str:
    """One-way latency, with the bound of its error."""
    if (latency := route.latency) is None:
        return "unknown yet"
    return (
        f"p50 {duration(latency.p50)}, p99 {duration(latency.p99)}, max {duration(latency.max)}, "
        f"last {duration(latency.last)}; each ± {duration(latency.error)}"
    )


def _bandwidth_text(route: RouteInfo) -> str:
    mean = route.bytes / route.messages if route.messages else None
    return f"{size(route.bandwidth)}/s, {size(mean)} a message" if route.bandwidth is not None else "unknown yet"


def _losses_text(route: RouteInfo) -> str:
    """Messages that did not arrive, by reason."""
    ours = f"{route.dropped} dropped here"
    if route.direction == "in":
        lost = f"{route.lost} lost"
        if unknown := route.events.get("loss_unknown", 0):
            lost = f"loss unknown ({_times(unknown)})" + (f", {route.lost} more lost" if route.lost else "")
        return f"{lost}, {route.late} late, {route.expired} expired, {ours}"
    return f"{route.lost} lost to {route.peer}" if route.contract.get("reliability") == "reliable" else ours


def _interruption_text(one: SubscriberTransport) -> str:
    """How often a subscriber was without its path, and for how long the last time."""
    until = "now" if one.interrupted_ago is None else f"until {duration(one.interrupted_ago)} ago"
    over = f"{duration(one.interrupted)}{' ' if until == 'now' else ', '}{until}"
    return f"interrupted {_times(one.interruptions)}, the last for {over}; what is lost of that time is not counted"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def facts(route: RouteInfo) -> Iterator[tuple[str, str]]:
    """All that the agent knows of a route: label and text of each line."""
    if route.wire:
        yield "there", route.wire
    if not route.subscribers:
        yield from (("transport", text) for text in route_texts(route))
    for one in route.subscribers:
        yield "transport", subscriber_text(one, duration(one.since_ago) if one.since_ago is not None else "")
        if one.interruptions:
            yield "", _interruption_text(one)
        if one.transport == "direct":
            yield "", UNMEASURED
    if route.lane:
        yield "lane", route.lane
    if route.direction == "in" and route.messages:
        yield "rate", _rate_text(route)
        yield "latency", _delay_text(route)
        yield "bandwidth", _bandwidth_text(route)
    if route.messages or route.lost or route.events.get("loss_unknown"):
        yield "missing", _losses_text(route)
    if route.kept:
        yield "waiting", f"{route.kept} messages for {route.peer}"
    if route.oversized:
        where = f"by the agent of {route.peer}" if route.direction == "in" else "here"
        last, most = size(route.oversized_bytes), size(limits.TCPROS_MESSAGE_MAX)
        yield "too long", f"{route.oversized} left out {where}, the last of {last}; at most {most} cross: send parts"
    if route.contract:
        yield "contract", ", ".join(f"{key} {_value(key, value)}" for key, value in route.contract.items())
    if route.events:
        yield "events", ", ".join(f"{kind} {count}" for kind, count in route.events.items())
    yield from (("", f"{duration(event.ago)} ago: {event.kind}: {event.text}") for event in route.recent)


def _value(key: str, value: object) -> str:
    """A contract's value with its unit: only the key says whether a number is a count, a rate or seconds."""
    if not isinstance(value, int | float):
        return str(value)
    if key == "depth":
        return f"{value:.0f}"
    return f"{value:g} Hz" if key == "max_rate" else duration(value)


def _json(graph: Graph, name: str) -> dict[str, object]:
    return {
        "name": name,
        "type": graph.types.get(name),
        "peers": peers_of(graph.publishers.get(name, ())),
        "publishers": [origin_json(node) for node in graph.publishers.get(name, ())],
        "subscribers": [origin_json(node) for node in graph.subscribers.get(name, ())],
    }


@graph_verb(
    argument("namespace", topics, default=""),
    flag("-v --verbose", "Types and counts, publishers and subscribers apart."),
    flag("-p --publishers", "Only topics that have a publisher."),
    flag("-s --subscribers", "Only topics that have a subscriber."),
    selection_options,
)
def topic_list(
    namespace: str, verbose: bool, publishers: bool, subscribers: bool, selection: Selection, options: Options
) -> None:
    """List topics, all or those of a NAMESPACE.

    A topic that peers publish has their names behind it: /cmd  [joystick]. A terminal shows the first of very many,
    this module's own before the others.

    ---

    Examples:
      rmpa topic list
      rmpa topic list -v /camera
      rmpa topic list joystick:/
    """
    wanted = read_name(namespace or "/")
    _, graph = options.graph(wanted)
    peers = {name: peers_of(graph.publishers.get(name, ())) for name in graph.topics}
    names = [
        name
        for name, owners in peers.items()
        if wanted.contains(name, owners)
        and (not publishers or graph.publishers.get(name))
        and (not subscribers or graph.subscribers.get(name))
        and selection.wants(name, owners)
    ]

    def text() -> Iterator[Text]:
        remote = {name for name in names if peers[name] and all(map(proxied_peer, graph.publishers[name]))}
        owners = {peer for name in remote for peer in peers[name]}
        whose = f"the remote ones are of {len(owners):,} module{'s' if len(owners) != 1 else ''}"
        about = (by_module("topics", [name in remote for name in names]), whose)
        shown = selection.first(names, lambda name: (name in remote, name))
        lines: Text = marked(shown, graph.publishers)
        if verbose:
            published = () if subscribers else _verbose("Published", "publisher", graph, graph.publishers, shown)
            subscribed = () if publishers else _verbose("Subscribed", "subscriber", graph, graph.subscribers, shown)
            lines = (published, subscribed)
        filters = "rmpa topic list MODULE:/, /NAMESPACE, --match '*/scan', --peer 'arm*'"
        yield selection.framed(names, "topics", about, filters, lines)

    options.show([_json(graph, name) for name in names] if options.as_json else None, text())


def _verbose(title: str, what: str, graph: Graph, ends: dict[str, list[str]], names: Sequence[str]) -> Iterator[str]:
    yield f"{title} topics:"
    for name in names:
        if name in ends:
            kind, count = printable(graph.types.get(name, "unknown type")), len(ends[name])
            text = f" * {printable(name)} [{kind}] {count} {what}{'s' if count != 1 else ''}"
            yield Painted(text + peers_mark(ends[name]))


def _find(text: str, options: Options) -> tuple[GraphName, Master, Graph]:
    """The topic that a user names, the master, and its graph, which has the topic."""
    wanted = read_name(text)
    master, graph = options.graph(wanted)
    if wanted.name not in graph.publishers and wanted.name not in graph.subscribers:
        raise unknown_name("topic", wanted.name, graph.topics)
    return wanted, master, graph


@graph_verb(argument("topic", topics))
def topic_info(topic: str, options: Options) -> None:
    """Show a topic's type, publishers and subscribers, and what crosses the mesh.

    For each remote publisher the agent measures, over the last minute: rate, period, jitter, bandwidth, losses, and
    the one-way latency from the publisher's agent to this one. The ± is the largest possible error of a latency: the
    other machine's clock is not known exactly. The agent measures only while a node here subscribes.

    ---

    Examples:
      rmpa topic info /cmd
      rmpa topic info joystick:/cmd                       what comes from joystick alone
      rmpa topic info /cmd --json | jq '.mesh.routes[0].latency.p99'
    """
    wanted, master, graph = _find(topic, options)
    crossing = ask_agent(master, wanted.name)
    options.show(_json(graph, wanted.name) | {"mesh": crossing}, _described(graph, wanted, crossing))


def _described(graph: Graph, wanted: GraphName, crossing: TopicInfo | None) -> Iterator[str]:
    yield f"Type: {graph.types.get(wanted.name, 'unknown')}"
    if crossing is not None and crossing.md5:
        yield f"MD5: {crossing.md5}"
    for title, nodes in (("Publishers", graph.publishers), ("Subscribers", graph.subscribers)):
        meant = [node for node in nodes.get(wanted.name, []) if wanted.matches(node) or title == "Subscribers"]
        yield from ("", f"{title}:" + ("" if meant else " none"))
        yield from (f" * {origin_text(node)}" for node in meant)
    if crossing is None:
        return
    nothing = " nothing of it crosses" + (" until a node here publishes it" if crossing.remote_subscribers else "")
    yield from ("", "Mesh:" + ("" if crossing.routes else nothing))
    if crossing.policy:
        yield f" * {'may cross' if crossing.crosses else 'does not cross'}: {crossing.policy}"
    for route in crossing.routes:
        if wanted.peer not in (None, route.peer):
            continue
        yield route_line(route)
        yield from (f"     {label:<10} {text}" for label, text in facts(route))
        if route.problem:
            warn(f"{route.peer} {route.node}: {route.problem}", "route-not-open")
    for trouble in crossing.mismatches:
        warn(trouble, "type-mismatch")
    for trouble in crossing.unreachable:
        warn(trouble, "node-unreachable")


def route_line(route: RouteInfo) -> str:
    """The first line of a route: its ends, its state and what passed it.

    A route without a subscriber here carries nothing: its publisher may send all the same.
    """
    way = "from" if route.direction == "in" else "to"
    if route.direction == "in" and shown_state(route) == "idle":
        passed = ": no node here subscribes, so its messages are not counted"
    elif route.transport == "direct" and not route.messages:
        passed = ""
    else:
        passed = f", {route.messages} messages" + ("" if route.age is None else f", last {duration(route.age)} ago")
    return f" * {way} {route.peer}: {route.node} {shown_state(route)}{passed}"


@graph_verb(argument("topic", topics))
def topic_type(topic: str, options: Options) -> None:
    """Print a topic's type.

    ---

    Examples:
      rmpa topic type /cmd
    """
    wanted, _, graph = _find(topic, options)
    kind = graph.types.get(wanted.name)
    if kind is None:
        raise RmpaError(f"the type of {wanted.name} is not known yet: its publisher gives it", code="unknown-type")
    options.show({"name": wanted.name, "type": kind}, kind)


@graph_verb(argument("kind", metavar="TYPE"))
def topic_find(kind: str, options: Options) -> None:
    """Print the topics of a TYPE.

    ---

    Examples:
      rmpa topic find sensor_msgs/Joy
    """
    _, graph = options.graph()
    found = [name for name in graph.topics if graph.types.get(name) == kind]
    options.show(found, marked(found, graph.publishers))


@dataclass(slots=True)
class _Window:
    """The last messages that this command's own subscriber got: seconds between them, bytes, and ages in seconds.

    Args:
        size: Messages in it.
        messages: All that came.
        last: When the last one came, monotonic seconds.
    """

    size: int
    messages: int = 0
    last: float | None = None
    periods: deque[float] = field(init=False)
    sizes: deque[int] = field(init=False)
    delays: deque[float] = field(init=False)

    def __post_init__(self) -> None:
        self.periods, self.sizes, self.delays = (deque(maxlen=self.size) for _ in range(3))

    def add(self, received: Received, now: float) -> None:
        """One message, at ``now`` (monotonic seconds)."""
        if self.last is not None:
            self.periods.append(now - self.last)
        self.last = now
        self.sizes.append(len(received.raw))
        self.messages += 1

    def add_delay(self, received: Received, *, by_link: bool) -> None:
        """The age of a message, by its header's stamp: exact only as far as both machines' clocks agree.

        Args:
            received: The message.
            by_link: Whether there is an agent, which knows the age of what came over a link, by that link's clock.

        Raises:
            RmpaError: It has no header, and did not come over a link.
        """
        if any(each.name == "header" and each.type == "std_msgs/Header" for each in received.kind.fields):
            stamp = received.message.header.stamp
            self.delays.append((received.stamp_ns - stamp.sec * 1_000_000_000 - stamp.nanosec) / 1e9)
        elif not by_link or proxied_peer(received.caller_id) is None:
            problem = f"{received.kind.name} has no header, so it has no stamp to measure its age by"
            raise RmpaError(problem, code="invalid-value")


def _rate(seen: _Window, _: Sequence[RouteInfo]) -> tuple[dict[str, object], str]:
    """Messages a second, for JSON in Hz and seconds, and in the format of ``rostopic hz``."""
    p = SampleSpread.of(seen.periods)
    rate = 1 / p.mean if p.mean > 0 else math.nan
    values = {"rate": rate, "min": p.min, "max": p.max, "sd": p.sd, "window": p.count + 1}
    spread = f"min: {p.min:.3f}s max: {p.max:.3f}s std dev: {p.sd:.5f}s window: {p.count + 1}"
    text = f"average rate: {rate:.3f}\n\t{spread}" if p.count else "one message, no rate yet"
    return {"source": "subscriber", **values}, text


def _bandwidth(seen: _Window, _: Sequence[RouteInfo]) -> tuple[dict[str, object], str]:
    """Bytes a second, for JSON and in the format of ``rostopic bw``."""
    s, elapsed = SampleSpread.of(seen.sizes), math.fsum(seen.periods)
    first = seen.sizes[0] if len(seen.sizes) > len(seen.periods) else 0  # came before the first period
    rate = (sum(seen.sizes) - first) / elapsed if elapsed > 0 else math.nan
    values = {"bandwidth": rate, "mean": s.mean, "min": s.min, "max": s.max, "window": s.count}
    spread = f"mean: {size(s.mean)} min: {size(s.min)} max: {size(s.max)} window: {s.count}"
    return {"source": "subscriber", **values}, f"average: {size(rate)}/s\n\t{spread}"


def _delay(seen: _Window, routes: Sequence[RouteInfo]) -> tuple[dict[str, object], str]:
    """Ages in seconds; for JSON without headers those of the agent, if there is one remote source.

    The agent knows the clocks' offset. The text is as ``rostopic delay`` has it, with a digit more.
    """
    s = SampleSpread.of(seen.delays)
    error: float | None = None
    text = "no header, so no stamp to measure the whole age by"
    if seen.delays:
        spread = f"min: {s.min:.4f}s max: {s.max:.4f}s std dev: {s.sd:.5f}s window: {s.count}"
        text = f"average delay: {s.mean:.4f}\n\t{spread}\n\tby the header's stamp and this machine's clock"
    elif len(routes) == 1 and (latency := routes[0].latency) is not None:
        s, error = latency, latency.error
    values = {"delay": s.mean, "min": s.min, "max": s.max, "sd": s.sd, "window": s.count}
    return {"source": "header" if seen.delays else "link", "error": error, **values}, text


def _arriving(master: Master, wanted: GraphName) -> tuple[RouteInfo, ...]:
    """The routes of a topic's remote sources from which a message has come."""
    info = ask_agent(master, wanted.name)
    routes = (route for route in (info.routes if info else ()) if route.direction == "in" and route.messages)
    return tuple(route for route in routes if wanted.peer in (None, route.peer))


def _watch(
    measure: Callable[[_Window, Sequence[RouteInfo]], tuple[dict[str, object], str]],
    remote: Callable[[RouteInfo], str],
    topic: str,
    window: int,
    count: int | None,
    options: Options,
    *,
    delays: bool = False,
) -> None:
    """Print figures over a sliding window of messages once a second, if a message came; first a heading.

    For each remote source the agent's figures follow, which are more exact: the agent takes the time of each message
    when it arrives, this program only when it is scheduled.

    Args:
        measure: The figures for JSON, and as text.
        remote: The agent's figures of a remote source as text.
        topic: The topic, as the user names it.
        window: Messages in the window.
        count: Messages after which it ends.
        options: Of the command.
        delays: Whether the ages of messages are measured.
    """
    wanted = read_name(topic)
    master, graph = options.graph(wanted)
    master.warn_unpublished(graph, wanted)
    seen, shown = _Window(window), -1

    def take(received: Received) -> None:
        seen.add(received, time.monotonic())
        if delays:
            seen.add_delay(received, by_link=master.agent is not None)
        if seen.messages == count:
            raise Enough

    async def show() -> None:
        nonlocal shown
        before, shown = shown, seen.messages
        if before in (-1, shown):
            if not options.as_json:
                print_text("no new messages" if before >= 0 else f"subscribed to [{wanted}]")
            return
        routes = await asyncio.to_thread(_arriving, master, wanted)
        values, text = measure(seen, routes)
        if options.as_json:
            print_json({"topic": str(wanted), **values, "routes": routes})
            return
        by = "by the link's clock" if delays else "at the agent"
        lines = (f"{by}, from {printable(f'{each.peer} {each.node}')}: {remote(each)}" for each in routes)
        click.echo("\n\t".join([text, *lines]))

    run_stream(lambda: master.watch(wanted, take, show))


def _figures_verb(window: int) -> Callable[[Callable[..., None]], click.Command]:
    """A ``graph_verb`` of a topic, with ``--window`` and ``--count``."""
    type_ = click.IntRange(2, 1_000_000)
    how_many = "Over how many messages."
    messages = option("-w --window", help=how_many, type=type_, default=window, show_default=True)
    return graph_verb(argument("topic", topics), messages, count_option("messages"))


@_figures_verb(50_000)
def topic_hz(topic: str, window: int, count: int | None, options: Options) -> None:
    """Show the rate of messages, once a second until Ctrl-C.

    The first figures are measured by this command, as rostopic does. Then come the agent's figures for each remote
    publisher: what arrived over the mesh in the last minute.

    ---

    Examples:
      rmpa topic hz /cmd
      rmpa topic hz joystick:/cmd -w 100 --json
    """
    _watch(_rate, _rate_text, topic, window, count, options)


@_figures_verb(100)
def topic_bw(topic: str, window: int, count: int | None, options: Options) -> None:
    """Show the bandwidth of messages, once a second until Ctrl-C.

    The first figures are measured by this command, as rostopic does. For each remote source the agent's own follow:
    the arrivals of the last minute over the mesh.

    ---

    Examples:
      rmpa topic bw /camera/image_raw -w 30
      rmpa topic bw base:/map --json
    """
    _watch(_bandwidth, _bandwidth_text, topic, window, count, options)


@_figures_verb(50_000)
def topic_delay(topic: str, window: int, count: int | None, options: Options) -> None:
    """Show the age of messages when they arrive, once a second until Ctrl-C.

    First by the header's stamp: from the publisher's stamp to here; across machines this is only as exact as their
    clocks agree. Then, for each remote publisher, by the link's clock: from the publisher's agent to this one. That
    needs neither a header nor clocks that agree; ± is the largest possible error.

    ---

    Examples:
      rmpa topic delay base:/odom
      rmpa topic delay /cmd_vel --json | jq '.routes[].latency'   no header is needed over the mesh
    """
    from rmpa.ros.types.messages import MessageType

    # The modules that read messages take 0.3 s to import, which would count as the first message's delay.
    MessageType("std_msgs/Header").make()
    _watch(_delay, _delay_text, topic, window, count, options, delays=True)
