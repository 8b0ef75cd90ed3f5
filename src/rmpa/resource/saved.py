"""What a resource keeps: of each client while it runs, and the state that survives a restart, as one file.

The file (JSON) is replaced as a whole and has the parameters, choices by hand, the last profile, the requirements of
clients and the cool-downs. Its times are of the wall clock, because the monotonic clock restarts with each boot.
"""

from __future__ import annotations

import asyncio
import fcntl
import functools
import logging
import math
import os
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import ConfigError
from rmpa.resource import limits
from rmpa.resource.adaptation import CoolDown
from rmpa.resource.quality import Attribute, Direction, Requirement, Value, find_attribute, parse_requirement
from rmpa.resource.runtime import Runtime, RuntimePart
from rmpa.runtime.accept import in_thread
from rmpa.runtime.files import replace_file, set_aside
from rmpa.runtime.tasks import start_task

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
    from pathlib import Path

    from rmpa.resource.declare import Parameter
    from rmpa.resource.resource import Resource

_log = logging.getLogger(__name__)
_SECOND: Final = 1_000_000_000
# Number of consecutive checks without a connection after which a client is gone. One check is not enough: after a
# short interruption of its link, the connections of a proxy are made again.
_ABSENT: Final = 2
_WORSE: Final = {Direction.MAX: -1, Direction.MIN: 1}

# The file's form. A release that changes it reads the earlier ones, from 0.2.0 on (docs/reference/compatibility.md).
FORMAT: Final = 1


class SavedFormat(msgspec.Struct):
    """The part of the file that all formats have."""

    format: int = 1


class SavedRequirement(msgspec.Struct, frozen=True, kw_only=True):
    """The requirement of one client, as it was received.

    Attributes:
        client: Name of the client's node.
        values: Attributes, ``priority`` and ``expires`` with their texts.
        mark: The message's mark, which responses repeat.
        stamp: The message's stamp, or empty; a latched message that arrives again has the same stamp.
        expires_ns: When it expires, in Unix nanoseconds; ``None``: never.
    """

    client: str
    values: tuple[tuple[str, str], ...]
    mark: str = ""
    stamp: str = ""
    expires_ns: int | None = None

    def requirement(
        self, attributes: Mapping[str, Attribute], resource: str, now: float, now_ns: int
    ) -> Requirement | None:
        """The parsed requirement; ``None`` if it has expired.

        Args:
            attributes: The resource's attributes, by name.
            resource: Name of the resource, for errors.
            now: Monotonic seconds.
            now_ns: The same moment by the wall clock, Unix nanoseconds.

        Raises:
            ConfigError: The texts are no valid requirement on the resource as it is declared now.
        """
        found = parse_requirement(self.client, self.values, attributes, resource, now)
        if self.expires_ns is None or found.expires is None:
            return replace(found, expires=None)
        if self.expires_ns <= now_ns:
            return None
        # If the wall clock was set back meanwhile, the requirement must not last longer than its whole duration.
        return replace(found, expires=min(found.expires, now + (self.expires_ns - now_ns) / _SECOND))


class SavedCoolDown(msgspec.Struct, frozen=True, kw_only=True):
    """The cool-down of a profile.

    Attributes:
        until_ns: End of the cool-down, in Unix nanoseconds.
        cool_down: Length of the cool-down in seconds.
        why: The reason, as a text for people.
    """

    until_ns: int
    cool_down: float
    why: str = ""

    def left(self, now: float, now_ns: int) -> CoolDown | None:
        """The rest of the cool-down, by the monotonic clock; ``None`` if it is over.

        If the wall clock was set back meanwhile, the whole cool-down is left; if it was set forward, it ends early.
        """
        left = min((self.until_ns - now_ns) / _SECOND, self.cool_down)
        return CoolDown(now + left, self.cool_down, self.why) if left > 0 else None


class SavedState(msgspec.Struct, frozen=True, kw_only=True):
    """The state of a resource, as its file has it.

    Attributes:
        format: ``FORMAT``.
        parameters: The values of parameters that differ from their defaults, by name.
        chosen: The profile chosen by hand, or empty.
        last: The profile that ran last, or empty.
        context: The context chosen by hand, or empty.
        requirements: Requirements of clients, which may come back.
        cool_downs: Cool-downs by profile.
        by_hand: Values of other nodes that people have set, by parameter.
        learnt: The values of each profile's last windows, by attribute.
    """

    format: int = FORMAT
    parameters: dict[str, bool | int | float | str] = {}
    chosen: str = ""
    last: str = ""
    context: str = ""
    requirements: tuple[SavedRequirement, ...] = ()
    cool_downs: dict[str, SavedCoolDown] = {}
    by_hand: dict[str, bool | int | float | str] = {}
    learnt: dict[str, dict[str, list[float]]] = {}

    def checked(self, resource: Resource, now_ns: int) -> tuple[SavedState, list[str]]:
        """What still fits the declaration of the resource, and a text about each part that does not.

        Args:
            resource: The resource, completely declared.
            now_ns: Unix nanoseconds of the wall clock.
        """
        lost: list[str] = []

        def declared(kind: str, name: str, known: Mapping[str, object]) -> str:
            if name and name not in known:
                lost.append(f"{kind} {name}: it is declared no longer")
                return ""
            return name

        parameters, requirements = {}, []
        for name, value in self.parameters.items():
            try:
                if declared("parameter", name, resource.parameters):
                    parameters[name] = resource.parameters[name].check(value)
            except ConfigError as error:
                lost.append(str(error))
        for one in self.requirements:
            try:
                if one.requirement(resource.attributes, resource.name, 0.0, now_ns) is not None:
                    requirements.append(one)
            except ConfigError as error:
                lost.append(f"requirement of {one.client}: {error}")
        found = SavedState(
            parameters=parameters,
            chosen=declared("profile", self.chosen, resource.profiles),
            last=declared("profile", self.last, resource.profiles),
            context=declared("context", self.context, resource.contexts),
            requirements=tuple(requirements),
            cool_downs={n: c for n, c in self.cool_downs.items() if declared("profile", n, resource.profiles)},
            by_hand={n: v for n, v in self.by_hand.items() if declared("parameter", n, resource.bound)},
            learnt=self.learnt,
        )
        return found, lost


# The clients of a resource: what they say, and their presence. ``quality.merge`` merges their requirements.


@dataclass(slots=True)
class ClientRecord:
    """A client that has sent a message.

    Args:
        mark: The mark of its last message, by which the client recognises the answer.
        stamp: The stamp of its last message, or empty; it identifies a latched message that arrives again.
        values: The last valid requirement, as texts by attribute; empty: there was none.
        refusal: Why its last message was refused; empty: it was accepted.
        absent: Number of consecutive checks without a connection.
        grace: For a client restored after a restart: how long it may stay unconnected, in monotonic seconds.
        observed: The qualities that it has reported last: fewer messages may arrive in another module than were sent,
            where only the client can measure the loss.
        observed_at: When it has, in monotonic seconds.
    """

    mark: str = ""
    stamp: str = ""
    values: tuple[tuple[str, str], ...] = ()
    refusal: str = ""
    absent: int = 0
    grace: float = -math.inf
    observed: Mapping[str, Value] = field(default_factory=dict)
    observed_at: float = -math.inf


class Clients:
    """All clients of one resource.

    Args:
        resource: Name of the resource, for errors.
        attributes: The attributes that clients may request, by name.
        lifespan: Seconds for which what a client reports counts.
    """

    def __init__(self, resource: str, attributes: Mapping[str, Attribute], lifespan: float = math.inf) -> None:
        self._resource = resource
        self._attributes = attributes
        # Seconds for which a report of observed qualities counts.
        self._lifespan = lifespan
        self.known: dict[str, ClientRecord] = {}
        # Expiry in monotonic seconds, by client and stamp: a latched request that arrives again keeps its expiry.
        self.expiries: dict[tuple[str, str], float] = {}

    def __getitem__(self, name: str) -> ClientRecord:
        """The client of this name; an empty record if it has sent nothing."""
        return self.known.get(name, ClientRecord())

    def read(
        self, name: str, mark: str, stamp: str, values: Sequence[tuple[str, str]], now: float
    ) -> Requirement | None:
        """Record a client's message, and read its requirement.

        Args:
            name: Name of the client's node.
            mark: The mark on the message; it is cut to a maximum length, because each response repeats it.
            stamp: The message's stamp as ``seconds.nanoseconds``, or empty.
            values: Attributes with the texts of the requests.
            now: Monotonic seconds.

        Returns:
            The requirement; ``None`` for a latched request that arrives again after it has expired.

        Raises:
            ConfigError: The request is invalid.
        """
        client = self.known.setdefault(name, ClientRecord())
        client.mark, client.stamp, client.grace = mark[: limits.REQUIREMENT_TEXT_MAX], stamp, -math.inf
        requirement = parse_requirement(name, values, self._attributes, self._resource, now)
        if requirement.expires is not None and client.stamp:
            due = self.expiries.setdefault((name, client.stamp), requirement.expires)
            while len(self.expiries) > limits.RESOURCE_STAMPS_MAX:
                del self.expiries[next(iter(self.expiries))]
            if due <= now:
                return None
            requirement = replace(requirement, expires=due)
        client.refusal, client.values = "", tuple(values)
        return requirement

    def refuse(self, name: str, why: str) -> None:
        """Record why a client's last message was refused."""
        self.known.setdefault(name, ClientRecord()).refusal = why

    def report(self, name: str, values: Iterable[tuple[str, str]], now: float) -> None:
        """Record the qualities that a client observes, as texts by attribute, in place of its previous report.

        Raises:
            ConfigError: An attribute is unknown or a value is invalid; the whole report is dropped.
        """
        found: dict[str, Value] = {}
        for number, (key, text) in enumerate(values):
            where = f"observation of {key}"
            if number >= limits.REQUIREMENT_BOUNDS_MAX:
                raise ConfigError(where, f"more than {limits.REQUIREMENT_BOUNDS_MAX} attributes")
            found[key] = find_attribute(self._attributes, key, self._resource).parse(text, where)
        client = self.known.setdefault(name, ClientRecord())
        client.observed, client.observed_at = found, now

    def worst(self, measured: Mapping[str, Value], clients: Collection[str], now: float) -> dict[str, Value]:
        """For each attribute the worst of the measured and the reported values.

        Args:
            measured: The resource's own measurements, by attribute.
            clients: The clients that have a requirement; reports of others do not count.
            now: Monotonic seconds.

        Returns:
            Values by attribute. Where no direction is better, a reported value replaces the measured one.
        """
        worst = dict(measured)
        for name, client in self.known.items():
            if now - client.observed_at > self._lifespan:
                client.observed = {}
            for key, value in client.observed.items() if name in clients else ():
                attribute, known = self._attributes[key], worst.get(key)
                sign = _WORSE.get(attribute.direction)
                if known is None or not sign or sign * (attribute.position(value) - attribute.position(known)) > 0:
                    worst[key] = value
        return worst

    def forget_reports(self) -> None:
        """Drop all reports, because they describe the previous profile."""
        for client in self.known.values():
            client.observed = {}

    def remove_absent(self, connected: Collection[str], now: float) -> list[str]:
        """Remove clients that have been unconnected for several calls; must be called periodically.

        Args:
            connected: The names of the nodes that are connected.
            now: Monotonic seconds.

        Returns:
            The names of the removed clients.
        """
        removed = []
        for name, client in list(self.known.items()):
            if name in connected:
                client.absent, client.grace = 0, -math.inf
            elif client.grace <= now:
                client.absent += 1
                if client.absent >= _ABSENT:
                    del self.known[name]
                    removed.append(name)
        return removed

    def save(self, requirements: Mapping[str, Requirement], now: float, now_ns: int) -> tuple[SavedRequirement, ...]:
        """The requirements of all clients in the form in which they are stored.

        Args:
            requirements: The requirements in force, by client.
            now: Monotonic seconds.
            now_ns: The same moment by the wall clock, Unix nanoseconds.
        """
        return tuple(
            SavedRequirement(
                client=name,
                values=self[name].values,
                mark=self[name].mark,
                stamp=self[name].stamp,
                expires_ns=None if one.expires is None else now_ns + round((one.expires - now) * _SECOND),
            )
            for name, one in requirements.items()
            if self[name].values
        )

    def restore(self, saved: Iterable[SavedRequirement], now: float, now_ns: int) -> list[Requirement]:
        """Return the stored requirements that have not expired, and keep their clients for a grace period."""
        found = []
        for one in saved:
            requirement = one.requirement(self._attributes, self._resource, now, now_ns)
            if requirement is None:
                continue
            found.append(requirement)
            grace = now + limits.RESOURCE_CLIENT_GRACE
            self.known[one.client] = ClientRecord(one.mark, one.stamp, one.values, grace=grace)
            if one.stamp and requirement.expires is not None:
                self.expiries[one.client, one.stamp] = requirement.expires
        return found


class Persistence(RuntimePart):
    """The part of a resource that keeps its state in a file.

    No method blocks the event loop, and no failure of the disk stops the resource: it is logged once, and writing is
    tried again.

    Args:
        runtime: The runtime of the resource.
        collect: ``(now, now_ns)``: returns the present state; ``now`` in monotonic seconds, and the same moment by
            the clock of the result.
        path: The file; created with its folders if it does not exist.
    """

    def __init__(self, runtime: Runtime, collect: Callable[[float, int], SavedState], path: Path) -> None:
        super().__init__(runtime)
        self._collect = collect
        self._path = path
        self._lock: int | None = None
        self._started = False
        # The state that was written last, with times of the monotonic clock.
        self._written: SavedState | None = None
        self._writing: asyncio.Task[None] | None = None
        # Why nothing can be stored at present; empty if storing works.
        self._problem = ""

    async def restore(self) -> SavedState:
        """Read the file, restore the parameters and return the saved state; called before the parts start."""
        self._runtime.undo.push_async_callback(self.close)
        resource, name = self._runtime.resource, self._runtime.node.name
        found, lost = SavedState(), list[str]()
        try:
            async with asyncio.timeout(limits.STORE_TIMEOUT):
                found, lost = (await in_thread(self._read, f"read {self._path}")).checked(resource, time.time_ns())
        except OSError as error:
            self._set_problem(str(error) or "it does not answer")
        for text in lost:
            _log.warning("! %s: not restored: %s [state-lost]", name, text)
        for key, value in found.parameters.items():
            if not resource.parameters[key].given:
                resource.parameters[key].value = value
        if found.parameters or found.chosen or found.requirements:
            chosen = f", profile {found.chosen} chosen by hand" if found.chosen else ""
            counts = len(found.parameters), len(found.requirements)
            _log.info("= %s: remembered: %d parameters, %d clients%s", name, *counts, chosen)
        return found

    async def start(self) -> None:
        """Write the present state, and each change from now on."""
        self._started = True
        self.changed()

    async def close(self) -> None:
        """Write the last state; a disk that hangs is waited for 5 s at most."""
        if self._writing is not None:
            await asyncio.wait([self._writing], timeout=limits.STORE_TIMEOUT)
        if self._started:
            self._started = False
            await asyncio.wait([start_task(self._write(), f"write {self._path}")], timeout=limits.STORE_TIMEOUT)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def parameter_changed(self, parameter: Parameter) -> None:  # noqa: ARG002
        """Write the parameter's value."""
        self.changed()

    def changed(self) -> None:
        """Write the state if it has changed; called with each window too, so a write that failed is tried again."""
        idle = self._writing is None or self._writing.done()
        if self._started and idle and self._collect(0.0, 0) != self._written:
            self._writing = start_task(self._write(), f"write {self._path}")

    def problems(self) -> tuple[list[str], list[str]]:
        """Why nothing can be stored at present."""
        return [], [f"nothing is kept: {self._problem}"] if self._problem else []

    async def _write(self) -> None:
        state = self._collect(0.0, 0)
        content = msgspec.json.encode(self._collect(asyncio.get_running_loop().time(), time.time_ns()))
        try:
            await in_thread(functools.partial(self._replace, content), f"write {self._path}")
        except OSError as error:
            self._set_problem(str(error))
        else:
            self._written = state
            self._set_problem("")

    def _read(self) -> SavedState:
        """The content of the file; one that is damaged, or of another release, is set aside.

        Raises:
            OSError: It cannot be read, or another process uses it.
        """
        self._take_lock()
        try:
            data = self._path.read_bytes()
            found = msgspec.json.decode(data, type=SavedFormat).format
            if found == FORMAT:
                return msgspec.json.decode(data, type=SavedState)
            what, why = "before", f"is of another release of rmpa (format {found}, not {FORMAT})"
        except FileNotFoundError:
            return SavedState()
        except (msgspec.DecodeError, RecursionError) as error:
            what, why = "damaged", f"is damaged ({error})"
        aside = set_aside(self._path, what)
        _log.warning("! %s %s; it is kept as %s, and a new file begins [state-lost]", self._path, why, aside.name)
        return SavedState()

    def _replace(self, content: bytes) -> None:
        self._take_lock()
        replace_file(self._path, content)

    def _take_lock(self) -> None:
        """Lock the file against a second process: another module of the same name may run the same resource here.

        Raises:
            OSError: Another process holds the lock, or the folder cannot be written.
        """
        self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if self._lock is not None:
            return
        lock = os.open(self._path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(lock)
            if isinstance(error, BlockingIOError):
                raise OSError("another process uses it; name this module otherwise, or set --state") from None
            raise
        self._lock = lock

    def _set_problem(self, problem: str) -> None:
        """Log a problem when it begins and when it is over."""
        before, self._problem = self._problem, problem
        if problem and not before:
            _log.warning("! %s: nothing is kept: %s [state-lost]", self._path, problem)
        elif before and not problem:
            _log.info("= %s: everything is kept again", self._path)
