"""``rmpa topic echo``, ``hz``, ``bw`` and ``delay``: what listens to messages.

``rmpa topic echo``: prints messages as they arrive.
"""

from __future__ import annotations

import asyncio
import csv
import io
import math
import sys
import time
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.messages import flatten, pick, shorten, to_text
from rmpa.cli.options import GraphOptions, completes, graph_options
from rmpa.cli.output import Graph, GraphName, print_json, read_graph, read_name, require_peer, size, warn_unpublished
from rmpa.cli.resource import Enough, StreamWatch, run_stream, watch_topic
from rmpa.cli.topic import arriving, bandwidth_text, latency_text, origin, rate_text
from rmpa.core.counters import SampleSummary
from rmpa.core.errors import RmpaError
from rmpa.core.identity import proxied_node, proxied_peer

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.cli.output import Master
    from rmpa.observe.snapshot import RouteInfo
    from rmpa.ros.node.node import Received
    from rmpa.ros.types.messages import MessageType, Plain


@dataclass
class _MessagePrinter:
    """Prints messages in one form and counts them.

    Args:
        form: ``text``, ``csv`` or ``json``.
        noarr: Print the length of an array in place of its elements.
        nostr: Print the length of a string in place of its text.
        clear: Clear the terminal before each message.
    """

    form: str
    noarr: bool
    nostr: bool
    clear: bool
    count: int = 0

    def show(self, received: Received, wanted: GraphName, path: list[str]) -> None:
        """Print a message, or the field of it at ``path``."""
        plain = shorten(pick(received.plain, path), arrays=self.noarr, strings=self.nostr)
        self.count += 1
        if self.form == "json":
            proxy = proxied_node(received.caller_id)
            source = {"node": received.caller_id} if proxy is None else {"peer": proxy[0], "node": proxy[1]}
            line: dict[str, Plain] = {"topic": str(wanted), **source, "time": received.stamp_ns / 1e9}
            print_json(line | {"message": plain})
        elif self.form == "csv":
            columns = list(flatten(plain))
            if self.count == 1:
                click.echo(_csv(["%time", *(name for name, _ in columns)]))
            click.echo(_csv([str(received.stamp_ns), *(cell for _, cell in columns)]))
        else:
            if self.clear:
                click.clear()
            click.echo(to_text(plain) + "\n---")


def _csv(cells: list[str]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


def split_field(text: str, graph: Graph) -> tuple[GraphName, list[str]]:
    """Split ``/cmd/axes[0]`` into the topic and the path of a field, by the topics that the graph has.

    Raises:
        ConfigError: It is no topic's name.
    """
    peer, colon, rest = text.rpartition(":")
    parts = rest.strip("/").split("/")
    for end in range(len(parts), 0, -1):
        topic = "/" + "/".join(parts[:end])
        if topic in graph.publishers or topic in graph.subscribers:
            return read_name(f"{peer}{colon}{topic}"), parts[end:]
    return read_name(text), []


@click.command(
    epilog="""\
\b
Examples:
  rmpa topic echo /cmd                 all messages, all sources
  rmpa topic echo joystick:/cmd -n 1   one message of peer joystick
  rmpa topic echo /odom/pose/pose      one field
  rmpa topic echo /odom -p > odom.csv  a table
  rmpa topic echo /cmd --json | jq .message.axes
"""
)
@click.argument("topic", shell_complete=completes("topic"))
@click.option("-n", "--count", type=click.IntRange(1), help="Stop after so many messages.")
@click.option("-p", "--plot", is_flag=True, help="Comma-separated values, for plotting.")
@click.option("--noarr", is_flag=True, help="Leave arrays out.")
@click.option("--nostr", is_flag=True, help="Leave strings out.")
@click.option("-c", "--clear", is_flag=True, help="Clear the terminal before each message.")
@graph_options
def echo(
    topic: str, count: int | None, plot: bool, noarr: bool, nostr: bool, clear: bool, options: GraphOptions
) -> None:
    """Print messages until Ctrl-C.

    Behind the TOPIC a field may stand: /cmd/axes, /cmd/axes[0].
    """
    form = "json" if options.as_json else "csv" if plot else "text"
    printer = _MessagePrinter(form, noarr, nostr, clear and sys.stdout.isatty())
    master = options.master()
    run_stream(lambda: _echo(master, topic, count, printer))


async def _echo(master: Master, topic: str, count: int | None, printer: _MessagePrinter) -> None:
    graph = await read_graph(master)
    wanted, path = split_field(topic, graph)
    require_peer(master, graph, wanted)
    warn_unpublished(master, graph, wanted)

    def on_message(received: Received) -> None:
        if count is None or printer.count < count:
            printer.show(received, wanted, path)
        if printer.count == count:
            raise Enough

    async def body(watch: StreamWatch) -> None:
        await watch.finished()

    try:
        await watch_topic(master, wanted, on_message, body)
    except Enough:
        return


# ``rmpa topic hz|bw|delay``: figures of a topic, once a second, in rostopic's format.
#
# This command's own subscriber measures them. For each remote source the agent's figures follow, which are more
# exact:
# the agent takes the time of each message when it arrives, this program only when it is scheduled.


_EVERY: Final = 1.0
"""Seconds between two lines, as rostopic has it."""


class _Figures:
    """The figures of one command over a sliding window of messages.

    Args:
        window: Messages in it.
    """

    def __init__(self, window: int) -> None:
        self._shown = self.messages = 0
        self._last: float | None = None
        self._periods: deque[float] = deque(maxlen=window)
        self._sizes: deque[int] = deque(maxlen=window)

    def add(self, received: Received, now: float) -> None:
        """One message, at ``now`` (monotonic seconds)."""
        if self._last is not None:
            self._periods.append(now - self._last)
        self._last = now
        self._sizes.append(len(received.raw))
        self.messages += 1

    def fresh(self) -> bool:
        """Whether a message came since the last call."""
        shown, self._shown = self._shown, self.messages
        return self.messages > shown

    def values(self, routes: tuple[RouteInfo, ...]) -> dict[str, object]:
        """For JSON, in base units; ``source`` is what measured them, ``routes`` the agent's figures."""
        return {"source": "subscriber", **self.own(), "routes": routes}

    def own(self) -> dict[str, float]:
        """The figures of this command's subscriber, in base units."""
        raise NotImplementedError

    def text(self) -> str:
        """The subscriber's figures as text."""
        raise NotImplementedError

    def remote(self, route: RouteInfo) -> str:
        """The agent's figures of a remote source as text."""
        raise NotImplementedError


class _Rate(_Figures):
    """Messages a second, in the format of ``rostopic hz``; Hz and seconds."""

    def own(self) -> dict[str, float]:
        p = SampleSummary.of(self._periods)
        rate = 1 / p.mean if p.mean > 0 else math.nan
        return {"rate": rate, "min": p.minimum, "max": p.maximum, "sd": p.sd, "window": p.count + 1}

    def text(self) -> str:
        v = self.own()
        if v["window"] < 2:
            return "one message, no rate yet"
        spread = f"min: {v['min']:.3f}s max: {v['max']:.3f}s std dev: {v['sd']:.5f}s window: {v['window']}"
        return f"average rate: {v['rate']:.3f}\n\t{spread}"

    def remote(self, route: RouteInfo) -> str:
        return f"at the agent, from {origin(route)}: {rate_text(route)}"


class _Bandwidth(_Figures):
    """Bytes a second, in the format of ``rostopic bw``."""

    def own(self) -> dict[str, float]:
        s, elapsed = SampleSummary.of(self._sizes), math.fsum(self._periods)
        first = self._sizes[0] if len(self._sizes) > len(self._periods) else 0  # came before the first period
        rate = (sum(self._sizes) - first) / elapsed if elapsed > 0 else math.nan
        return {"bandwidth": rate, "mean": s.mean, "min": s.minimum, "max": s.maximum, "window": s.count}

    def text(self) -> str:
        v = self.own()
        spread = f"mean: {size(v['mean'])} min: {size(v['min'])} max: {size(v['max'])} window: {v['window']}"
        return f"average: {size(v['bandwidth'])}/s\n\t{spread}"

    def remote(self, route: RouteInfo) -> str:
        return f"at the agent, from {origin(route)}: {bandwidth_text(route)}"


class _Delay(_Figures):
    """Age on arrival, in seconds.

    By the header's stamp, exact only as far as both machines' clocks agree; and for a remote source by the agent,
    which knows the clocks' offset. Without a header only the latter is known.

    Args:
        window: Messages in it.
        by_link: Whether the master is an agent's core, whose figures may stand in for a header.
    """

    def __init__(self, window: int, *, by_link: bool) -> None:
        super().__init__(window)
        self._delays: deque[float] = deque(maxlen=window)
        self._by_link = by_link
        from rmpa.ros.types.messages import MessageType

        # The modules that read messages take 0.3 s to import, which would count as the first message's delay.
        MessageType("std_msgs/Header").make()

    def add(self, received: Received, now: float) -> None:
        """One message.

        Raises:
            RmpaError: Its type has no header, and it did not come over the mesh.
        """
        super().add(received, now)
        if _has_header(received.kind):
            stamp = received.message.header.stamp
            self._delays.append((received.stamp_ns - stamp.sec * 1_000_000_000 - stamp.nanosec) / 1e9)
        elif not self._by_link or proxied_peer(received.caller_id) is None:
            raise RmpaError(f"{received.kind.name} has no header, and so no stamp to tell its age by")

    def values(self, routes: tuple[RouteInfo, ...]) -> dict[str, object]:
        """Seconds; without headers those of the agent, if there is one remote source."""
        if self._delays:
            return {"source": "header", "error": None, **self.own(), "routes": routes}
        latency = routes[0].latency if len(routes) == 1 else None
        if latency is None:
            return {"source": "link", "error": None, **self.own(), "routes": routes}
        spread = {"delay": latency.mean, "min": latency.min, "max": latency.max, "sd": latency.sd}
        return {"source": "link", "error": latency.error, **spread, "window": latency.count, "routes": routes}

    def own(self) -> dict[str, float]:
        s = SampleSummary.of(self._delays)
        return {"delay": s.mean, "min": s.minimum, "max": s.maximum, "sd": s.sd, "window": s.count}

    def text(self) -> str:
        """As ``rostopic delay``, with a digit more."""
        if not self._delays:
            return "no header, and so no stamp to tell the whole age by"
        v = self.own()
        spread = f"min: {v['min']:.4f}s max: {v['max']:.4f}s std dev: {v['sd']:.5f}s window: {v['window']}"
        return f"average delay: {v['delay']:.4f}\n\t{spread}\n\tby the header's stamp and this machine's clock"

    def remote(self, route: RouteInfo) -> str:
        return f"by the link's clock, from {origin(route)}: {latency_text(route.latency)}"


def _has_header(kind: MessageType) -> bool:
    return any(field.name == "header" and field.type == "std_msgs/Header" for field in kind.fields)


async def _show(figures: _Figures, master: Master, wanted: GraphName, *, as_json: bool) -> None:
    if not figures.fresh():
        if not as_json:
            click.echo("no new messages")
        return
    routes = await asyncio.to_thread(arriving, master, wanted)
    if as_json:
        print_json({"topic": str(wanted), **figures.values(routes)})
    else:
        click.echo("\n\t".join([figures.text(), *(figures.remote(route) for route in routes)]))


def _watch(topic: str, make: Callable[[Master], _Figures], count: int | None, options: GraphOptions) -> None:
    wanted = read_name(topic)
    (master, graph), as_json = options.graph(), options.as_json
    require_peer(master, graph, wanted)
    warn_unpublished(master, graph, wanted)
    figures = make(master)

    async def body(watch: StreamWatch) -> None:
        if not as_json:
            click.echo(f"subscribed to [{wanted}]")
        while not await watch.finished(_EVERY):
            await _show(figures, master, wanted, as_json=as_json)
        await _show(figures, master, wanted, as_json=as_json)

    def take(received: Received) -> None:
        if figures.messages == count:
            return  # further messages arrived before the node was closed
        figures.add(received, time.monotonic())
        if figures.messages == count:
            raise Enough

    async def run() -> None:
        try:
            await watch_topic(master, wanted, take, body)
        except Enough:
            await _show(figures, master, wanted, as_json=as_json)

    run_stream(run)


def _shared(window: int) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate with the arguments and flags of all three commands.

    Args:
        window: The default of ``--window``.
    """
    messages = click.option(
        "-w",
        "--window",
        type=click.IntRange(2, 1_000_000),
        default=window,
        show_default=True,
        help="Over how many messages.",
    )
    count = click.option("-n", "--count", type=click.IntRange(1), help="Stop after so many messages.")
    return lambda command: click.argument("topic", shell_complete=completes("topic"))(
        messages(count(graph_options(command)))
    )


@click.command(epilog="\b\nExamples:\n  rmpa topic hz /cmd\n  rmpa topic hz joystick:/cmd -w 100 --json\n")
@_shared(50_000)
def hz(topic: str, window: int, count: int | None, options: GraphOptions) -> None:
    """Show how often messages come, once a second until Ctrl-C.

    The first figures are measured by this command, as rostopic does. For each remote source the agent's own follow:
    the arrivals of the last minute over the mesh.
    """
    _watch(topic, lambda _: _Rate(window), count, options)


@click.command(epilog="\b\nExamples:\n  rmpa topic bw /camera/image_raw -w 30\n  rmpa topic bw base:/map --json\n")
@_shared(100)
def bw(topic: str, window: int, count: int | None, options: GraphOptions) -> None:
    """Show how many bytes a second messages need, once a second until Ctrl-C.

    The first figures are measured by this command, as rostopic does. For each remote source the agent's own follow:
    the arrivals of the last minute over the mesh.
    """
    _watch(topic, lambda _: _Bandwidth(window), count, options)


@click.command(
    epilog="""\
\b
Examples:
  rmpa topic delay base:/odom
  rmpa topic delay /cmd_vel --json | jq '.routes[].latency'   no header is needed over the mesh
"""
)
@_shared(50_000)
def delay(topic: str, window: int, count: int | None, options: GraphOptions) -> None:
    """Show how old messages are when they come, once a second until Ctrl-C.

    First by the header's stamp: from the publisher's stamp to here, exact across machines only as far as their clocks
    agree. Then, for each remote source, by the link's clock: from the publisher's agent to this one. That needs
    neither a header nor clocks that agree, and the true value lies within the ± that is shown.
    """
    _watch(topic, lambda master: _Delay(window, by_link=master.agent is not None), count, options)
