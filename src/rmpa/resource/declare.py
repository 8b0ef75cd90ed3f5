"""The parts of a declaration: parameters, topics, nodes, contexts, alarms, tasks; and their checks.

While the resource runs, ``rmpa.resource.runtime`` binds these to a node: it sets their fields ``on_…``.
"""

from __future__ import annotations

import inspect
import math
import shlex
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.rules import CONTRACT_RULES, TERMS
from rmpa.config.values import BadValue, suggestion
from rmpa.core.contract import Contract
from rmpa.core.errors import ConfigError, LocalProtocolError
from rmpa.core.identity import is_legal_name
from rmpa.core.limits import INT32_MAX, INT32_MIN
from rmpa.ros.types.definitions import UnknownTypeError
from rmpa.ros.types.find import find_message_type

if TYPE_CHECKING:
    from rmpa.resource.expression import Expression
    from rmpa.resource.quality import Attribute, QoSRequest, RequirementAnswer, Value
    from rmpa.ros.types.messages import MessageType

Hook = Callable[[], Awaitable[None] | None]
ParameterValue = bool | int | float | str
_ROS_TYPES: Final = {bool: "bool", int: "int", float: "double", str: "str"}


class Role(StrEnum):
    """The function of a module in the robot (paper, section 3)."""

    SENSING = "sensing"
    ACTING = "acting"
    CONTROLLING = "controlling"


class Measure(StrEnum):
    """How a topic that another node publishes is measured."""

    # By subscribing; what carries more than ``limits.MEASURED_BYTES`` a second by the node's own counters.
    AUTO = "auto"
    # By subscribing: every message is counted, and stamps give the latency.
    SUBSCRIBE = "subscribe"
    # By the node's own counters of its connections (getBusStats): rate and bandwidth, without another subscriber.
    COUNTERS = "counters"


class BindingKind(StrEnum):
    """Where another node has the value of a parameter."""

    # dynamic_reconfigure of the node; a change takes effect at once.
    DYNAMIC = "dynamic"
    # A parameter below the node's name on the parameter server, which most nodes read only at their start.
    PRIVATE = "private"
    # An argument of the launch file that the resource starts; a change restarts it.
    ARGUMENT = "arg"


@dataclass(frozen=True, slots=True)
class Binding:
    """Where the value of a parameter is, if another node has it.

    Args:
        kind: Where the value is.
        node: The declared name of the node (``ManagedNode.key``).
        name: The parameter's name there.
        restart: Whether the node must be restarted to take a new value.
    """

    kind: BindingKind
    node: str
    name: str
    restart: bool = False

    def __str__(self) -> str:
        """``driver dynamic frame_rate``, as descriptors have it."""
        return f"{self.node} {self.kind} {self.name}"


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
        binding: Where another node has the value; ``None``: the resource itself has it.
    """

    name: str
    default: ParameterValue
    low: float | None = None
    high: float | None = None
    choices: tuple[ParameterValue, ...] = ()
    unit: str = ""
    description: str = ""
    on_change: Callable[[Parameter], None] | None = field(default=None, repr=False)
    binding: Binding | None = None

    def __post_init__(self) -> None:
        self._value: Any = self.default
        # Whether the value was given for this run (``rmpa run --set``); it then overrides stored values.
        self.given = False

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
        low, high = (INT32_MIN, INT32_MAX) if isinstance(self.default, int) else (-math.inf, math.inf)
        return self.low if self.low is not None else low, self.high if self.high is not None else high

    def check_declaration(self, where: str) -> None:
        """Check the arguments of ``Resource.parameter``.

        Raises:
            ConfigError: The default's type is unknown, the bounds are the wrong way round or given for no number, or
                the default or a choice is invalid.
        """
        low, high = self.low, self.high
        if type(self.default) not in _ROS_TYPES:
            problem = f"{self.default!r} is no bool, int, float or str"
            raise ConfigError(where, problem, "give a default of one of these")
        if (low is not None or high is not None) and isinstance(self.default, bool | str):
            raise ConfigError(where, f"bounds of {self.default!r}, which is no number", "leave low and high out")
        if low is not None and high is not None and low > high:
            raise ConfigError(where, f"low is {low:g} and high {high:g}", "the bounds are the wrong way round")
        for value in (*self.choices, self.default):
            self.check(value)

    def check_rate(self, most: float, where: str) -> None:
        """Check that each of its values can be the rate of a task, at most ``most`` Hz.

        Raises:
            ConfigError: It is no number, or has other bounds.
        """
        low, high = self.bounds
        if self.type not in ("int", "double") or not low > 0 or not high <= most:
            remedy = f"declare it with low above 0 and high at most {most:g}"
            raise ConfigError(where, f"{self.name} may be what no rate can be", remedy)

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
            _refuse_unknown(where, f"{value!r} is none of its values", str(value), map(str, self.choices))
        if not isinstance(value, str | bool):
            low, high = self.bounds
            if value < low:
                raise ConfigError(where, f"{value:g} is too little", f"the least is {low:g}")
            if value > high:
                raise ConfigError(where, f"{value:g} is too much", f"the most is {high:g}")
        return value


class DeclaredTopic:
    """An output or input; its type is found on this machine, or learnt later from a publisher.

    Args:
        name: The declared name, in the resource's namespace unless it is global.
        type_name: Name of the message type, ``package/Name``.
        contract: The offered or requested QoS of the messages; for outputs the agent's rules are applied on top.
        label: The prefix of its measured attributes; empty: made of the name (``Resource.labels``).

    Raises:
        DefinitionError: The type's name is malformed, or rmpa comes with its package, which has no such type.
    """

    # Whether another node publishes or receives it, so that the resource only measures it or looks for a publisher.
    observed = False

    def __init__(self, name: str, type_name: str, contract: Contract, label: str = "") -> None:
        self.name = name
        self.label = label
        self.type_name = type_name
        self.contract = contract
        # The type; ``None`` until it is known.
        self.known: MessageType | None = None
        # Why the type is not known on this machine; ``None`` if it is.
        self.problem: UnknownTypeError | None = None
        try:
            self.known = find_message_type(type_name)
        except UnknownTypeError as error:
            if not error.fetchable:
                raise
            self.problem = error

    @property
    def type(self) -> MessageType:
        """The message type.

        Raises:
            UnknownTypeError: The type is unknown on this machine, and no publisher of it has been found yet.
        """
        if self.known is None:
            assert self.problem is not None  # noqa: S101 - one of them is set
            raise self.problem
        return self.known


class Output(DeclaredTopic):
    """A topic that the resource publishes, or that another node publishes for it."""

    # Whether a late subscriber gets the last message.
    latch = False
    # How an observed one is measured.
    measure = Measure.AUTO
    # Called in any thread with ``(message fields, whole message)``; ``None`` while the resource does not run.
    on_publish: Callable[[Mapping[str, Any], object | None], None] | None = None

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


class Input(DeclaredTopic):
    """A topic that the resource needs."""

    # Whether the resource is stale while the topic has no publisher.
    required = True


@dataclass(eq=False)
class DeclaredAttribute:
    """An attribute that a resource declares itself; the user's code reports its values by ``observe``.

    Args:
        attribute: The attribute.
        on_observation: Called in any thread with ``(attribute's name, value)``; ``None`` unless the resource runs.
        value: The expression that gives its value at the end of each window; ``None``: ``observe`` alone does.
    """

    attribute: Attribute
    on_observation: Callable[[str, Value], None] | None = field(default=None, repr=False)
    value: Expression | None = None

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


@dataclass(frozen=True, slots=True)
class AlarmRule:
    """An alarm that a rule raises, beside those of the control loop.

    Args:
        name: Unique within the resource.
        when: The rule; the alarm stands while it is true.
        error: Whether it is an ERROR; else a WARN.
        text: What people read; empty: the rule.
    """

    name: str
    when: Expression
    error: bool = False
    text: str = ""

    def __str__(self) -> str:
        """What people read."""
        return self.text or f"alarm {self.name}: {self.when}"


class RestartPolicy(StrEnum):
    """When a started process that has ended is started again."""

    ALWAYS = "always"
    # If it ended with another exit code than 0, or by a signal.
    ON_FAILURE = "on-failure"
    NEVER = "never"


@dataclass(frozen=True, slots=True)
class ManagedNode:
    """A ROS node that exists without the resource: it is attached to, and started if the declaration says how.

    Args:
        key: Its name in the declaration.
        name: Global name of the node.
        run: ``PACKAGE EXECUTABLE``, as for rosrun; empty: it is not started so.
        launch: ``PACKAGE FILE`` or a path, as for roslaunch; ``name`` is one of its nodes.
        command: A program with its arguments.
        args: Further arguments: of the program, or ``name:=value`` of the launch file.
        params: Private parameters that are set on the parameter server before it starts.
        remap: Names of topics and services that it has otherwise, by its own name for them.
        env: Variables of the environment.
        restart: When it is started again.
        stop_after: Seconds that it may take to end after SIGINT, before SIGTERM and SIGKILL follow.
        server: Global name of its dynamic_reconfigure server, such as that of a nodelet in it; empty: the node's own.
    """

    key: str
    name: str
    run: str = ""
    launch: str = ""
    command: tuple[str, ...] = ()
    args: tuple[str, ...] = ()
    params: Mapping[str, ParameterValue] = field(default_factory=dict, hash=False)
    remap: Mapping[str, str] = field(default_factory=dict, hash=False)
    env: Mapping[str, str] = field(default_factory=dict, hash=False)
    restart: RestartPolicy = RestartPolicy.ON_FAILURE
    stop_after: float = 10.0
    server: str = ""

    def check(self, where: str) -> None:
        """Check the names in it, and how it is started.

        Raises:
            ConfigError: A name is illegal, or there are several ways to start it; ``where`` begins the error's text.
        """
        if not self.key or not is_legal_name(self.key) or "/" in self.key or self.key.startswith("~"):
            raise ConfigError(where, f"{self.key!r} is not a base name", "letters, digits and _, a letter first")
        if not self.name.startswith("/") or not is_legal_name(self.name) or self.name == "/":
            raise ConfigError(where, f"{self.name!r} is not a global name of a node", f"for example /{self.key}")
        if sum(map(bool, (self.run, self.launch, self.command))) > 1:
            raise ConfigError(where, "run, launch and command are three ways to start it", "keep one of them")
        if self.server and (not self.server.startswith("/") or not is_legal_name(self.server)):
            raise ConfigError(where, f"{self.server!r} is not a global name", f"for example {self.name}/debayer")
        for text, least in ((self.run, 2), (self.launch, 1)):
            try:
                enough = not text or len(shlex.split(text)) >= least
            except ValueError:  # a quote is not closed
                enough = False
            if not enough:
                raise ConfigError(where, f"{text!r} does not name a program", "write PACKAGE NAME, as for rosrun")

    @property
    def started(self) -> bool:
        """Whether the declaration says how it is started."""
        return bool(self.run or self.launch or self.command)

    @property
    def how(self) -> str:
        """How it is started, as descriptors have it; a command's words are told to no other module."""
        if self.command:
            return "command"
        return f"run {self.run}" if self.run else f"launch {self.launch}" if self.launch else "attached"


@dataclass(frozen=True, slots=True)
class Context:
    """A state of the world: what it requires, and which profiles and outputs apply in it.

    Args:
        name: Unique within the resource.
        when: The rule that selects the context; ``None``: it is chosen by hand only.
        requires: QoS requests on the resource itself, by attribute.
        profiles: The only profiles that may run in the context; empty: any.
        outputs: The only outputs that are published in the context, by name; ``None``: all.
        enter: Called when the context is entered.
    """

    name: str
    when: Expression | None = None
    requires: Mapping[str, QoSRequest] = field(default_factory=dict, hash=False)
    profiles: tuple[str, ...] = ()
    outputs: tuple[str, ...] | None = None
    enter: Hook | None = None


class OnFailure(StrEnum):
    """What happens to a task that has raised or is stuck."""

    # The task runs again after a back-off, which grows with each consecutive failure.
    RESTART = "restart"
    # The task ends; the resource reports that and continues without the task.
    STOP = "stop"
    # The whole resource becomes inactive.
    DEACTIVATE = "deactivate"


@dataclass(frozen=True, slots=True)
class Task:
    """A function of the resource that runs periodically or on each message of an input.

    Args:
        name: Unique within the resource; the function's name by default.
        function: A plain function, which runs in a thread of its own, or a coroutine function. A periodic task's
            takes no argument, that of a task on an input takes the message.
        rate: Rate in Hz of a periodic task; ``None`` for a task that runs on messages.
        on: The input on whose messages the task runs; ``None`` for a periodic task.
        on_failure: What happens when a run raises or is stuck.
        stuck_after: Seconds that one run may take before it counts as stuck; ``None``: ten periods, at least 5 s.
        rate_parameter: The parameter whose value is the rate, or ``None``.
    """

    name: str
    function: Callable[..., Awaitable[None] | None]
    rate: float | None = None
    on: Input | None = None
    on_failure: OnFailure = OnFailure.RESTART
    stuck_after: float | None = None
    rate_parameter: Parameter | None = None


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
    """Make the contract of an output or input from the keys of a ``[[contract]]`` (docs/guides/contracts.md).

    Raises:
        ConfigError: A key is unknown or a value is invalid; ``where`` begins the error's text.
    """
    for term in terms:
        if term not in TERMS:
            _refuse_unknown(where, f"a contract has no {term!r}", term, TERMS, "known here: ")
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
        ConfigError: The ``Enum`` has no such value.
    """
    known = [item.value for item in kind]
    if text not in known:
        _refuse_unknown(where, f"{text!r} is not known here", text, known)
    return kind(text)


def check_known(kind: str, names: Iterable[str], known: Mapping[str, object], where: str, remedy: str = "") -> None:
    """Check that names are declared; ``where`` begins the error's text, and ``remedy`` is for one like no other.

    Raises:
        ConfigError: One is not.
    """
    for name in names:
        if name not in known:
            otherwise = remedy or f"declared are {', '.join(known) or 'none'}"
            raise ConfigError(where, f"there is no {kind} {name}", suggestion(name, known, otherwise))


def _refuse_unknown(where: str, problem: str, text: str, known: Iterable[str], listed: str = "it is one of ") -> None:
    names = list(known)
    raise ConfigError(where, problem, suggestion(text, names, f"{listed}{', '.join(names)}"))
