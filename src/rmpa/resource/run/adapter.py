"""Drives the control loop of a resource: takes measurements and requests, applies profiles, publishes reports.

Requests and reports are plain topics below the resource's node (``docs/smart-resources.md`` lists them), so any node
in any module can use them. ``resource.decide.adaptation`` makes the decisions.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import ConfigError, RmpaError
from rmpa.resource import limits
from rmpa.resource.decide.adaptation import Adaptation
from rmpa.resource.decide.decision import Action, Alarm, Apply, Clear, Decider, Raise, Reacted
from rmpa.resource.decide.quality import MissingInputs, ObservedQualities, QualityMeasurement
from rmpa.resource.decide.reports import (
    ALARM_LEVELS,
    Clients,
    SavedState,
    alarm_values,
    answer_to,
    decision_report,
    describe_alarm,
    health,
)
from rmpa.resource.declare.parameters import AdaptationSettings
from rmpa.resource.declare.requirements import Requirement
from rmpa.resource.run.runtime import CALLER, Preconditions, RuntimePart, StatusPublisher
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel, DiagnosticStatus
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.accept import in_thread
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.resource.decide.decision import ProfileScore
    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.parameters import Hook, Input, Output
    from rmpa.resource.declare.requirements import Bound
    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.tasks import Tasks
    from rmpa.ros.node.endpoints import Received, Subscriber


# Calls the functions of profiles and contexts, and applies profiles, each between two runs of the tasks.


_log = logging.getLogger(__name__)
_WAIT: Final = 0.25
"""The longest time in seconds that one call of ``wait`` takes."""


@dataclass(eq=False)
class HungError(RmpaError):
    """A function of a profile or context has not returned within its time-out; the resource ends.

    Args:
        what: ``profile`` or ``context``.
        name: Name of the profile or context.
        limit: The time-out in seconds.
        remedy: What to do about it.
    """

    what: str
    name: str
    limit: float
    remedy: str

    def __str__(self) -> str:
        """Say which function, which time-out, and what to do."""
        text = f"the function of {self.what} {self.name} has not returned within {self.limit:g} s; the resource ends"
        return f"{text}; {self.remedy}"


async def call_function(function: Hook, what: str, name: str, limit: float, remedy: str) -> None:
    """Call a function of a profile or context: a coroutine function in the event loop, a plain one in a thread.

    A thread cannot be stopped from outside, so a plain function that exceeds its time-out goes on until the process
    ends.

    Args:
        function: The function.
        what: ``profile`` or ``context``.
        name: Name of the profile or context.
        limit: The time-out in seconds.
        remedy: What to do if the function exceeds it.

    Raises:
        HungError: The function has exceeded its time-out.
        Exception: As raised by the function.
    """

    async def run() -> None:
        CALLER.set(what)
        outcome = function() if inspect.iscoroutinefunction(function) else await in_thread(function, f"{what} {name}")
        if outcome is not None:
            await outcome

    call = asyncio.create_task(run(), name=f"{what} {name}")
    try:
        await asyncio.wait([call], timeout=limit)
    finally:
        call.cancel()
    if not call.done():
        raise HungError(what, name, limit, remedy)
    if call.cancelled():
        raise RuntimeError("CancelledError: something that it awaited was cancelled")
    call.result()


class Applier:
    """Applies the profiles of one resource; all callbacks are called in the event loop.

    Args:
        runtime: Queues messages while a profile is applied.
        tasks: Paused while a profile is applied.
        timeout: The time-out of a profile's function, in seconds.
        on_applied: ``(profile, error)``: the profile's function has ended; ``error`` is empty if it succeeded.
        on_hung: The profile's function has exceeded its time-out; tasks stay paused.
    """

    def __init__(
        self,
        runtime: Runtime,
        tasks: Tasks,
        timeout: float,
        *,
        on_applied: Callable[[str, str], None],
        on_hung: Callable[[HungError], None],
    ) -> None:
        self._runtime = runtime
        self._tasks = tasks
        self._timeout = timeout
        self._on_applied = on_applied
        self._on_hung = on_hung
        self._task: asyncio.Task[None] | None = None

    def begin(self, profile: str) -> None:
        """Begin to apply a profile; the previous one must be complete."""
        self._task = asyncio.get_running_loop().create_task(self._apply(profile), name=f"apply {profile}")

    async def wait(self) -> None:
        """Wait until the profile has been applied, at most 0.25 s."""
        if self._task is not None:
            await asyncio.wait([self._task], timeout=_WAIT)

    async def close(self) -> None:
        """Give up the profile that is being applied, if any; a function in a thread is left behind."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _apply(self, profile: str) -> None:
        why = ""
        try:
            await self._tasks.pause()
            self._runtime.hold()
            remedy = "mend it, or allow it longer: adaptation(apply_timeout=…)"
            function = self._runtime.resource.profiles[profile].apply
            await call_function(function, "profile", profile, self._timeout, remedy)
        except HungError as error:
            self._runtime.release(drop=True)
            self._on_hung(error)
            return
        except Exception as error:  # noqa: BLE001 - the top of the user's code
            why = f"{type(error).__name__}: {error}"
            _log.warning("! %s: profile %s: %s", self._runtime.node.name, profile, why)
        self._runtime.release(drop=bool(why))
        self._tasks.resume()
        self._on_applied(profile, why)


_CLIENTS_INTERVAL: Final = 0.25
"""Seconds between checks whether clients are still connected."""
_CONTEXT_PRIORITY: Final = 1 << 30
"""Priority of a context's requirement; above that of every client."""
_CONTEXT_CLIENT: Final = "context "
"""Prefix of the client name under which a context's requirement is kept."""


class Adapter(RuntimePart):
    """The driver of one resource's control loop.

    Args:
        runtime: The runtime of the resource.
        tasks: The resource's tasks, paused while a profile is applied.
        window: Length of a quality window, in seconds.
        settings: Settings of the control loop; ``None``: the defaults.
        problems: Returns the problems apart from the quality, as texts: what is missing, and what does not work.
        on_hung: Called when a function of a profile or context has exceeded its time-out: the resource has to end.
    """

    def __init__(
        self,
        runtime: Runtime,
        tasks: Tasks,
        *,
        window: float = 1.0,
        settings: AdaptationSettings | None = None,
        problems: Callable[[], tuple[list[str], list[str]]] = lambda: ([], []),
        on_hung: Callable[[], None] = lambda: None,
    ) -> None:
        resource = runtime.resource
        self._runtime = runtime
        self._name = runtime.node.name
        self._window = window
        self._problems = problems
        self._attributes = resource.attributes
        self._on_hung = on_hung
        settings = settings if settings is not None else AdaptationSettings()
        profiles = [declared.profile for declared in resource.profiles.values()]
        self.loop = Adaptation(self._attributes, Decider(resource.name, self._attributes, profiles), settings)
        self.clients = Clients(resource.name, self._attributes)
        self.reports = StatusPublisher(runtime)
        self.reaction: float | None = None
        """Seconds that the last reconfiguration took, from its cause to its completion; ``None`` before the first."""
        self._measuring: QualityMeasurement | None = None
        """``None`` before the start."""
        self._measured: dict[str, Value] = {}
        self._requirements: Subscriber | None = None
        self._applier = Applier(
            runtime,
            tasks,
            settings.apply_timeout,
            on_applied=self._applied,
            on_hung=self.end,
        )
        self.hung: HungError | None = None
        """The function for which the resource ends; ``None``: none hangs."""
        self._preconditions = Preconditions(resource.profiles)
        self._blocked_by_needs: dict[str, str] = {}
        self._checking: asyncio.Task[None] | None = None
        self._blocked_by_context: dict[str, str] = {}
        self._observed_by = ObservedQualities(
            self._attributes, resource.name, limits.RESOURCE_REPORT_WINDOWS * window
        )
        self._missing = MissingInputs()
        self._saved = SavedState()
        self._chosen = ""
        self._window_end: float | None = None
        self._clients_check: float | None = None
        self._timers = (
            MachineTimer(self.loop.next_timer, self._handle_timer),
            MachineTimer(lambda: self._window_end, self._end_window),
            MachineTimer(lambda: self._clients_check, self._check_clients),
        )
        self._closed = False

    # --- start and end ------------------------------------------------------------------------------------------

    def restore(self, saved: SavedState) -> None:
        """Take over the state that was saved before a restart; must be called before ``start``."""
        self._saved, self._chosen = saved, saved.chosen

    def preset(self, profile: str) -> None:
        """Choose a profile by hand before ``start``; an empty name lets the loop decide."""
        self._chosen = profile

    async def start(self) -> None:
        """Begin to measure, choose the first profile, and serve clients."""
        self._loop = asyncio.get_running_loop()
        await self._check_preconditions()
        self._measuring = QualityMeasurement(self._runtime.resource, self._loop.time())
        await self.reports.start()
        now = self._loop.time()
        self._restore(now)
        node = self._runtime.node
        self._requirements = await node.subscribe(
            f"{node.name}/requirements", MessageType(ARRAY_TYPE), self._requirement_received
        )
        await node.subscribe(f"{node.name}/observed", MessageType(ARRAY_TYPE), self._observation_received)
        self._update_blocked()
        self._act(self.loop.pin(self._chosen, now, restored=True) if self._chosen else self.loop.start(now))
        self._respond()
        self._window_end, self._clients_check = now + self._window, now + _CLIENTS_INTERVAL
        self._arm_timers()

    async def close(self) -> None:
        """Stop all decisions and reports; a profile that is being applied is given up."""
        self._closed = True
        for timer in self._timers:
            timer.close()
        self.reports.close()
        if self._checking is not None:
            self._checking.cancel()
            await asyncio.wait([self._checking])
        await self._preconditions.close()
        await self._applier.close()

    def _arm_timers(self) -> None:
        for timer in self._timers:
            timer.arm()

    def _restore(self, now: float) -> None:
        now_ns = time.time_ns()
        requirements = self.clients.restore(self._saved.requirements, now, now_ns)
        left = {name: one.left(now, now_ns) for name, one in self._saved.cool_downs.items()}
        cool_downs = {name: one for name, one in left.items() if one is not None}
        self.loop.restore(requirements, self._saved.last, cool_downs, now)

    # --- measurements -------------------------------------------------------------------------------------------

    def published(self, output: Output, raw: bytes, now_ns: int) -> None:
        """Measure a message that an output has sent."""
        if self._measuring is not None:
            self._measuring.message(output.name, raw, self._loop.time(), now_ns)

    def received(self, item: Input, message: Received) -> None:
        """Measure a message that an input has received."""
        if self._measuring is not None:
            self._measuring.message(item.name, message.raw, self._loop.time(), message.stamp_ns, message.caller_id)

    def observed(self, attribute: str, value: Value) -> None:
        """Record an attribute's value that the user's code has observed."""
        if self._measuring is not None:
            self._measuring.observe(attribute, value)

    def _restart_window(self) -> None:
        """Begin a new window, so that a profile is not judged by values measured under the previous one."""
        now = self._loop.time()
        if self._measuring is not None:
            self._measuring.restart(now)
        if self._window_end is not None:
            self._window_end = now + self._window
            self._arm_timers()

    def _end_window(self, now: float) -> None:
        # Counted from the due time, not from now, so that lateness does not add up.
        self._window_end = max((self._window_end or now) + self._window, now)
        measured = self._measuring.window(now) if self._measuring is not None else {}
        self._measured = self._observed_by.worst(measured, self.loop.requirements, now)
        for text, missing in self._missing.update(self._problems()[0]):
            self._missing_changed(text, missing=missing)
        if self._checking is None or self._checking.done():
            self._checking = self._loop.create_task(self._check_preconditions(), name="check preconditions")
        self._act(self.loop.window(self._measured, now))
        self._publish_quality()
        self._respond()

    def _observation_received(self, message: Received) -> None:
        values = [(str(pair.key), str(pair.value)) for status in message.message.status for pair in status.values]
        try:
            self._observed_by.report(message.caller_id, values, self._loop.time())
        except ConfigError as error:
            if self.clients.refusal(message.caller_id) != str(error):  # reports repeat; one error is logged once
                self.refuse(message.caller_id, str(error))

    def _missing_changed(self, text: str, *, missing: bool) -> None:
        if missing:
            _log.warning("! %s: %s", self._name, text)
        else:
            _log.info("= %s: over: %s", self._name, text)
        level, message = (DiagnosticLevel.STALE, text) if missing else (DiagnosticLevel.OK, f"over: {text}")
        self.reports.alarm(level, message, {"cleared": str(not missing).lower()})

    # --- clients ------------------------------------------------------------------------------------------------

    def _requirement_received(self, message: Received) -> None:
        client, stamp = message.caller_id, message.message.header.stamp
        mark = next((str(s.hardware_id) for s in message.message.status), "")
        self.clients.received(client, mark, f"{stamp.sec}.{stamp.nanosec:09}" if stamp.sec or stamp.nanosec else "")
        try:
            values = [(str(pair.key), str(pair.value)) for status in message.message.status for pair in status.values]
            self.require(client, values)
        except ConfigError as error:
            _log.warning("! %s: %s asks for what cannot be: %s", self._name, printable(client), error)
            self.clients.refuse(client, str(error))
            self._respond()

    def require(self, client: str, values: list[tuple[str, str]]) -> None:
        """Set a client's requirement, in place of its previous one.

        Args:
            client: Name of the client's node.
            values: Keys and values of the request; a request without bounds releases the requirement.

        Raises:
            ConfigError: The request is invalid; the previous requirement stays in force.
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

    def enter_context(self, context: str, bounds: Mapping[str, Bound], blocked: Mapping[str, str]) -> None:
        """Put a context's requirement in force, above those of clients, and block the profiles that it excludes.

        Args:
            context: Name of the context; empty: no context.
            bounds: The context's requirement, by attribute; empty: none.
            blocked: Why a profile is excluded, by profile.
        """
        now = self._loop.time()
        self._blocked_by_context = dict(blocked)
        before = [client for client in self.loop.requirements if client.startswith(_CONTEXT_CLIENT)]
        name = f"{_CONTEXT_CLIENT}{context}"
        self._update_blocked()
        if bounds:
            self._act(self.loop.require(Requirement(name, dict(bounds), priority=_CONTEXT_PRIORITY), now))
        for client in before:
            if client != name or not bounds:
                self._act(self.loop.release(client, now))
        self._act(self.loop.reconsider(f"context {context}" if context else "no context any more", now))
        self._respond()

    def pin(self, profile: str) -> None:
        """Choose a profile by hand; an empty name lets the loop decide.

        Raises:
            ConfigError: The resource has no profile of this name.
        """
        self._act(self.loop.pin(profile, self._loop.time()))
        self._respond()

    def refuse(self, client: str, text: str) -> None:
        """Publish a response that the client's last message is invalid; ``text`` is the reason."""
        _log.warning("! %s: %s: %s", self._name, printable(client), text)
        self.clients.refuse(client, text)
        self._respond()

    def explain(self) -> tuple[ProfileScore, ...]:
        """The score of each profile at this moment."""
        return self.loop.explain(self._loop.time())

    async def settled(self) -> None:
        """Wait until no profile is being applied, or the resource ends."""
        while self.loop.applying and not self._closed and self.hung is None:
            await self._applier.wait()

    def _check_clients(self, now: float) -> None:
        self._clients_check = now + _CLIENTS_INTERVAL
        connected = self._requirements.callers if self._requirements is not None else set()
        for client in self.clients.remove_absent(connected, now):
            if client in self.loop.requirements:
                _log.info("= %s: %s is gone, and what it asked for", self._name, printable(client))
                self._act(self.loop.release(client, now))
            self._respond()

    # --- actions ------------------------------------------------------------------------------------------------

    async def _check_preconditions(self) -> None:
        self._blocked_by_needs = await self._preconditions.check()
        self._update_blocked()

    def _update_blocked(self) -> None:
        """Block the profiles whose preconditions do not hold, and those that the context excludes."""
        if self._requirements is not None and not self._closed:  # not before the start
            blocked = self._blocked_by_needs | self._blocked_by_context
            self._act(self.loop.block(blocked, self._loop.time()))

    def _act(self, actions: list[Action]) -> None:
        for action in actions:
            match action:
                case Apply():
                    _log.info("= %s: profile %s: %s", self._name, action.profile, action.why)
                    self._applier.begin(action.profile)
                case Raise():
                    _log.warning("! %s: %s", self._name, describe_alarm(action.alarm))
                    self._publish_alarm(action.alarm, cleared=False)
                case Clear():
                    _log.info("= %s: over: %s", self._name, describe_alarm(action.alarm))
                    self._publish_alarm(action.alarm, cleared=True)
                case Reacted():
                    self.reaction = action.reaction
                    self._restart_window()
                    _log.info("= %s: %s runs, after %.3g s", self._name, action.profile, action.reaction)
        if actions:
            self._publish_decision()
            for part in self._runtime.parts:
                part.changed()
        self._arm_timers()

    def _applied(self, profile: str, why: str) -> None:
        self._observed_by.clear()
        now = self._loop.time()
        self._act(self.loop.failed(profile, why, now) if why else self.loop.applied(profile, now))
        self._respond()

    def end(self, hung: HungError) -> None:
        """Raise an alarm about a function that has exceeded its time-out, and let the resource end."""
        _log.error("! %s: %s", self._name, hung)
        self.hung = hung
        if hung.what == "profile":
            self.loop.hung(hung.name, f"not applied within {hung.limit:g} s", self._loop.time())
        values = {"before": self.loop.profile, "after": "", "cleared": "false"}
        self.reports.alarm(DiagnosticLevel.ERROR, str(hung), values)
        self._on_hung()

    def _handle_timer(self, now: float) -> None:
        self._act(self.loop.handle_timer(now))
        self._respond()

    # --- reports ------------------------------------------------------------------------------------------------

    def _publish_decision(self) -> None:
        self.reports.decision(self.loop.profile, decision_report(self.loop, self.explain(), self.reaction))

    def _publish_quality(self) -> None:
        level, message = self.health()
        values = self._measuring.format(self._measured) if self._measuring is not None else {}
        values["profile"] = self.loop.profile
        if self.reaction is not None:
            values["reaction"] = f"{self.reaction:.6g} s"
        for part in self._runtime.parts:
            part.window_ended(level, message, self._measured)
        self.reports.quality(level, message, values)

    def health(self) -> tuple[DiagnosticLevel, str]:
        """The present level and message of the resource's ``quality`` topic."""
        return health(self.loop, *self._problems())

    def _publish_alarm(self, alarm: Alarm, *, cleared: bool) -> None:
        values = alarm_values(alarm, self._attributes, cleared=cleared, reaction=self.reaction)
        level = DiagnosticLevel.OK if cleared else ALARM_LEVELS[alarm.kind]
        self.reports.alarm(level, f"over: {describe_alarm(alarm)}" if cleared else describe_alarm(alarm), values)

    def _respond(self) -> None:
        """Publish the response to each client, and the decision."""
        self._publish_decision()
        for part in self._runtime.parts:
            part.changed()
        statuses = []
        for client, requirement in self.loop.requirements.items():
            level, message, values = answer_to(requirement, self.loop, self._attributes, self._offered(requirement))
            if refusal := self.clients.refusal(client):
                level, message = DiagnosticLevel.ERROR, f"{refusal}; what was asked before stays"
            statuses.append(self._response(level, client, message, values))
        statuses += [
            self._response(DiagnosticLevel.ERROR, client, self.clients.refusal(client), {})
            for client in self.clients.refused
            if client not in self.loop.requirements
        ]
        self.reports.responses(statuses)

    def _offered(self, requirement: Requirement) -> dict[str, Value]:
        """Values of the requested attributes: as observed by the client, or else as measured here."""
        found = {}
        for name in requirement.bounds:
            observed = self._observed_by.observed(requirement.client, name)
            if (value := observed if observed is not None else self._measured.get(name)) is not None:
                found[name] = value
        return found

    def _response(
        self, level: DiagnosticLevel, client: str, message: str, values: Mapping[str, str]
    ) -> DiagnosticStatus:
        """The response for a client; it repeats the mark of the request, by which the client recognises it."""
        mark = self.clients.mark(client) or self._runtime.resource.name
        return DiagnosticStatus(level, client, message, mark, values)
