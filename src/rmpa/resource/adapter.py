"""Drives the control loop of a resource: takes measurements and requests, applies profiles, publishes reports.

Requests and reports are topics below the node (``docs/guides/smart-resources.md`` lists them), so any node
in any module can use them. ``resource.adaptation`` makes the decisions.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.config.values import suggestion
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.resource import limits
from rmpa.resource.adaptation import Adaptation
from rmpa.resource.decision import Alarm, AlarmKind, Decider, LearntOffers, OfferSource
from rmpa.resource.functions import HungError, Preconditions, call_function
from rmpa.resource.measuring import Measuring, count_missing
from rmpa.resource.quality import Attribute, Bound, Requirement, Value
from rmpa.resource.runtime import Runtime, RuntimePart
from rmpa.resource.saved import Clients, SavedState
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel, DiagnosticStatus, frame_array
from rmpa.ros.types.descriptor import LEVEL_FOR
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import LENGTH, printable
from rmpa.runtime.loop import MachineTimer
from rmpa.runtime.tasks import keep_task

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.resource.actuation import Actuation
    from rmpa.resource.declare import AlarmRule, Context, ManagedNode
    from rmpa.resource.tasks import Tasks
    from rmpa.resource.values import ExpressionValues
    from rmpa.ros.node.endpoints import Publisher, Received

_log = logging.getLogger(__name__)
# The longest time in seconds between two looks whether a profile has been applied.
_WAIT: Final = 0.25
# Seconds between checks whether clients are still connected.
_CLIENTS_INTERVAL: Final = 0.25
# Priority of a context's requirement; above that of every client.
_CONTEXT_PRIORITY: Final = 1 << 30
# Prefix of the client name under which a context's requirement is kept.
_CONTEXT_CLIENT: Final = "context "


def alarm_values(
    alarm: Alarm, attributes: Mapping[str, Attribute], *, cleared: bool, reaction: float | None
) -> dict[str, str]:
    """The values of an alarm's message, by key; ``reaction``: seconds that the last reconfiguration took."""
    values = {"before": alarm.before, "after": alarm.after, "cleared": str(cleared).lower()}
    if cleared and reaction is not None:
        values["reaction"] = f"{reaction:.6g} s"
    for short in alarm.shortfalls:
        values[short.attribute] = _compare(attributes[short.attribute], short.requested, short.offered, "nothing")
    return values


def _compare(attribute: Attribute, requested: Bound, offered: Value | None, absent: str) -> str:
    shown = attribute.format(offered) if offered is not None else absent
    return f"wanted {requested.describe(attribute)}, given {shown}"


def health(loop: Adaptation, missing: Sequence[str], broken: Sequence[str]) -> tuple[DiagnosticLevel, str]:
    """Level and message of a resource's ``quality`` and ``/diagnostics``.

    Args:
        loop: The resource's control loop.
        missing: What the resource needs and lacks, as texts.
        broken: What does not work, as texts.
    """
    alarm = loop.alarm
    if alarm is not None and alarm.kind is AlarmKind.NON_ADAPTABLE:
        return DiagnosticLevel.ERROR, str(alarm)
    if missing:
        return DiagnosticLevel.STALE, "; ".join((*missing, *broken))
    if not loop.profile:
        return DiagnosticLevel.ERROR, "; ".join(("no profile runs", *broken))
    if alarm is not None or broken:
        return DiagnosticLevel.WARN, "; ".join((*([str(alarm)] if alarm is not None else []), *broken))
    return DiagnosticLevel.OK, f"profile {loop.profile}"


def answer_to(
    requirement: Requirement, loop: Adaptation, attributes: Mapping[str, Attribute], offered: Mapping[str, Value]
) -> tuple[DiagnosticLevel, str, dict[str, str]]:
    """Level, message and values of the response to a client.

    Args:
        requirement: The client's requirement.
        loop: The resource's control loop.
        attributes: The resource's attributes, by name.
        offered: Measured values of the requested attributes; those not measured yet are left out.
    """
    values, short = {}, []
    for name, bound in requirement.bounds.items():
        values[name] = _compare(attributes[name], bound, offered.get(name), "not measured yet")
        if name in offered and not bound.met_by(attributes[name], offered[name]):
            short.append(name)
    conflicts = [text for client, text in loop.conflicts if client == requirement.client]
    level, message = DiagnosticLevel.OK, f"profile {loop.profile}"
    if loop.alarm is not None and loop.alarm.kind is AlarmKind.NON_ADAPTABLE:
        level, message = DiagnosticLevel.ERROR, str(loop.alarm)
    elif not loop.profile:
        level, message = DiagnosticLevel.WARN, "no profile runs yet"
    elif short or conflicts:
        level, message = DiagnosticLevel.WARN, f"{', '.join(short)} {'fall' if len(short) > 1 else 'falls'} short"
    return level, "; ".join(conflicts) or message, values


class Adapter(RuntimePart):
    """The driver of one resource's control loop.

    Args:
        runtime: The runtime of the resource.
        values: What rules refer to, and the values of attributes that have an expression.
        tasks: The resource's tasks, paused while a profile is applied.
        actuation: Applies a profile to other nodes.
        measuring: Measures the resource.
        stop: Set when a function of a profile or context has exceeded its time-out: the resource has to end.
    """

    # More than 12 fields: what it drives, and what is published of it.
    def __init__(
        self,
        runtime: Runtime,
        values: ExpressionValues,
        tasks: Tasks,
        actuation: Actuation,
        measuring: Measuring,
        stop: asyncio.Event,
    ) -> None:
        super().__init__(runtime)
        resource = runtime.resource
        self._values = values
        self._tasks = tasks
        self._actuation = actuation
        self._measuring = measuring
        self._stop = stop
        self._name = runtime.node.name
        self._attributes = resource.attributes
        self._settings = resource.settings
        profiles = list(resource.profiles.values())
        by_learnt = self._settings.offers is OfferSource.LEARNT
        self.learnt = LearntOffers(profiles)
        decider = Decider(resource.name, self._attributes, profiles, self.learnt, by_learnt=by_learnt)
        self.adaptation = Adaptation(self._attributes, decider, self._settings, self)
        self.clients = Clients(resource.name, self._attributes, 3 * self._settings.window)
        # The state that was saved before a restart.
        self.saved = SavedState()
        # Seconds that the last reconfiguration took, from its cause to its completion; ``None`` before the first.
        self.reaction: float | None = None
        # The function for which the resource ends; ``None``: none hangs.
        self.hung: HungError | None = None
        # The attributes whose values the resource's own nodes say.
        self._said = {n: one for n, one in resource.declared_attributes.items() if one.value is None}
        self._measured: dict[str, Value] = {}
        self._missing: dict[str, int] = {}
        # The alarms by rules that stand.
        self._standing: dict[str, AlarmRule] = {}
        # The last decisions, the newest last, as they are told; and the one that is being applied.
        self._history: deque[dict[str, Any]] = deque(maxlen=limits.DECISIONS_KEPT)
        self._deciding: dict[str, Any] = {}
        self._preconditions = Preconditions(resource.profiles)
        self._blocked: dict[str, str] = {}
        self._checking: asyncio.Task[None] | None = None
        self._applying: asyncio.Task[None] | None = None
        self.publishers: dict[str, Publisher] = {}
        self._responses: list[bytes] | None = None
        # The level of ``quality``, and since when, in monotonic seconds.
        self._level: tuple[DiagnosticLevel, float] | None = None
        self._window_end: float | None = None
        self._timers = (
            MachineTimer(self.adaptation.next_timer, self._handle_timer),
            MachineTimer(lambda: self._window_end, self._end_window),
        )
        # True before ``start`` and after ``close``.
        self._closed = True

    async def start(self) -> None:
        """Choose the first profile, and serve clients."""
        self._loop, self._closed = asyncio.get_running_loop(), False
        self._blocked = await self._preconditions.check()
        node, kind = self._runtime.node, MessageType(ARRAY_TYPE)
        for name, latch in (("quality", False), ("alarms", False), ("responses", True)):
            self.publishers[name] = await node.advertise(f"{node.name}/{name}", kind, latch=latch)
        self.publishers["diagnostics"] = await node.advertise("/diagnostics", kind)
        now, now_ns = self._loop.time(), time.time_ns()
        self._measuring.quality.restart(now)
        requirements = self.clients.restore(self.saved.requirements, now, now_ns)
        left = {name: one.left(now, now_ns) for name, one in self.saved.cool_downs.items()}
        cool_downs = {name: one for name, one in left.items() if one is not None}
        self.learnt.restore(self.saved.learnt)
        self.adaptation.restore(requirements, self.saved.last, cool_downs, now)
        self._requirements = await node.subscribe(f"{node.name}/requirements", kind, self._requirement_received)
        await node.subscribe(f"{node.name}/observed", kind, self._observation_received)
        if self._runtime.resource.nodes and self._said:
            await node.subscribe(f"{node.name}/attributes", kind, self._attribute_received)
        self._update_blocked()
        if chosen := self.adaptation.pinned:
            self.adaptation.pin(chosen, now, restored=True)
        else:
            self.adaptation.reconsider("the resource starts", now)
        self._window_end = now + self._settings.window
        self._work.add(keep_task(self._watch_clients, "look for clients"))
        self._runtime.changed()

    async def close(self) -> None:
        """Stop all decisions and reports; a profile that is being applied is given up."""
        self._closed = True
        for timer in self._timers:
            timer.close()
        self.publishers.clear()
        await super().close()
        await self._preconditions.close()

    def _end_window(self, now: float) -> None:
        # Counted from the due time, not from now, so that lateness does not add up.
        self._window_end = max((self._window_end or now) + self._settings.window, now)
        measured = self._values.derive(self._measuring.quality.window(now))
        self._measured = self.clients.worst(measured, self.adaptation.requirements, now)
        lacks = self._runtime.problems()[0]
        for text, missing in count_missing(self._missing, lacks):
            self._report_alarm(DiagnosticLevel.STALE, text, {}, over=not missing)
        self._judge_alarms()
        if self._checking is None or self._checking.done():
            self._checking = self._work.start(self._check_preconditions(), "check preconditions")
        profile = self.adaptation.profile
        if self.adaptation.window(self._measured, now) and not lacks:  # what is missing tells nothing of the profile
            self.learnt.window(profile, self._measured)
        for part in self._runtime.parts:
            part.window_ended(self._measured)
        self._report_quality(now)
        self._runtime.changed()

    def _judge_alarms(self) -> None:
        """Raise the alarms whose rules are true now, and clear others; one whose rule is unknown stays as it is."""
        values = self._values.now() if self._runtime.resource.alarms else {}
        for alarm in self._runtime.resource.alarms.values():
            holds, stands = alarm.when.holds(values), alarm.name in self._standing
            if holds is None or holds == stands:
                continue
            if holds:
                self._standing[alarm.name] = alarm
            else:
                del self._standing[alarm.name]
            level = DiagnosticLevel.ERROR if alarm.error else DiagnosticLevel.WARN
            facts = {"alarm": alarm.name, "rule": str(alarm.when)}
            self._report_alarm(level, str(alarm), facts, over=not holds)

    async def _check_preconditions(self) -> None:
        self._blocked = await self._preconditions.check()
        self._update_blocked()
        self._runtime.changed()

    def _update_blocked(self) -> None:
        blocked = {name: why for part in self._runtime.parts for name, why in part.blocked().items()}
        self.adaptation.block(blocked, self._loop.time())

    def blocked(self) -> dict[str, str]:
        """The profiles whose preconditions do not hold."""
        return self._blocked

    def node_changed(self, node: ManagedNode, text: str, ended: bool) -> None:
        """Report that a node has ended, or runs again; the running profile has failed if it names one that ended."""
        self._report_alarm(DiagnosticLevel.WARN, text, {"node": node.name}, over=not ended)
        running = self._runtime.resource.profiles.get(self.adaptation.profile)
        if ended and running is not None and node.key in running.nodes:
            self.adaptation.broken(text, self._loop.time())
        self._runtime.changed()

    def _observation_received(self, message: Received) -> None:
        try:
            self.clients.report(message.caller_id, _pairs(message), self._loop.time())
        except ConfigError as error:
            self._refuse_once(message.caller_id, str(error))

    def _attribute_received(self, message: Received) -> None:
        """Take what a node of the resource says of attributes."""
        problem = ""
        if message.caller_id not in {node.name for node in self._runtime.resource.nodes.values()}:
            problem = "attributes: it is no node of this resource; declare it: [node.NAME]"
        for name, text in _pairs(message) if not problem else ():
            if (declared := self._said.get(name)) is None:
                there = f"there are {', '.join(self._said)}"
                problem = f"{name}: nodes cannot say it; {suggestion(name, self._said, there)}"
                continue
            try:
                declared.observe(declared.attribute.parse(text, name))
            except ConfigError as error:
                problem = str(error)
        if problem:
            self._refuse_once(message.caller_id, problem)

    def _requirement_received(self, message: Received) -> None:
        client, stamp, now = message.caller_id, message.message.header.stamp, self._loop.time()
        mark = next((str(s.hardware_id) for s in message.message.status), "")
        sent = f"{stamp.sec}.{stamp.nanosec:09}" if stamp.sec or stamp.nanosec else ""
        try:
            requirement = self.clients.read(client, mark, sent, _pairs(message), now)
        except ConfigError as error:
            self.refuse(client, str(error))
            return
        if requirement is not None and requirement.bounds:
            self.adaptation.require(requirement, now)
        elif requirement is not None:
            self.adaptation.release(client, now)
        self._runtime.changed()

    def _refuse_once(self, client: str, text: str) -> None:
        """Refuse one of messages that repeat: an error that is told already is not told again."""
        if self.clients[client].refusal != text:
            self.refuse(client, text)

    def refuse(self, client: str, text: str) -> None:
        """Publish a response that the client's last message is invalid; ``text`` is the reason."""
        _log.warning("! %s: %s: %s [resource-trouble]", self._name, printable(client), text)
        self.clients.refuse(client, text)
        self._runtime.changed()

    async def _watch_clients(self) -> None:
        """Release what clients have asked for that are gone."""
        while True:
            await asyncio.sleep(_CLIENTS_INTERVAL)
            now = self._loop.time()
            for client in self.clients.remove_absent(self._requirements.callers, now):
                if client in self.adaptation.requirements:
                    _log.info("= %s: %s is gone, and what it asked for", self._name, printable(client))
                self.adaptation.release(client, now)
                self._runtime.changed()

    def enter_context(self, context: Context) -> None:
        """Put a context's requirement in force, above those of clients.

        Args:
            context: The context; one without a name: no context.
        """
        now, name = self._loop.time(), f"{_CONTEXT_CLIENT}{context.name}"
        before = [client for client in self.adaptation.requirements if client.startswith(_CONTEXT_CLIENT)]
        self._update_blocked()
        if bounds := {key: request.bound(self._attributes[key]) for key, request in context.requires.items()}:
            self.adaptation.require(Requirement(name, bounds, priority=_CONTEXT_PRIORITY), now)
        for client in before:
            if client != name or not bounds:
                self.adaptation.release(client, now)
        self.adaptation.reconsider(f"context {context.name}" if context.name else "no context any more", now)
        self._runtime.changed()

    def pin(self, profile: str, *, again: bool = False) -> None:
        """Choose a profile by hand; an empty name lets the loop decide. ``again``: apply it even if it runs already.

        Raises:
            ConfigError: The resource has no profile of this name.
        """
        self.adaptation.pin(profile, self._loop.time(), again=again)
        self._runtime.changed()

    async def settled(self) -> None:
        """Wait until no profile is being applied, or the resource ends."""
        while self.adaptation.applying and self._applying is not None and not self._closed and self.hung is None:
            await asyncio.wait([self._applying], timeout=_WAIT)

    def apply(self, profile: str, why: str) -> None:
        """Begin to apply a profile; the loop decides on the next one only after the outcome of this one."""
        _log.info("= %s: profile %s: %s", self._name, profile, why)
        self._deciding = {"at": time.time(), "from": self.adaptation.profile, "to": profile, "why": why}
        self._applying = self._work.start(self._apply(profile), f"apply {profile}")

    async def _apply(self, name: str) -> None:
        profile, limit, why = self._runtime.resource.profiles[name], self._settings.apply_timeout, ""
        began = self._loop.time()
        try:
            await self._actuation.apply(profile)
            await self._tasks.pause()
            self._runtime.hold()
            for key, value in profile.sets.items():
                if (parameter := self._runtime.resource.parameters[key]).binding is None:
                    parameter.value = value
            remedy = "mend it, or allow it longer: adaptation(apply_timeout=…)"
            await call_function(profile.apply, "profile", name, limit, remedy)
        except HungError as error:
            self._runtime.release(drop=True)
            self.adaptation.begin_cool_down(name, f"not applied within {limit:g} s", self._loop.time())
            self.end(error)
            return
        except Exception as error:  # noqa: BLE001 - the top of the user's code
            why = str(error) if isinstance(error, RmpaError) else f"{type(error).__name__}: {error}"
            _log.warning("! %s: profile %s: %s [resource-trouble]", self._name, name, why)
        self._runtime.release(drop=bool(why))
        self._tasks.resume()
        self.clients.forget_reports()
        if why:
            self._history.append(self._deciding | {"took": self._loop.time() - began, "failed": why})
            self.adaptation.failed(why, self._loop.time())
        else:
            self.adaptation.applied(self._loop.time())
        self._runtime.changed()

    def alarm(self, alarm: Alarm, *, cleared: bool) -> None:
        """Publish an alarm, or that it is over."""
        serious = alarm.kind is AlarmKind.NON_ADAPTABLE
        values = alarm_values(alarm, self._attributes, cleared=cleared, reaction=self.reaction)
        level = DiagnosticLevel.ERROR if serious else DiagnosticLevel.WARN
        self._report_alarm(level, str(alarm), values, over=cleared)

    def reacted(self, profile: str, reaction: float) -> None:
        """Begin a new window, so that a profile is not judged by values measured under the previous one."""
        self.reaction = reaction
        self._history.append(self._deciding | {"took": reaction})
        self.learnt.update()
        now = self._loop.time()
        self._measuring.quality.restart(now)
        if self._window_end is not None:
            self._window_end = now + self._settings.window
        _log.info("= %s: %s runs, after %.3g s", self._name, profile, reaction)

    def end(self, hung: HungError) -> None:
        """Raise an alarm about a function that has exceeded its time-out, and let the resource end."""
        _log.error("! %s: %s [%s]", self._name, hung, hung.code)
        self.hung = hung
        values = {"before": self.adaptation.profile, "after": "", "cleared": "false"}
        self._report("alarms", DiagnosticLevel.ERROR, str(hung), values)
        self._stop.set()

    def _handle_timer(self, now: float) -> None:
        self.adaptation.handle_timer(now)
        self._runtime.changed()

    def changed(self) -> None:
        """Publish what may have changed: profile, decision and responses; and move the timers."""
        if self._closed:
            return
        self._runtime.publish_text("profile", self.adaptation.profile)
        self._runtime.publish_text("decision", msgspec.json.encode(self.decision()).decode())
        refused = [name for name, client in self.clients.known.items() if client.refusal]
        statuses = [self._response(name) for name in dict.fromkeys((*self.adaptation.requirements, *refused))]
        serialized = [status.serialize() for status in statuses]
        if serialized != self._responses:
            self._responses = serialized
            self._publish("responses", serialized)
        for timer in self._timers:
            timer.arm()

    def _response(self, name: str) -> DiagnosticStatus:
        """The response for a client; it repeats the mark of the request, by which the client recognises it."""
        client, requirement = self.clients[name], self.adaptation.requirements.get(name)
        level, message, values = DiagnosticLevel.ERROR, client.refusal, dict[str, str]()
        if requirement is not None:
            offered = {**self._measured, **client.observed}
            level, message, values = answer_to(requirement, self.adaptation, self._attributes, offered)
            if client.refusal:
                level, message = DiagnosticLevel.ERROR, f"{client.refusal}; what was asked before stays"
        return DiagnosticStatus(level, name, message, client.mark or self._runtime.resource.name, values)

    def decision(self) -> dict[str, Any]:
        """The present decision with each profile's score and terms, as plain values for ``rmpa profile explain``."""
        loop = self.adaptation
        return {
            "profile": loop.profile,
            "applying": loop.applying,
            "chosen": loop.pinned,
            "reaction": self.reaction,
            "alarm": loop.alarm.kind.value if loop.alarm is not None else "",
            "conflicts": [text for _, text in loop.conflicts],
            "clients": sorted(loop.requirements),
            "by_hand": dict(self._actuation.by_hand),
            "history": list(self._history),
            "learnt": msgspec.to_builtins(self.learnt.offers),
            "scores": [
                msgspec.to_builtins(score) | {"feasible": score.feasible} for score in loop.explain(self._loop.time())
            ],
        }

    def health(self) -> tuple[DiagnosticLevel, str]:
        """The present level and message of the resource's ``quality`` topic."""
        missing, broken = self._runtime.problems()
        standing = self._standing.values()
        level, message = health(self.adaptation, missing, [*broken, *map(str, standing)])
        serious = any(alarm.error for alarm in standing) and level < DiagnosticLevel.ERROR
        return DiagnosticLevel.ERROR if serious else level, message

    def _report_quality(self, now: float) -> None:
        """Publish the quality of a window, also on ``/diagnostics``, with how long it has had this level."""
        level, message = self.health()
        if self._level is None or self._level[0] != level:
            self._level = level, now
        values = self._measuring.quality.format(self._measured)
        values |= {"profile": self.adaptation.profile, LEVEL_FOR: f"{now - self._level[1]:.1f} s"}
        if self.reaction is not None:
            values["reaction"] = f"{self.reaction:.6g} s"
        for topic in ("quality", "diagnostics"):
            self._report(topic, level, message, values)

    def _report_alarm(self, level: DiagnosticLevel, text: str, facts: Mapping[str, str], *, over: bool) -> None:
        """Publish and log that an alarm is raised, or over."""
        if over:
            level, text = DiagnosticLevel.OK, f"over: {text}"
            _log.info("= %s: %s", self._name, text)
        else:
            _log.warning("! %s: %s [resource-trouble]", self._name, text)
        self._report("alarms", level, text, {**facts, "cleared": str(over).lower()})

    def _report(self, topic: str, level: DiagnosticLevel, message: str, values: Mapping[str, str]) -> None:
        name = self._runtime.resource.name
        self._publish(topic, [DiagnosticStatus(level, name, message, name, values).serialize()])

    def _publish(self, topic: str, statuses: list[bytes]) -> None:
        if (to := self.publishers.get(topic)) is not None:
            array = frame_array(0, time.time_ns(), statuses)[LENGTH.size :]
            to.publish_raw(to.numbers.stamp(array) if to.numbers is not None else array)


def _pairs(message: Received) -> list[tuple[str, str]]:
    """Keys and values of a ``DiagnosticArray``."""
    return [(str(pair.key), str(pair.value)) for status in message.message.status for pair in status.values]
