"""Shows a ``View``: as a table on a terminal, as lines elsewhere, as JSON; and the summary at the end."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import msgspec
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from trail import draw
from watch import TOPICS, View

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.core.statistics import SampleSpread

WIDTH, HEIGHT = 32, 11
"""The trail's drawing, in characters."""
COLOURS = {"linked": "green", "here": "green", "waiting": "yellow", "linking": "yellow"}
NONE = "–"  # noqa: RUF001 - an en dash, as tables have it


def ms(seconds: float | None, digits: int = 2) -> str:
    """``0.41 ms``; a dash for what is not known."""
    return NONE if seconds is None or math.isnan(seconds) else f"{seconds * 1000:.{digits}f} ms"


def live(view: View, trail: Sequence[tuple[float, float]], *, unicode: bool = True) -> RenderableType:
    """The whole screen."""
    where = "at two sites, joined by gateways" if _at_sites(view) else "on one machine"
    title = f"RMPA {where}: four modules, four ROS cores, no master between them   {view.seconds:6.1f} s"
    side = Table.grid(padding=(0, 2))
    heading = view.pose.heading if view.pose else 0.0
    drawing = Group(_pose(view), *draw(trail, heading, WIDTH, HEIGHT, unicode=unicode))
    side.add_row(_modules(view), drawing)
    parts: list[RenderableType] = [Text(title, style="bold"), "", side, _topics(view), _delay(view)]
    parts += [Text(note, style="yellow") for note in view.notes]
    parts.append(Text("Ctrl-C ends it. From a second terminal: make demo-kill MODULE=base", style="dim"))
    return Group(*parts)


def _at_sites(view: View) -> bool:
    return any(module.site for module in view.modules.values())


def _modules(view: View) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    sites = ("site",) if _at_sites(view) else ()
    for name in ("module", "state", "for", "first", "profile", *sites):
        table.add_column(name, justify="right" if name in {"for", "first"} else "left", no_wrap=True)
    for name, module in view.modules.items():
        state = Text(module.state, style=COLOURS.get(module.state, "bold red"))
        first = NONE if module.first_message is None else f"{module.first_message:.2f} s"
        site = (module.site or "here",) if sites else ()
        table.add_row(name, state, f"{module.since:.0f} s", first, module.profile or NONE, *site)
    for restart in view.restarts[-3:]:
        table.add_row(Text(_restart(restart.module, restart.seen_gone_after, restart.back_after), style="dim"))
    return table


def _topics(view: View) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    table.add_column("times in ms", no_wrap=True)
    for heading in ("n", "Hz", "period", "sd", "latency", "p99", "max"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, topic in view.topics.items():
        period, latency = topic.period, topic.latency
        rate = Text(f"{topic.rate:.1f}", style="" if topic.rate else "bold red")
        times = [period.mean, period.sd, *([latency.p50, latency.p99, latency.max] if latency else [None] * 3)]
        table.add_row(name, str(topic.messages), rate, *(_number(seconds) for seconds in times))
    return table


def _number(seconds: float | None) -> str:
    return NONE if seconds is None or math.isnan(seconds) else f"{seconds * 1000:.2f}"


def _delay(view: View) -> Text:
    return Text(f"CMD→VEL at the pc: {_spread(view.command_to_velocity)}, {view.unanswered} unanswered")


def _spread(summary: SampleSpread) -> str:
    mean, sd, p99 = ms(summary.mean), ms(summary.sd), ms(summary.p99)
    return f"mean {mean}, sd {sd}, p99 {p99}" if summary.count else "nothing yet"


def _pose(view: View) -> Text:
    pose = view.pose
    if pose is None:
        return Text("no odometry yet", style="dim")
    return Text(f"x {pose.x:+.2f} y {pose.y:+.2f} m {math.degrees(pose.heading):+4.0f}° {pose.speed:.2f} m/s")


def _restart(module: str, gone: float | None, back: float | None) -> str:
    text = f"{module} killed"
    if gone is not None:
        text += f", seen gone after {gone:.2f} s"
    return text + (f", back {back:.2f} s after its start" if back is not None else "")


def line(view: View) -> str:
    """One line, for a file or a pipe."""
    modules = (
        f"{name}:{m.state}" + (f"/{m.profile}" if m.profile else "") + (f"@{m.site}" if m.site else "")
        for name, m in view.modules.items()
    )
    parts = [f"{view.seconds:5.0f} s ", " ".join(modules)]
    for name, topic in view.topics.items():
        latency = f" {ms(topic.latency.p50)}" if topic.latency else ""
        parts.append(f"{TOPICS[name].label} {topic.rate:.1f} Hz{latency}")
    parts.append(f"CMD→VEL {ms(view.command_to_velocity.mean)}")
    if view.pose:
        parts.append(f"x {view.pose.x:+.2f} y {view.pose.y:+.2f}")
    return " | ".join(parts)


def json_line(view: View) -> str:
    """The view as one JSON object; what is not known is ``null``."""
    return msgspec.json.encode(view).decode()


def json_summary(view: View) -> str:
    """The same of the whole run, as ``{"summary": …}``."""
    return msgspec.json.encode({"summary": view}).decode()


def summary(view: View) -> list[RenderableType]:
    """What stays on the screen."""
    lines: list[RenderableType] = [
        Text(f"Summary of {view.seconds:.1f} s", style="bold"),
        _topics(view),
        _delay(view),
    ]
    starts = [f"{name} {m.first_message:.2f} s" for name, m in view.modules.items() if m.first_message is not None]
    if starts:
        lines.append(f"First message at the pc after the start: {', '.join(starts)}")
    lines += [_restart(r.module, r.seen_gone_after, r.back_after) for r in view.restarts]
    if view.pose:
        lines.append(_pose(view))
    return lines
