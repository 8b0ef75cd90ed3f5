"""Makes a resource smart: measures its quality, takes what clients ask, applies profiles, raises alarms.

Everything goes by plain topics below the resource's node (``docs/smart-resources.md`` lists them), so that it works
from any node in any module. ``resource.decide.adaptation`` decides; this drives it.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.core.errors import ConfigError
from rmpa.resource import limits
from rmpa.resource.decide.adaptation import (
    Action,
    Adaptation,
    AdaptationSettings,
    Alarm,
    Apply,
    Clear,
    Raise,
    Reacted,
)
from rmpa.resource.decide.clients import Clients
from rmpa.resource.decide.decision import Decider
from rmpa.resource.decide.measuring import QualityMeasurement
from rmpa.resource.decide.observed import MissingInputs, ObservedQualities
from rmpa.resource.decide.reports import ALARM_LEVELS, alarm_values, answer_to, decision_of, health, told
from rmpa.resource.decide.saved_state import SavedCoolDown, SavedRequirement, SavedState
from rmpa.resource.declare.requirements import Requirement
from rmpa.resource.run.applier import Applier
from rmpa.resource.run.preconditions import Preconditions
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.types.diagnostic_array import ARRAY_TYPE, DiagnosticLevel, DiagnosticStatus, frame_array
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import LENGTH, printable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.resource.decide.decision import ProfileScore
    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.requirements import Bound
    from rmpa.resource.declare.resource import Input, Output
    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.tasks import Tasks
    from rmpa.ros.node.topics import Publisher, Received, Subscriber

_log = logging.getLogger(__name__)
_LOOK: Final = 0.25
"""Seconds between looks whether clients are still connected."""


class Adapter(RuntimePart):
    """The driver of one resource's loop.

    Args:
        runtime: Of the resource.
        tasks: Paused while a profile is applied.
        window: Seconds of one quality window.
        settings: How patient the loop is.
    """

    def __init__(
        self,
        runtime: Runtime,
        tasks: Tasks,
        *,
        window: float = 1.0,
        settings: AdaptationSettings | None = None,
    ) -> None:
        resource = runtime.resource
        self._runtime = runtime
        self._window = window
        self._attributes = resource.attributes
        profiles = [declared.profile for declared in resource.profiles.values()]
        self.loop = Adaptation(self._attributes, Decider(resource.name, self._attributes, profiles), settings)
        self.clients = Clients(resource.name, self._attributes)
        self._measuring: QualityMeasurement | None = None
        """``None`` before the start."""
        self._measured: dict[str, Value] = {}
        self._publishers: dict[str, Publisher] = {}
        self._responded: list[bytes] | None = None
        self._sequence = 0
        self._asking: Subscriber | None = None
        self._applier = Applier(
            runtime, tasks, on_applied=self._applied, on_ended_late=self._ended_late, on_late=self.late
        )
        self._preconditions = Preconditions(resource.profiles, self._bar)
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._context_bars: dict[str, str] = {}
        self._closed = False
        self.chosen = ""
        """A profile that was chosen by hand before the start."""
        self.reaction: float | None = None
        """Seconds that the last reconfiguration took, from its cause to its completion."""
        self.listeners: list[Callable[[Action], None]] = []
        """Called with each action of the loop, for the store and the diagnostics."""
        self.on_window: list[Callable[[DiagnosticLevel, str, Mapping[str, Value]], None]] = []
        """Called with each window: how the resource is, in words, and what was measured."""
        self.on_asked: list[Callable[[], None]] = []
        """Called when what is asked, chosen or running may be another."""
        self.recalled = SavedState()
        """What there was before a restart; set before the start."""
        self.on_missing: list[Callable[[str, bool], None]] = []
        """Called when something that is needed is missing (true), and when it is back."""
        self.on_late: list[Callable[[str], None]] = []
        """Called when a function that was given up does something, or ends; with the text."""
        self._observed_by = ObservedQualities(
            self._attributes, resource.name, limits.RESOURCE_REPORT_WINDOWS * window
        )
        self._missing = MissingInputs()
        self.troubles: Callable[[], tuple[list[str], list[str]]] = lambda: ([], [])
        """What is wrong beside the quality: (what is missing, what does not work), each ready to read."""

    # --- its life -----------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Measure from now on, take the first profile, and hear clients."""
        self._loop = asyncio.get_running_loop()
        await self._preconditions.start()
        now = self._loop.time()
        node = self._runtime.node
        self._measuring = QualityMeasurement(self._runtime.resource, now)
        for name, latch in (("quality", False), ("alarms", False), ("responses", True)):
            topic = f"{node.name}/{name}"
            self._publishers[name] = await node.advertise(topic, MessageType(ARRAY_TYPE), latch=latch)
        self._publishers["diagnostics"] = await node.advertise("/diagnostics", MessageType(ARRAY_TYPE))
        for name in ("profile", "decision"):
            await self._runtime.say(name, "")
        self._recall(now := self._loop.time())  # registering has taken a while
        self._asking = await node.subscribe(f"{node.name}/requirements", MessageType(ARRAY_TYPE), self._asked)
        await node.subscribe(f"{node.name}/observed", MessageType(ARRAY_TYPE), self._told_of)
        self._bar()
        self._act(self.loop.pin(self.chosen, now, anew=False) if self.chosen else self.loop.start(now))
        self._respond()
        self._next_window(now)
        self._later("clients", _LOOK, self._look_at_clients)

    async def close(self) -> None:
        """Decide nothing any more; a profile that is being applied may end."""
        self._closed = True
        for timer in self._timers.values():
            timer.cancel()
        await self._preconditions.close()
        await self._applier.close()

    # --- measuring ----------------------------------------------------------------------------------------------

    def published(self, output: Output, raw: bytes, now_ns: int) -> None:
        """Measure an output."""
        if self._measuring is not None:
            self._measuring.message(output.name, raw, self._loop.time(), now_ns)

    def received(self, item: Input, message: Received) -> None:
        """Measure an input."""
        if self._measuring is not None:
            self._measuring.message(item.name, message.raw, self._loop.time(), message.stamp_ns, message.caller_id)

    def observed(self, attribute: str, value: Value) -> None:
        """Measure an attribute of the user's own."""
        if self._measuring is not None:
            self._measuring.observed(attribute, value)

    @property
    def measured(self) -> Mapping[str, Value]:
        """The last window, by attribute."""
        return self._measured

    def _next_window(self, began: float) -> None:
        """By the clock, so that windows do not get longer by how late each ends."""
        if not self._closed:
            due = max(began + self._window, self._loop.time())
            self._timers["window"] = self._loop.call_at(due, self._end_window, due)

    def _restart_windows(self) -> None:
        """Another profile runs: it is not judged by what was measured under the last one."""
        now = self._loop.time()
        if self._measuring is not None:
            self._measuring.restart(now)
        if (timer := self._timers.get("window")) is not None:
            timer.cancel()
            self._next_window(now)

    def _end_window(self, due: float) -> None:
        self._next_window(due)
        now = self._loop.time()
        measured = self._measuring.window(now) if self._measuring is not None else {}
        self._observed_by.judge(measured, self.loop.requirements, now)
        self._measured = measured
        for text, gone in self._missing.look(self.troubles()[0]):
            self._miss(text, gone=gone)
        self._preconditions.look()
        self._bar()
        self._act(self.loop.window(measured, now))
        self._publish_quality()
        self._respond()

    def _told_of(self, message: Received) -> None:
        """A client says what it observes."""
        values = [(str(pair.key), str(pair.value)) for status in message.message.status for pair in status.values]
        try:
            self._observed_by.told(message.caller_id, values, self._loop.time())
        except ConfigError as error:
            if self.clients.refusal(message.caller_id) != str(error):  # it will say so once a second
                self.refuse(message.caller_id, str(error))

    def _miss(self, text: str, *, gone: bool) -> None:
        if gone:
            _log.warning("! %s: %s", self._runtime.node.name, text)
        else:
            _log.info("= %s: over: %s", self._runtime.node.name, text)
        level, said = (DiagnosticLevel.STALE, text) if gone else (DiagnosticLevel.OK, f"over: {text}")
        values = {"cleared": str(not gone).lower()}
        self._publish("alarms", [self._status(level, self._runtime.resource.name, said, values)])
        for hear in self.on_missing:
            hear(text, gone)

    # --- clients ------------------------------------------------------------------------------------------------

    def _asked(self, message: Received) -> None:
        """A client says what it asks."""
        client, stamp = message.caller_id, message.message.header.stamp
        mark = next((str(s.hardware_id) for s in message.message.status), "")
        self.clients.speaks(client, mark, f"{stamp.sec}.{stamp.nanosec:09}" if stamp.sec or stamp.nanosec else "")
        try:
            values = [(str(pair.key), str(pair.value)) for status in message.message.status for pair in status.values]
            self.require(client, values)
        except ConfigError as error:
            _log.warning("! %s: %s asks for what cannot be: %s", self._runtime.node.name, printable(client), error)
            self.clients.refuse(client, str(error))
            self._respond()

    def require(self, client: str, values: list[tuple[str, str]]) -> None:
        """Take what a client asks, in place of what it asked before; nothing: it asks for nothing any more.

        Raises:
            ConfigError: It cannot be; what it asked before stays.
        """
        now = self._loop.time()
        requirement = self.clients.read(client, values, now)
        if requirement is None:
            return
        if requirement.bounds:
            self._act(self.loop.require(requirement, now))
        elif client in self.loop.requirements:
            self._act(self.loop.release(client, now))
        self._respond()

    def asked(self, now_ns: int) -> list[SavedRequirement]:
        """What each client asks, in its own words, at a time of the wall clock."""
        return self.clients.asked(self.loop.requirements, self._loop.time(), now_ns)

    def _recall(self, now: float) -> None:
        """Take up what was asked before a restart; who does not come back within the grace is forgotten."""
        now_ns = time.time_ns()
        found = self.clients.recall(self.recalled.asked, now, now_ns)
        left = {name: one.left(now, now_ns) for name, one in self.recalled.cooling.items()}
        self.loop.remember(found, self.recalled.last, {name: one for name, one in left.items() if one}, now)

    def cooling(self, now_ns: int) -> dict[str, SavedCoolDown]:
        """The profiles that are left out for a while, at a time of the wall clock."""
        now = self._loop.time()
        return {
            name: SavedCoolDown(
                until_ns=now_ns + round((one.until - now) * 1e9), cool_down=one.cool_down, why=one.why
            )
            for name, one in self.loop.cooling(now).items()
        }

    def shift(self, context: str, bounds: Mapping[str, Bound], bars: Mapping[str, str]) -> None:
        """A context begins: what it requires counts above the clients', and some profiles may not run in it."""
        now = self._loop.time()
        self._context_bars = dict(bars)
        known = [client for client in self.loop.requirements if client.startswith("context ")]
        name = f"context {context}"
        self._bar()
        if bounds:
            self._act(self.loop.require(Requirement(name, dict(bounds), priority=1 << 30), now))
        for client in known:
            if client != name or not bounds:
                self._act(self.loop.release(client, now))
        self._act(self.loop.reconsider(f"context {context}" if context else "no context any more", now))
        self._respond()

    def pin(self, profile: str) -> None:
        """Choose a profile by hand; an empty name lets the loop decide.

        Raises:
            ConfigError: There is no such profile.
        """
        self._act(self.loop.pin(profile, self._loop.time()))
        self._respond()

    def refuse(self, client: str, text: str) -> None:
        """Tell a client among the responses that what it said cannot be."""
        _log.warning("! %s: %s: %s", self._runtime.node.name, printable(client), text)
        self.clients.refuse(client, text)
        self._respond()

    def explain(self) -> tuple[ProfileScore, ...]:
        """How each profile does at this moment."""
        return self.loop.explain(self._loop.time())

    async def settled(self) -> None:
        """Wait until no profile is being applied; a hanging one is given up in a while."""
        while self.loop.applying and not self._closed:
            await self._applier.wait()

    def _look_at_clients(self) -> None:
        """Forget those that are gone: killed, unplugged, or simply over."""
        self._later("clients", _LOOK, self._look_at_clients)
        callers = self._asking.callers if self._asking is not None else set()
        for client in self.clients.gone(callers, self._loop.time()):
            if client in self.loop.requirements:
                _log.info("= %s: %s is gone, and what it asked for", self._runtime.node.name, printable(client))
                self._act(self.loop.release(client, self._loop.time()))
            self._respond()

    # --- acting -------------------------------------------------------------------------------------------------

    def _bar(self) -> None:
        """Leave out the profiles whose preconditions do not hold, and those that the context does not allow."""
        if not self._closed:
            barred = self._preconditions.barred() | self._context_bars
            self._act(self.loop.bar(barred, self._loop.time()))

    def _act(self, actions: list[Action]) -> None:
        for action in actions:
            match action:
                case Apply():
                    _log.info("= %s: profile %s: %s", self._runtime.node.name, action.profile, action.why)
                    self._applier.begin(action.profile)
                case Raise():
                    _log.warning("! %s: %s", self._runtime.node.name, told(action.alarm))
                    self._publish_alarm(action.alarm, cleared=False)
                case Clear():
                    _log.info("= %s: over: %s", self._runtime.node.name, told(action.alarm))
                    self._publish_alarm(action.alarm, cleared=True)
                case Reacted():
                    self.reaction = action.reaction
                    self._restart_windows()
                    _log.info("= %s: %s runs, after %.3g s", self._runtime.node.name, action.profile, action.reaction)
            for listener in self.listeners:
                listener(action)
        if actions:
            self._say()
        self._arm()

    def _applied(self, profile: str, why: str) -> None:
        self._observed_by.clear()
        now = self._loop.time()
        self._act(self.loop.failed(profile, why, now) if why else self.loop.applied(profile, now))
        self._respond()

    def _ended_late(self, profile: str, touched: bool, text: str) -> None:
        """A function that was given up has ended."""
        again = (self.loop.applying or self.loop.profile) if touched else ""
        if again:
            self.late(profile, f"{text}; {again} is applied once more")
        else:
            _log.info("= %s: %s", self._runtime.node.name, text)
        self._act(self.loop.ended_late(profile, self._loop.time(), touched=touched))
        self._respond()

    def late(self, before: str, text: str) -> None:
        """Tell what the function of a profile or a context that was given up did."""
        _log.warning("! %s: %s", self._runtime.node.name, text)
        values = {"before": before, "after": self.loop.applying or self.loop.profile}
        self._publish("alarms", [self._status(DiagnosticLevel.WARN, self._runtime.resource.name, text, values)])
        for hear in self.on_late:
            hear(text)

    def _arm(self) -> None:
        due = self.loop.next_timer()
        if (timer := self._timers.pop("loop", None)) is not None:
            timer.cancel()
        if due is not None and not self._closed:
            self._timers["loop"] = self._loop.call_at(due, self._due)

    def _due(self) -> None:
        now = self._loop.time() + 0.001
        hung = self.loop.applying if self.loop.overdue(now) else ""
        goes_on = self._applier.give_up() if hung else False
        self._act(self.loop.handle_timer(now))
        if hung and not self.loop.applying:
            self._applier.let_go()
        if hung and not goes_on:
            self._act(self.loop.ended_late(hung, now, touched=False))
        self._respond()

    def _later(self, name: str, delay: float, function: Callable[[], None]) -> None:
        if not self._closed:
            self._timers[name] = self._loop.call_later(delay, function)

    # --- telling ------------------------------------------------------------------------------------------------

    def _say(self) -> None:
        self._runtime.say_again("profile", self.loop.profile)
        self._runtime.say_again("decision", msgspec.json.encode(self.decision()).decode())

    def decision(self) -> dict[str, Any]:
        """How each profile does at this moment, with each term of it, for ``rmpa profile explain``."""
        return decision_of(self.loop, self.explain(), self.reaction)

    def _publish_quality(self) -> None:
        level, message = self._health()
        values = self._measuring.shown(self._measured) if self._measuring is not None else {}
        values["profile"] = self.loop.profile
        if self.reaction is not None:
            values["reaction"] = f"{self.reaction:.6g} s"
        for hear in self.on_window:
            hear(level, message, self._measured)
        status = self._status(level, self._runtime.resource.name, message, values)
        self._publish("quality", [status])
        self._publish("diagnostics", [status])

    def _health(self) -> tuple[DiagnosticLevel, str]:
        missing, broken = self.troubles()
        broken += [f"the function of profile {name} hangs; it was given up" for name in self._applier.hanging]
        return health(self.loop, missing, broken)

    def _publish_alarm(self, alarm: Alarm, *, cleared: bool) -> None:
        values = alarm_values(alarm, self._attributes, cleared=cleared, reaction=self.reaction)
        level = DiagnosticLevel.OK if cleared else ALARM_LEVELS[alarm.kind]
        text = f"over: {told(alarm)}" if cleared else told(alarm)
        self._publish("alarms", [self._status(level, self._runtime.resource.name, text, values)])

    def _respond(self) -> None:
        """Tell each client what it asked and what it is given, and everybody how the profiles do now."""
        self._say()
        for hear in self.on_asked:
            hear()
        statuses = []
        for client, requirement in self.loop.requirements.items():
            level, message, values = answer_to(requirement, self.loop, self._attributes, self._given(requirement))
            if refusal := self.clients.refusal(client):
                level, message = DiagnosticLevel.ERROR, f"{refusal}; what was asked before stays"
            statuses.append(self._answer(level, client, message, values))
        statuses += [
            self._answer(DiagnosticLevel.ERROR, client, self.clients.refusal(client), {})
            for client in self.clients.refused
            if client not in self.loop.requirements
        ]
        if (publisher := self._publishers.get("responses")) is not None and not self._closed:
            known = [status.serialize() for status in statuses]
            if known != self._responded:
                self._responded = known
                publisher.publish_raw(self._frame(statuses))

    def _given(self, requirement: Requirement) -> dict[str, Value]:
        """What a client is given of what it asks for: what it observes, or else what is measured here."""
        found = {}
        for name in requirement.bounds:
            seen = self._observed_by.given(requirement.client, name)
            if (value := seen if seen is not None else self._measured.get(name)) is not None:
                found[name] = value
        return found

    def _answer(
        self, level: DiagnosticLevel, client: str, message: str, values: Mapping[str, str]
    ) -> DiagnosticStatus:
        """A client's status; the mark on its request comes back, so that it knows which one it is about."""
        return DiagnosticStatus(
            level, client, message, self.clients.mark(client) or self._runtime.resource.name, values
        )

    def _status(self, level: DiagnosticLevel, name: str, message: str, values: Mapping[str, str]) -> DiagnosticStatus:
        return DiagnosticStatus(level, name, message, self._runtime.resource.name, values)

    def _publish(self, topic: str, statuses: list[DiagnosticStatus]) -> None:
        publisher = self._publishers.get(topic)
        if publisher is not None and not self._closed:
            publisher.publish_raw(self._frame(statuses))

    def _frame(self, statuses: list[DiagnosticStatus]) -> bytes:
        self._sequence += 1
        return frame_array(self._sequence, time.time_ns(), [s.serialize() for s in statuses])[LENGTH.size :]
