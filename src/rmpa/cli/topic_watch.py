"""``rmpa topic hz|bw|delay``: figures of a stream, once a second, as rostopic words them."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.master import choose_master, read_topic
from rmpa.cli.options import agent_option, json_option, master_option
from rmpa.cli.output import print_json, print_line, size
from rmpa.cli.stream import Enough, Watch, run_stream, watch_topic
from rmpa.core.errors import RmpaError
from rmpa.core.stats import Flow, Ring, Summary

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.ros.aio.node import Received

_EVERY: Final = 1.0
"""Seconds between two lines, as rostopic has it."""


class Figures:
    """What one of the commands shows: fed with messages, asked once a second.

    Args:
        window: Over how many messages.
    """

    def __init__(self, window: int) -> None:
        self._shown = 0
        self.flow = Flow(window)

    def add(self, received: Received, now: float) -> None:
        """One message, at ``now`` (monotonic seconds)."""
        self.flow.arrived(now, len(received.raw))

    def fresh(self) -> bool:
        """Whether messages came since the last time this was asked."""
        fresh = self.flow.messages > self._shown
        self._shown = self.flow.messages
        return fresh

    def values(self) -> dict[str, float]:
        """For JSON, in base units."""
        raise NotImplementedError

    def text(self) -> str:
        """For people."""
        raise NotImplementedError


class Rate(Figures):
    """Messages a second."""

    def values(self) -> dict[str, float]:
        """Hz and seconds."""
        p = self.flow.periods()
        return {"rate": self.flow.rate(), "min": p.minimum, "max": p.maximum, "sd": p.sd, "window": p.count + 1}

    def text(self) -> str:
        """As ``rostopic hz``."""
        v = self.values()
        if v["window"] < 2:
            return "one message, no rate yet"
        spread = f"min: {v['min']:.3f}s max: {v['max']:.3f}s std dev: {v['sd']:.5f}s window: {v['window']}"
        return f"average rate: {v['rate']:.3f}\n\t{spread}"


class Bandwidth(Figures):
    """Bytes a second."""

    def __init__(self, window: int) -> None:
        super().__init__(window)
        self._sizes = Ring(window)

    def add(self, received: Received, now: float) -> None:
        """One message."""
        super().add(received, now)
        self._sizes.add(len(received.raw))

    def values(self) -> dict[str, float]:
        """Bytes, and bytes a second."""
        s = self._sizes.summary()
        rate = self.flow.bandwidth()
        return {"bandwidth": rate, "mean": s.mean, "min": s.minimum, "max": s.maximum, "window": s.count}

    def text(self) -> str:
        """As ``rostopic bw``."""
        v = self.values()
        spread = f"mean: {size(v['mean'])} min: {size(v['min'])} max: {size(v['max'])} window: {v['window']}"
        return f"average: {size(v['bandwidth'])}/s\n\t{spread}"


class Delay(Figures):
    """Age on arrival by the header's stamp: true only as far as both machines' clocks agree."""

    def __init__(self, window: int) -> None:
        super().__init__(window)
        self._delays = Ring(window)
        from rmpa.ros.messages import MessageType

        # What reads messages takes some 0.3 s to import: at the first one, that would be counted as their delay.
        MessageType("std_msgs/Header").make()

    def add(self, received: Received, now: float) -> None:
        """One message.

        Raises:
            RmpaError: Its type has no header.
        """
        super().add(received, now)
        stamp = getattr(getattr(received.message, "header", None), "stamp", None)
        if stamp is None:
            raise RmpaError(f"{received.kind.name} has no header, and so no stamp to tell its age by")
        self._delays.add((received.stamp_ns - stamp.sec * 1_000_000_000 - stamp.nanosec) / 1e9)

    def values(self) -> dict[str, float]:
        """Seconds."""
        s: Summary = self._delays.summary()
        return {"delay": s.mean, "min": s.minimum, "max": s.maximum, "sd": s.sd, "window": s.count}

    def text(self) -> str:
        """As ``rostopic delay``, with a digit more."""
        v = self.values()
        spread = f"min: {v['min']:.4f}s max: {v['max']:.4f}s std dev: {v['sd']:.5f}s window: {v['window']}"
        return f"average delay: {v['delay']:.4f}\n\t{spread}"


def _show(figures: Figures, topic: str, *, as_json: bool) -> None:
    if figures.fresh():
        if as_json:
            print_json({"topic": topic, **figures.values()}, flush=True)
        else:
            print_line(figures.text())
    elif not as_json:
        print_line("no new messages")


def _watch(
    topic: str, figures: Figures, count: int | None, agent: str | None, master: str | None, *, as_json: bool
) -> None:
    wanted = read_topic(topic)
    chosen = choose_master(master, agent, os.environ)

    async def body(watch: Watch) -> None:
        if not as_json:
            print_line(f"subscribed to [{wanted}]")
        while not await watch.finished(_EVERY):
            _show(figures, str(wanted), as_json=as_json)
        _show(figures, str(wanted), as_json=as_json)

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
            _show(figures, str(wanted), as_json=as_json)

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
    """Show how often messages come, once a second until Ctrl-C."""
    _watch(topic, Rate(window), count, agent, master, as_json=as_json)


@click.command(epilog="\b\nExamples:\n  rmpa topic bw /camera/image_raw -w 30\n")
@_shared(100)
def bw(topic: str, window: int, count: int | None, as_json: bool, agent: str | None, master: str | None) -> None:
    """Show how many bytes a second messages need, once a second until Ctrl-C."""
    _watch(topic, Bandwidth(window), count, agent, master, as_json=as_json)


@click.command(epilog="\b\nExamples:\n  rmpa topic delay base:/odom\n")
@_shared(50_000)
def delay(topic: str, window: int, count: int | None, as_json: bool, agent: str | None, master: str | None) -> None:
    """Show how old messages are when they come, by their header's stamp, until Ctrl-C.

    Across machines this is true only as far as their clocks agree: `rmpa peer list` shows by how much they do not.
    """
    _watch(topic, Delay(window), count, agent, master, as_json=as_json)
