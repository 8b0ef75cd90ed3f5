"""``rmpa topic hz|bw|delay``: figures of a stream, once a second, as rostopic words them.

They are measured by this command's own subscriber. Of what comes over the mesh the agent's figures stand behind them:
it notes each message as it comes, before this program is even awake.
"""

from __future__ import annotations

import asyncio
import os
import time
from typing import TYPE_CHECKING, Final

import click

from rmpa.bridge.proxy_names import proxied_node
from rmpa.cli.master import choose_master, read_topic
from rmpa.cli.options import agent_option, json_option, master_option
from rmpa.cli.output import print_json, print_line, size
from rmpa.cli.stream import Enough, StreamWatch, run_stream, watch_topic
from rmpa.cli.topic_figures import arriving, bandwidth_text, latency_text, origin, rate_text
from rmpa.core.errors import RmpaError
from rmpa.core.stats import ArrivalStats, SampleRing, SampleSummary

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.cli.master import Master, TopicName
    from rmpa.observe.snapshot import RouteInfo
    from rmpa.ros.node.node import Received
    from rmpa.ros.types.messages import MessageType

_EVERY: Final = 1.0
"""Seconds between two lines, as rostopic has it."""


class Figures:
    """What one of the commands shows: fed with messages, asked once a second.

    Args:
        window: Over how many messages.
    """

    def __init__(self, window: int) -> None:
        self._shown = 0
        self.flow = ArrivalStats(window)

    def add(self, received: Received, now: float) -> None:
        """One message, at ``now`` (monotonic seconds)."""
        self.flow.arrived(now, len(received.raw))

    def fresh(self) -> bool:
        """Whether messages came since the last time this was asked."""
        fresh = self.flow.messages > self._shown
        self._shown = self.flow.messages
        return fresh

    def values(self, routes: tuple[RouteInfo, ...]) -> dict[str, object]:
        """For JSON, in base units; ``source`` says by what they were measured.

        Args:
            routes: What the agent says of the remote sources.
        """
        return {"source": "subscriber", **self.own(), "routes": routes}

    def own(self) -> dict[str, float]:
        """What the subscriber measured, in base units."""
        raise NotImplementedError

    def text(self) -> str:
        """The same for people."""
        raise NotImplementedError

    def remote(self, route: RouteInfo) -> str:
        """What the agent says of a remote source, for people."""
        raise NotImplementedError


class Rate(Figures):
    """Messages a second."""

    def own(self) -> dict[str, float]:
        """Hz and seconds."""
        p = self.flow.periods()
        return {"rate": self.flow.rate(), "min": p.minimum, "max": p.maximum, "sd": p.sd, "window": p.count + 1}

    def text(self) -> str:
        """As ``rostopic hz``."""
        v = self.own()
        if v["window"] < 2:
            return "one message, no rate yet"
        spread = f"min: {v['min']:.3f}s max: {v['max']:.3f}s std dev: {v['sd']:.5f}s window: {v['window']}"
        return f"average rate: {v['rate']:.3f}\n\t{spread}"

    def remote(self, route: RouteInfo) -> str:
        """Its rate and periods."""
        return f"at the agent, from {origin(route)}: {rate_text(route)}"


class Bandwidth(Figures):
    """Bytes a second."""

    def __init__(self, window: int) -> None:
        super().__init__(window)
        self._sizes = SampleRing(window)

    def add(self, received: Received, now: float) -> None:
        """One message."""
        super().add(received, now)
        self._sizes.add(len(received.raw))

    def own(self) -> dict[str, float]:
        """Bytes, and bytes a second."""
        s = self._sizes.summary()
        rate = self.flow.bandwidth()
        return {"bandwidth": rate, "mean": s.mean, "min": s.minimum, "max": s.maximum, "window": s.count}

    def text(self) -> str:
        """As ``rostopic bw``."""
        v = self.own()
        spread = f"mean: {size(v['mean'])} min: {size(v['min'])} max: {size(v['max'])} window: {v['window']}"
        return f"average: {size(v['bandwidth'])}/s\n\t{spread}"

    def remote(self, route: RouteInfo) -> str:
        """Its bytes."""
        return f"at the agent, from {origin(route)}: {bandwidth_text(route)}"


class Delay(Figures):
    """Age on arrival: by the header's stamp, true as far as both machines' clocks agree; and by the link's clock.

    Messages without a header have an age only if they came over the mesh.
    """

    def __init__(self, window: int, *, by_link: bool) -> None:
        super().__init__(window)
        self._delays = SampleRing(window)
        self._by_link = by_link
        from rmpa.ros.types.messages import MessageType

        # What reads messages takes some 0.3 s to import: at the first one, that would be counted as their delay.
        MessageType("std_msgs/Header").make()

    def add(self, received: Received, now: float) -> None:
        """One message.

        Raises:
            RmpaError: Its type has no header, and it did not come over the mesh.
        """
        super().add(received, now)
        if _has_header(received.kind):
            stamp = received.message.header.stamp
            self._delays.add((received.stamp_ns - stamp.sec * 1_000_000_000 - stamp.nanosec) / 1e9)
        elif not self._by_link or proxied_node(received.caller_id) is None:
            raise RmpaError(f"{received.kind.name} has no header, and so no stamp to tell its age by")

    def values(self, routes: tuple[RouteInfo, ...]) -> dict[str, object]:
        """Seconds; of messages without a header what the link's clock says, if they have one source."""
        if self._delays.total:
            return {"source": "header", "error": None, **self.own(), "routes": routes}
        latency = routes[0].latency if len(routes) == 1 else None
        if latency is None:
            return {"source": "link", "error": None, **self.own(), "routes": routes}
        spread = {"delay": latency.mean, "min": latency.min, "max": latency.max, "sd": latency.sd}
        return {"source": "link", "error": latency.error, **spread, "window": latency.count, "routes": routes}

    def own(self) -> dict[str, float]:
        """Seconds, by the header's stamp."""
        s: SampleSummary = self._delays.summary()
        return {"delay": s.mean, "min": s.minimum, "max": s.maximum, "sd": s.sd, "window": s.count}

    def text(self) -> str:
        """As ``rostopic delay``, with a digit more."""
        if not self._delays.total:
            return "no header, and so no stamp to tell the whole age by"
        v = self.own()
        spread = f"min: {v['min']:.4f}s max: {v['max']:.4f}s std dev: {v['sd']:.5f}s window: {v['window']}"
        return f"average delay: {v['delay']:.4f}\n\t{spread}\n\tby the header's stamp and this machine's clock"

    def remote(self, route: RouteInfo) -> str:
        """Its latency between the agents."""
        return f"by the link's clock, from {origin(route)}: {latency_text(route.latency)}"


def _has_header(kind: MessageType) -> bool:
    return any(field.name == "header" and field.type == "std_msgs/Header" for field in kind.fields)


async def _show(figures: Figures, master: Master, wanted: TopicName, *, as_json: bool) -> None:
    if not figures.fresh():
        if not as_json:
            print_line("no new messages")
        return
    routes = await asyncio.to_thread(arriving, master, wanted)
    if as_json:
        print_json({"topic": str(wanted), **figures.values(routes)}, flush=True)
    else:
        print_line("\n\t".join([figures.text(), *(figures.remote(route) for route in routes)]))


def _watch(
    topic: str,
    make: Callable[[Master], Figures],
    count: int | None,
    agent: str | None,
    master: str | None,
    *,
    as_json: bool,
) -> None:
    wanted = read_topic(topic)
    chosen = choose_master(master, agent, os.environ)
    figures = make(chosen)

    async def body(watch: StreamWatch) -> None:
        if not as_json:
            print_line(f"subscribed to [{wanted}]")
        while not await watch.finished(_EVERY):
            await _show(figures, chosen, wanted, as_json=as_json)
        await _show(figures, chosen, wanted, as_json=as_json)

    def take(received: Received) -> None:
        if figures.flow.messages == count:
            return  # more had come before the node could be left
        figures.add(received, time.monotonic())
        if figures.flow.messages == count:
            raise Enough

    async def run() -> None:
        try:
            await watch_topic(chosen, wanted, take, body)
        except Enough:
            await _show(figures, chosen, wanted, as_json=as_json)

    run_stream(run)


def _shared(window: int) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """The arguments and flags of all three."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        for option in (
            master_option,
            agent_option,
            json_option,
            click.option("-n", "--count", type=click.IntRange(1), help="Stop after so many messages."),
            click.option(
                "-w",
                "--window",
                type=click.IntRange(2, 1_000_000),
                default=window,
                show_default=True,
                help="Over how many messages.",
            ),
            click.argument("topic"),
        ):
            command = option(command)
        return command

    return decorate


@click.command(epilog="\b\nExamples:\n  rmpa topic hz /cmd\n  rmpa topic hz joystick:/cmd -w 100 --json\n")
@_shared(50_000)
def hz(topic: str, window: int, count: int | None, as_json: bool, agent: str | None, master: str | None) -> None:
    """Show how often messages come, once a second until Ctrl-C.

    The first figures are measured by this command, as rostopic does. For each remote source the agent's own follow:
    the arrivals of the last minute over the mesh.
    """
    _watch(topic, lambda _: Rate(window), count, agent, master, as_json=as_json)


@click.command(epilog="\b\nExamples:\n  rmpa topic bw /camera/image_raw -w 30\n  rmpa topic bw base:/map --json\n")
@_shared(100)
def bw(topic: str, window: int, count: int | None, as_json: bool, agent: str | None, master: str | None) -> None:
    """Show how many bytes a second messages need, once a second until Ctrl-C.

    The first figures are measured by this command, as rostopic does. For each remote source the agent's own follow:
    the arrivals of the last minute over the mesh.
    """
    _watch(topic, lambda _: Bandwidth(window), count, agent, master, as_json=as_json)


@click.command(
    epilog="""\
\b
Examples:
  rmpa topic delay base:/odom
  rmpa topic delay /cmd_vel --json | jq '.routes[].latency'   no header is needed over the mesh
"""
)
@_shared(50_000)
def delay(topic: str, window: int, count: int | None, as_json: bool, agent: str | None, master: str | None) -> None:
    """Show how old messages are when they come, once a second until Ctrl-C.

    By the header's stamp, from when the publisher stamped it to here; across machines this is true only as far as
    their clocks agree. And for each remote source by the link's clock, from the publisher's agent to this one: it
    needs no header, the machines' clocks need not agree, and the true values lie within the ± that is shown.
    """
    _watch(
        topic, lambda chosen: Delay(window, by_link=chosen.agent is not None), count, agent, master, as_json=as_json
    )
