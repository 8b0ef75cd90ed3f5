"""The data of the module *pc*: figures of every topic, the peers, the robot's pose. No I/O; ``now`` is an argument.

Times are seconds. ``now`` is the system's monotonic clock, which all processes of one machine share.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.core.statistics import SampleSpread

if TYPE_CHECKING:
    from collections.abc import Mapping

RECENT = 100
"""Samples behind the live figures."""
WHOLE = 20_000
"""Samples behind the summary: some 400 s of odometry."""
SILENT = 1.0
"""After this long without a message a topic's live rate is 0."""
ORDER_DUE = 0.09
"""A command that got no order within (almost) its period got none: the next order answers the next command."""
SETTLING = 1.0
"""What comes in the first second after a module's (or the pc's) start is counted but makes no figures: links and
routes open, and what waited for them comes in a heap."""
IN_FLIGHT = 0.05
"""A message that comes this soon after a module's start is still from the run before: no process starts so fast."""
TRAIL = 600
"""Points of the trail, ten a second."""
NOTES = 4
"""Notes that are shown."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of the demo: its label, its type, and the modules that must live for it to flow, its source last.

    ``stamped``: whether its messages have a header, whose stamp tells their latency.
    """

    label: str
    type: str
    needs: tuple[str, ...]
    stamped: bool = True


TOPICS = {
    "/command_information": Topic("CMD", "sensor_msgs/Joy", ("joystick",)),
    "/velocity_order": Topic("VEL", "geometry_msgs/Twist", ("joystick", "velocity"), stamped=False),
    "/odom": Topic("ODOM", "nav_msgs/Odometry", ("base",)),
}
COMMAND, ORDER = "/command_information", "/velocity_order"
MODULES = ("joystick", "velocity", "base", "pc")
HERE = "pc"


@dataclass(frozen=True, slots=True)
class TopicView:
    """A topic's figures.

    ``latency`` is one way, from the header's stamp to here; of a type without header between the agents, as ours
    measures it by the link's clock. ``None``: nothing is known yet.
    """

    messages: int
    rate: float
    period: SampleSpread
    latency: SampleSpread | None


@dataclass(frozen=True, slots=True)
class ModuleView:
    """A module.

    ``state`` is ``waiting`` (not seen yet), ``here`` (the pc itself), ``linked`` or another word of the pc's agent,
    or ``gone``; ``since`` so many seconds. ``first_message`` came so many seconds after the module's last start.
    ``profile`` is the System Profile that its resource runs; empty: not known. ``site`` is the other site that it is
    at; empty: it is at the pc's.
    """

    state: str
    since: float
    first_message: float | None
    profile: str = ""
    site: str = ""


@dataclass(frozen=True, slots=True)
class PoseView:
    """Where the robot says it is: m and rad, m/s and rad/s."""

    x: float
    y: float
    heading: float
    speed: float
    turn: float


@dataclass(slots=True)
class Restart:
    """One kill of a module: when (seconds of the demo), how soon it was seen gone, how soon it was back."""

    module: str
    killed: float
    seen_gone_after: float | None = None
    back_after: float | None = None


@dataclass(frozen=True, slots=True)
class View:
    """All of it at one moment."""

    seconds: float
    modules: dict[str, ModuleView]
    topics: dict[str, TopicView]
    command_to_velocity: SampleSpread
    unanswered: int
    """Commands without an order in time."""
    pose: PoseView | None
    restarts: tuple[Restart, ...]
    notes: tuple[str, ...]


@dataclass(slots=True)
class _Samples:
    recent: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))
    whole: deque[float] = field(default_factory=lambda: deque(maxlen=WHOLE))

    def add(self, sample: float) -> None:
        self.recent.append(sample)
        self.whole.append(sample)

    def summary(self, *, whole: bool) -> SampleSpread:
        return SampleSpread.of(self.whole if whole else self.recent)


@dataclass(slots=True)
class _Flow:
    messages: int = 0
    last: float | None = None
    settled: float | None = None
    """From when on messages make figures; ``None`` until the first one after a start."""
    periods: _Samples = field(default_factory=_Samples)
    latencies: _Samples = field(default_factory=_Samples)


@dataclass(slots=True)
class _Module:
    state: str = "waiting"
    since: float = 0.0
    started: float | None = None
    first_message: float | None = None
    restart: Restart | None = None
    profile: str = ""


class Watch:
    """Takes what happens, and says what there is to show.

    Args:
        now: The demo's start.
        away: The site of each module that is not at the pc's.
    """

    def __init__(self, now: float, away: Mapping[str, str] | None = None) -> None:
        self._start = now
        self._away = away or {}
        self._flows = {name: _Flow() for name in TOPICS}
        self._modules = {name: _Module(since=now) for name in MODULES}
        self._commands: deque[float] = deque()
        self._delays = _Samples()
        self._unanswered = 0
        self._pose: PoseView | None = None
        self._trail: deque[tuple[float, float]] = deque(maxlen=TRAIL)
        self._trail_due = now
        self._restarts: list[Restart] = []
        self._notes: deque[str] = deque(maxlen=NOTES)

    # --- what happens -------------------------------------------------------------------------------------------

    def message(self, topic: str, now: float, latency: float | None = None) -> None:
        """A message came."""
        flow = self._flows[topic]
        last, flow.last = flow.last, now
        flow.messages += 1
        for name in (TOPICS[topic].needs[-1], HERE):
            self._first_message(self._modules[name], now)
        if flow.settled is None:
            flow.settled = now + SETTLING
        if now < flow.settled:
            return
        if last is not None and last >= flow.settled:
            flow.periods.add(now - last)
        if latency is not None:
            flow.latencies.add(latency)
        if topic == COMMAND:
            settled = self._flows[ORDER].settled
            if settled is not None and now >= settled:
                self._commands.append(now)
        elif topic == ORDER:
            self._ordered(now)

    def latency(self, topic: str, now: float, seconds: float) -> None:
        """Our agent measured how long a message without a header was on the way."""
        settled = self._flows[topic].settled
        if settled is not None and now >= settled:
            self._flows[topic].latencies.add(seconds)

    def _first_message(self, module: _Module, now: float) -> None:
        if module.started is None or now < module.started + IN_FLIGHT:
            return
        module.first_message, module.started = now - module.started, None
        if module.restart is not None:
            module.restart.back_after, module.restart = module.first_message, None

    def _ordered(self, now: float) -> None:
        while self._commands and now - self._commands[0] > ORDER_DUE:
            self._commands.popleft()
            self._unanswered += 1
        if self._commands:
            self._delays.add(now - self._commands.popleft())

    def pose(self, pose: PoseView, now: float) -> None:
        """The robot said where it is."""
        self._pose = pose
        if now >= self._trail_due:
            self._trail_due = now + 0.1
            self._trail.append((pose.x, pose.y))

    def peers(self, states: dict[str, str], now: float) -> None:
        """Take the state of each known peer, as the own agent reports it."""
        for name, module in self._modules.items():
            if name == HERE:
                state = "here"
            elif states.get(name) == "linked" or (name in states and module.state in {"waiting", states[name]}):
                state = states[name]
            else:
                # A killed peer stays in the roster for a while: its agent is called again. To the user it is gone.
                state = "waiting" if module.state == "waiting" else "gone"
            if state == module.state:
                continue
            if module.state == "linked":
                module.profile = ""
                self._interrupted(name)
                if module.restart is not None and module.restart.seen_gone_after is None:
                    module.restart.seen_gone_after = now - self._start - module.restart.killed
            module.state, module.since = state, now

    def started(self, name: str, at: float) -> None:
        """The supervisor started a module."""
        module = self._modules[name]
        module.started, module.first_message = at, None

    def profile(self, name: str, profile: str) -> None:
        """A module's resource said which profile it runs."""
        self._modules[name].profile = profile

    def killed(self, name: str, at: float) -> None:
        """The supervisor killed a module, as it was asked to."""
        module = self._modules[name]
        module.started, module.profile = None, ""
        module.restart = Restart(name, at - self._start)
        self._restarts.append(module.restart)
        self._interrupted(name)

    def note(self, text: str) -> None:
        """Something the user should read."""
        self._notes.append(text)

    def _interrupted(self, name: str) -> None:
        for topic, flow in self._flows.items():
            if name in TOPICS[topic].needs:
                flow.settled = None
        self._commands.clear()
        if name == "base":
            self._trail.clear()  # it starts again at the origin

    # --- what there is to show ----------------------------------------------------------------------------------

    def view(self, now: float, *, whole: bool = False) -> View:
        """The present figures; of the whole run, or of the last ``RECENT`` messages."""
        return View(
            seconds=now - self._start,
            modules={
                name: ModuleView(
                    module.state, now - module.since, module.first_message, module.profile, self._away.get(name, "")
                )
                for name, module in self._modules.items()
            },
            topics={name: self._topic(flow, now, whole=whole) for name, flow in self._flows.items()},
            command_to_velocity=self._delays.summary(whole=whole),
            unanswered=self._unanswered,
            pose=self._pose,
            restarts=tuple(Restart(r.module, r.killed, r.seen_gone_after, r.back_after) for r in self._restarts),
            notes=tuple(self._notes),
        )

    def trail(self) -> list[tuple[float, float]]:
        """Where the robot was, oldest first, in metres."""
        return list(self._trail)

    def _topic(self, flow: _Flow, now: float, *, whole: bool) -> TopicView:
        period = flow.periods.summary(whole=whole)
        flows = flow.last is not None and now - flow.last < SILENT and period.count and period.mean > 0
        latency = flow.latencies.summary(whole=whole)
        rate = 1 / period.mean if period.count and period.mean > 0 and (whole or flows) else 0.0
        return TopicView(flow.messages, rate, period, latency if latency.count else None)
