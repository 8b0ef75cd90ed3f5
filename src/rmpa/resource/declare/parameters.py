"""Parameters, inputs and outputs, profiles, behaviours and adaptation, as a user declares them.

How quickly a resource adapts: the parameters of its control loop.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.rules import CONTRACT_RULES, TERMS
from rmpa.config.values import BadValue, did_you_mean
from rmpa.core.contract import Contract
from rmpa.core.errors import ConfigError, LocalProtocolError
from rmpa.core.limits import INT32_MAX, INT32_MIN
from rmpa.resource.declare.attributes import quantity
from rmpa.resource.declare.requirements import find_attribute
from rmpa.ros.types.definitions import UnknownTypeError
from rmpa.ros.types.find import find_message_type

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.resource.declare.attributes import Attribute, Value
    from rmpa.resource.declare.requirements import QoSRequest, RequirementAnswer
    from rmpa.ros.types.messages import MessageType


@dataclass(frozen=True, slots=True)
class AdaptationSettings:
    """Parameters of a resource's control loop (``rmpa.resource.decide.adaptation``).

    Args:
        violations: ``k``: the number of violated windows among the last ``windows`` that is a disturbance.
        windows: ``n``: the number of last windows that are considered.
        improvement: ``h``: hysteresis; a change without a disturbance must reduce the distance by more than this.
        dwell: Least number of seconds that a profile runs before a change without a disturbance.
        settle: Settling time: windows that begin within so many seconds of a change are not judged, because messages
            that were queued under the previous profile still arrive.
        cool_down: Seconds for which a profile is excluded after it failed or was violated.
        cool_down_max: The longest cool-down; it doubles with each further failure.
        apply_timeout: Seconds after which a profile that is being applied counts as hung.
    """

    violations: int = 2
    windows: int = 3
    improvement: float = 0.05
    dwell: float = 2.0
    settle: float = 1.0
    cool_down: float = 10.0
    cool_down_max: float = 160.0
    apply_timeout: float = 5.0


_LEAST = {"window": 0.05, "dwell": 0.0, "settle": 0.0, "cool_down": 0.0, "apply_timeout": 0.01}
_DAY = 86400


def read_adaptation(
    where: str, violations: int, windows: int, improvement: float, times: dict[str, float | str]
) -> tuple[float, AdaptationSettings]:
    """Check the arguments of ``Resource.adaptation``.

    Args:
        where: Description of the settings, for errors.
        violations: As in ``AdaptationSettings``.
        windows: As in ``AdaptationSettings``.
        improvement: As in ``AdaptationSettings``.
        times: The other settings and ``window``, by name: seconds, or texts with a unit.

    Returns:
        The length of a quality window in seconds, and the settings.

    Raises:
        ConfigError: A time out of range, or more violations than windows.
    """
    if not 1 <= violations <= windows <= 100:
        raise ConfigError(where, f"{violations} of {windows} windows", "1 <= violations <= windows <= 100")
    seconds = {name: quantity(value, "s", f"{where}, {name}") for name, value in times.items()}
    for name, least in _LEAST.items():
        if not least <= seconds[name] <= _DAY:
            raise ConfigError(where, f"{name} is {seconds[name]:g} s", f"at least {least:g} s, at most a day")
    window = seconds.pop("window")
    seconds["cool_down_max"] = max(seconds["cool_down_max"], seconds["cool_down"])
    return window, AdaptationSettings(violations=violations, windows=windows, improvement=improvement, **seconds)


# Parameters of a resource: typed values with a range, which may change while it runs.


ParameterValue = bool | int | float | str
INT_MIN: Final = INT32_MIN
INT_MAX: Final = INT32_MAX
"""Bounds of integers, which have 32 bits in dynamic_reconfigure."""
_ROS_TYPES: Final = {bool: "bool", int: "int", float: "double", str: "str"}


@dataclass(eq=False)
class Parameter:
    """A parameter; its value may change while the resource runs.

    Args:
        name: The parameter's name, a ROS base name.
        default: The initial value; its type is the parameter's type.
        low: The least value of a number; ``None``: no declared bound.
        high: The greatest value of a number; ``None``: no declared bound.
        choices: The only valid values, if the parameter is an enumeration.
        unit: The unit, a text for people.
        description: A text for people.
        on_change: Called with the parameter, in the thread that changed it; ``None`` while the resource does not run.
    """

    name: str
    default: ParameterValue
    low: float | None = None
    high: float | None = None
    choices: tuple[ParameterValue, ...] = ()
    unit: str = ""
    description: str = ""
    on_change: Callable[[Parameter], None] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        self._value: Any = self.default
        self.given = False
        """Whether the value was given for this run (``rmpa run --set``); it then overrides stored values."""

    @property
    def value(self) -> Any:
        """The present value; may be set in any thread.

        Raises:
            ConfigError: On setting: the value is invalid.
        """
        return self._value

    @value.setter
    def value(self, value: ParameterValue) -> None:
        before, self._value = self._value, self.check(value)
        if self.on_change is not None and self._value != before:
            self.on_change(self)

    @property
    def type(self) -> str:
        """dynamic_reconfigure's type name: ``bool``, ``int``, ``double`` or ``str``."""
        return _ROS_TYPES[type(self.default)]

    @property
    def bounds(self) -> tuple[float, float]:
        """The least and the greatest value of a number: as declared, or else 32-bit for ``int`` and infinite."""
        low, high = (INT_MIN, INT_MAX) if isinstance(self.default, int) else (-math.inf, math.inf)
        return self.low if self.low is not None else low, self.high if self.high is not None else high

    def check_declaration(self, where: str) -> None:
        """Check the arguments of ``Resource.parameter``.

        Raises:
            ConfigError: The default's type is unknown, the bounds are the wrong way round or given for no number, or
                the default or a choice is invalid.
        """
        if type(self.default) not in _ROS_TYPES:
            raise ConfigError(
                where, f"{self.default!r} is no bool, int, float or str", "give a default of one of these"
            )
        if (self.low is not None or self.high is not None) and isinstance(self.default, bool | str):
            raise ConfigError(where, f"bounds of {self.default!r}, which is no number", "leave low and high out")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ConfigError(
                where, f"low is {self.low:g} and high {self.high:g}", "the bounds are the wrong way round"
            )
        for value in (*self.choices, self.default):
            self.check(value)

    def check(self, value: ParameterValue) -> ParameterValue:
        """Return the value, converted to ``float`` where that is the parameter's type.

        Raises:
            ConfigError: The value is of another type, out of range, or none of the choices.
        """
        where = f"parameter {self.name}"
        if isinstance(self.default, float) and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if type(value) is not type(self.default):
            raise ConfigError(where, f"{value!r} is no {self.type}", f"for example {self.default!r}")
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(where, f"{value} is no number that can be used", f"for example {self.default!r}")
        if self.choices and value not in self.choices:
            near = did_you_mean(str(value), map(str, self.choices))
            remedy = f"did you mean {near}?" if near else f"it is one of {', '.join(map(str, self.choices))}"
            raise ConfigError(where, f"{value!r} is none of its values", remedy)
        if not isinstance(value, str | bool):
            low, high = self.bounds
            if value < low:
                raise ConfigError(where, f"{value:g} is too little", f"the least is {low:g}")
            if value > high:
                raise ConfigError(where, f"{value:g} is too much", f"the most is {high:g}")
        return value


# Interfaces of a resource: outputs, inputs, attributes that the user's code observes, requirements on others.
#
# While the resource runs, ``rmpa.resource.run`` binds these to a node: it sets their fields ``on_…`` to its
# functions.


class TopicType:
    """The message type of an output or input: found on this machine, or learnt later from a publisher.

    Args:
        name: ``package/Name``.

    Raises:
        DefinitionError: The name is malformed, or rmpa comes with its package, which has no such type.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.known: MessageType | None = None
        """The type; ``None`` until it is known."""
        self.problem: UnknownTypeError | None = None
        """Why the type is not known on this machine; ``None`` if it is."""
        try:
            self.known = find_message_type(name)
        except UnknownTypeError as error:
            if not error.fetchable:
                raise
            self.problem = error

    def get(self) -> MessageType:
        """The message type.

        Raises:
            UnknownTypeError: The type is not known yet.
        """
        if self.known is None:
            assert self.problem is not None  # noqa: S101 - one of them is set
            raise self.problem
        return self.known


@dataclass(eq=False)
class Output:
    """A topic that the resource publishes.

    Args:
        name: The declared name, in the resource's namespace unless it is global.
        kind: The message type, which may be learnt later.
        contract: The offered QoS of the messages; the agent's rules are applied on top.
        latch: Whether a late subscriber gets the last message.
        on_publish: Called in any thread with ``(message fields, whole message)``; ``None`` while the resource does
            not run.
    """

    name: str
    kind: TopicType
    contract: Contract
    latch: bool = False
    on_publish: Callable[[Mapping[str, Any], object | None], None] | None = field(default=None, repr=False)

    @property
    def type(self) -> MessageType:
        """The output's message type.

        Raises:
            UnknownTypeError: The type is unknown on this machine, and no publisher of it has been found yet.
        """
        return self.kind.get()

    def publish(self, message: object | None = None, /, **values: Any) -> None:
        """Publish a message: an object, plain values (see ``MessageType.make``), or fields by name.

        While the resource is not active, messages are dropped, except those of functions of profiles and contexts:
        these are queued until it is active.

        Raises:
            MessageError: The message does not fit the output's type, or both a message and field values are given.
            LocalProtocolError: The resource does not run.
        """
        if self.on_publish is None:
            raise LocalProtocolError(f"{self.name} has nowhere to go: its resource does not run (rmpa run)")
        self.on_publish(values, message)


@dataclass(frozen=True, slots=True)
class Input:
    """A topic that the resource needs.

    Args:
        name: The declared name, in the resource's namespace unless it is global.
        kind: The message type; if it is unknown on this machine, it is learnt from the topic's first publisher.
        contract: The requested QoS of the messages.
        required: Whether the resource is stale while the topic has no publisher.
    """

    name: str
    kind: TopicType
    contract: Contract
    required: bool = True

    @property
    def type(self) -> MessageType:
        """The input's message type; raises ``UnknownTypeError`` while no publisher has been found."""
        return self.kind.get()


@dataclass(eq=False)
class DeclaredAttribute:
    """An attribute that a resource declares itself; the user's code reports its values by ``observe``.

    Args:
        attribute: The attribute.
        on_observation: Called in any thread with ``(attribute's name, value)``; ``None`` unless the resource runs.
    """

    attribute: Attribute
    on_observation: Callable[[str, Value], None] | None = field(default=None, repr=False)

    def observe(self, value: Value) -> None:
        """Report one observed value in the attribute's unit; without effect while the resource does not run.

        Raises:
            ConfigError: The value is not valid for this attribute.
        """
        checked = self.attribute.check(value, f"observation of {self.attribute.name}")
        if self.on_observation is not None:
            self.on_observation(self.attribute.name, checked)


@dataclass(eq=False)
class Demand:
    """The standing requirement of a resource on another one, in the same or another module.

    Args:
        resource: Name of the other resource's node in this module's graph: ``/sonar``, ``/robot1/sonar``.
        requests: QoS requests by attribute of the other resource; empty: none at present.
        priority: In a conflict between clients the higher priority wins.
        answer: The last answer; ``None`` before the first.
        on_change: Called with this demand, in any thread, when the requests change; ``None`` while the resource does
            not run.
    """

    resource: str
    requests: Mapping[str, QoSRequest] = field(default_factory=dict)
    priority: int = 0
    answer: RequirementAnswer | None = field(default=None, repr=False)
    on_change: Callable[[Demand], None] | None = field(default=None, repr=False)

    def ask(self, **requests: QoSRequest) -> None:
        """Replace the requests; without arguments nothing is requested. May be called in any thread."""
        self.requests = requests
        if self.on_change is not None:
            self.on_change(self)


# System Profiles: configurations of a resource, each with the quality that it offers (paper, section 3.1).


@dataclass(frozen=True, slots=True)
class Profile:
    """One System Profile, as a resource declares it.

    Args:
        name: Unique within the resource.
        offers: The offered value of each attribute, in the attribute's unit. An attribute that only other profiles
            offer falls short of every request.
        cost: At least 0, in any unit that all profiles share; decides among profiles of nearly equal distance.
        best_effort: Whether the profile runs when none meets the requirements; a resource has at most one such.
        description: A text for people.
    """

    name: str
    offers: Mapping[str, Value] = field(hash=False)
    cost: float = 0.0
    best_effort: bool = False
    description: str = ""


def check_profiles(profiles: Iterable[Profile], attributes: Mapping[str, Attribute], resource: str) -> None:
    """Check the profiles of a resource.

    Raises:
        ConfigError: A duplicate name, an undeclared attribute, an invalid value, a cost below 0, two best-effort
            profiles, or no profile at all.
    """
    seen: set[str] = set()
    best = ""
    for profile in profiles:
        where = f"profile {profile.name} of {resource}"
        if profile.name in seen:
            raise ConfigError(where, "there are two of this name", "name one of them otherwise")
        seen.add(profile.name)
        if not (math.isfinite(profile.cost) and profile.cost >= 0):
            raise ConfigError(where, f"a cost of {profile.cost:g}", "it is at least 0")
        if profile.best_effort and best:
            raise ConfigError(where, f"{best} is the best-effort profile already", "mark one of them only")
        best = profile.name if profile.best_effort else best
        for name, value in profile.offers.items():
            find_attribute(attributes, name, resource).check(value, f"{where}, {name}")
    if not seen:
        raise ConfigError(resource, "it has no profile", "declare at least one")


# Checks the arguments of a declaration: functions, keys of a contract, values of an ``Enum``.


def check_arity(function: Callable[..., object], count: int, where: str) -> None:
    """Check that a function can be called with ``count`` arguments.

    Raises:
        ConfigError: The function cannot be called that way; ``where`` begins the error's text.
    """
    what = "without arguments" if not count else "with the message"
    try:
        inspect.signature(function).bind(*[None] * count)
    except TypeError as error:
        name = getattr(function, "__name__", "its function")
        raise ConfigError(where, f"{name} cannot be called {what}: {error}", "change its arguments") from None
    except ValueError:
        pass  # a callable without a signature, such as some built-in ones


def read_contract(where: str, terms: Mapping[str, object]) -> Contract:
    """Make the contract of an output or input from the keys of a ``[[contract]]`` (docs/contracts.md).

    Raises:
        ConfigError: A key is unknown or a value is invalid; ``where`` begins the error's text.
    """
    for term in terms:
        if term not in TERMS:
            near = did_you_mean(term, TERMS)
            remedy = f"did you mean {near}?" if near else f"known here: {', '.join(TERMS)}"
            raise ConfigError(where, f"a contract has no {term!r}", remedy)
    if not terms:
        return Contract()
    try:
        rules = CONTRACT_RULES.read([{"topics": ["/**"], **terms}])
    except BadValue as error:
        key = error.at[-1] if error.at else ""
        remedy = error.remedy or (f"did you mean {error.better}?" if error.better else "")
        raise ConfigError(f"{where}, {key}" if key else where, error.problem, remedy) from None
    return Contract(**rules[0].values)  # type: ignore[arg-type] # as ContractRule.values promises


def read_enum(kind: type[Any], text: str, where: str) -> Any:
    """Find the member of an ``Enum`` by its value.

    Raises:
        ConfigError: The ``Enum`` has no such value; ``where`` begins the error's text.
    """
    known = [item.value for item in kind]
    if text not in known:
        near = did_you_mean(text, known)
        remedy = f"did you mean {near}?" if near else f"it is one of {', '.join(known)}"
        raise ConfigError(where, f"{text!r} is not known here", remedy)
    return kind(text)


# Behaviour of a resource: its tasks, profiles with their functions, and contexts.


Hook = Callable[[], Awaitable[None] | None]
TaskFunction = Callable[..., Awaitable[None] | None]
"""The function of a task: a periodic one takes no argument, one that runs on an input takes the message."""


class OnFailure(StrEnum):
    """What happens to a task that has raised or is stuck."""

    RESTART = "restart"
    """The task runs again after a back-off, which grows with each consecutive failure."""
    STOP = "stop"
    """The task ends; the resource reports that and continues without the task."""
    DEACTIVATE = "deactivate"
    """The whole resource becomes inactive."""


@dataclass(frozen=True, slots=True)
class DeclaredProfile:
    """A System Profile with the function that applies it."""

    profile: Profile
    apply: Hook
    needs: Callable[[], str | bool | None] | None = None
    """The precondition: true or ``None`` while the profile may be used, else false or the reason as a text."""


@dataclass(frozen=True, slots=True)
class Context:
    """A state of the world: what it requires, and which profiles and outputs apply in it.

    Args:
        name: Unique within the resource.
        when: A rule over topics and parameters (``resource.declare.attributes``) that selects the context; empty:
            it is chosen by hand only.
        requires: QoS requests on the resource itself, by attribute.
        profiles: The only profiles that may run in the context; empty: any.
        outputs: The only outputs that are published in the context, by name; ``None``: all.
        enter: Called when the context is entered.
    """

    name: str
    when: str = ""
    requires: Mapping[str, QoSRequest] = field(default_factory=dict, hash=False)
    profiles: tuple[str, ...] = ()
    outputs: tuple[str, ...] | None = None
    enter: Hook | None = None


@dataclass(frozen=True, slots=True)
class Task:
    """A function of the resource that runs periodically or on each message of an input.

    Args:
        name: Unique within the resource; the function's name by default.
        function: A plain function, which runs in a thread of its own, or a coroutine function.
        rate: Rate in Hz of a periodic task; ``None`` for a task that runs on messages.
        on: The input on whose messages the task runs; ``None`` for a periodic task.
        on_failure: What happens when a run raises or is stuck.
        stuck_after: Seconds that one run may take before it counts as stuck; ``None``: ten periods, at least 5 s.
        rate_parameter: The parameter whose value is the rate, or ``None``.
    """

    name: str
    function: TaskFunction
    rate: float | None = None
    on: Input | None = None
    on_failure: OnFailure = OnFailure.RESTART
    stuck_after: float | None = None
    rate_parameter: Parameter | None = None
