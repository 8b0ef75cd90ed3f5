"""The parts of a declaration: parameters, topics, profiles, contexts with their rules, tasks; and their checks.

While the resource runs, ``rmpa.resource.runtime`` binds these to a node: it sets their fields ``on_…``.
"""

from __future__ import annotations

import inspect
import math
import operator
import re
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.rules import CONTRACT_RULES, TERMS
from rmpa.config.values import BadValue, did_you_mean, suggestion
from rmpa.core.contract import Contract
from rmpa.core.errors import ConfigError, LocalProtocolError
from rmpa.core.limits import INT32_MAX, INT32_MIN
from rmpa.resource import limits
from rmpa.ros.types.definitions import UnknownTypeError
from rmpa.ros.types.find import find_message_type

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator

    from rmpa.resource.quality import Attribute, QoSRequest, RequirementAnswer, Value
    from rmpa.ros.types.messages import MessageType

Hook = Callable[[], Awaitable[None] | None]
ParameterValue = bool | int | float | str
_ROS_TYPES: Final = {bool: "bool", int: "int", float: "double", str: "str"}


@dataclass(frozen=True, slots=True)
class AdaptationSettings:
    """Parameters of a resource's control loop (``rmpa.resource.adaptation``).

    Args:
        violations: ``k``: the number of violated windows among the last ``windows`` that is a disturbance.
        windows: ``n``: the number of last windows that are considered.
        improvement: ``h``: hysteresis; a change without a disturbance must reduce the distance by more than this.
        window: Length of a quality window, in seconds.
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
    window: float = 1.0
    dwell: float = 2.0
    settle: float = 1.0
    cool_down: float = 10.0
    cool_down_max: float = 160.0
    apply_timeout: float = 5.0


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

    Raises:
        DefinitionError: The type's name is malformed, or rmpa comes with its package, which has no such type.
    """

    def __init__(self, name: str, type_name: str, contract: Contract) -> None:
        self.name = name
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
    """A topic that the resource publishes."""

    # Whether a late subscriber gets the last message.
    latch = False
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


@dataclass(frozen=True, slots=True)
class Profile:
    """One System Profile: a configuration of the resource, with the quality that it offers (paper, section 3.1).

    Args:
        name: Unique within the resource.
        offers: The offered value of each attribute, in the attribute's unit. An attribute that only other profiles
            offer falls short of every request.
        cost: At least 0, in any unit that all profiles share; decides among profiles of nearly equal distance.
        best_effort: Whether the profile runs when none meets the requirements; a resource has at most one such.
        description: A text for people.
        apply: The function that applies it.
        needs: The precondition: true or ``None`` while the profile may be used, else false or the reason as a text.
    """

    name: str
    offers: Mapping[str, Value] = field(hash=False)
    cost: float = 0.0
    best_effort: bool = False
    description: str = ""
    apply: Hook = lambda: None
    needs: Callable[[], str | bool | None] | None = None


@dataclass(frozen=True, slots=True)
class Context:
    """A state of the world: what it requires, and which profiles and outputs apply in it.

    Args:
        name: Unique within the resource.
        when: A rule over topics and parameters (``parse_rule``) that selects the context; empty: it is chosen by hand
            only.
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


def _refuse_unknown(where: str, problem: str, text: str, known: Iterable[str], listed: str = "it is one of ") -> None:
    names = list(known)
    raise ConfigError(where, problem, suggestion(text, names, f"{listed}{', '.join(names)}"))


# Rules that select a context by fields of topics and by the resource's parameters::
#
#     rule       = conjunction { "or" conjunction }
#     conjunction= negation { "and" negation }
#     negation   = "not" negation | "(" rule ")" | value [ ("==" | "!=" | "<" | "<=" | ">" | ">=") value ]
#     value      = number | 'text' | "text" | true | false | ~parameter | /topic | /topic/field | /topic.field.field
#
# Example: ``/battery/charging == true and ~gain > 3``. In ``/battery/charging`` the longest part that is a published
# topic is the topic, as for rostopic; ``/battery.charging`` is explicit. A topic alone means the message's only field
# (``std_msgs/Bool``). A value that is unknown (no message yet, no publisher) makes a comparison neither true nor
# false. A rule holds only if it is true whatever the unknown values are (Kleene's logic).
#
# Pure: a rule is parsed once, into a function of the values; nothing is evaluated as Python.


# A value that rules can compare.
Scalar = bool | int | float | str
_Holds = Callable[[Mapping[str, Scalar]], bool | None]
_TOKEN: Final = re.compile(
    r"\s*(?:(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.]))"
    r"|(?P<text>'[^']*'|\"[^\"]*\")"
    r"|(?P<reference>/[A-Za-z]\w*(?:/\w+)*(?:\.\w+)*|~[A-Za-z]\w*)"
    r"|(?P<word>[A-Za-z_]\w*)"
    r"|(?P<sign>==|!=|<=|>=|<|>|\(|\)))"
)
_SIGNS: Final[Mapping[str, Callable[[Any, Any], bool]]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_KEYWORDS: Final = ("and", "or", "not", "true", "false")


@dataclass(frozen=True, slots=True)
class ContextRule:
    """A parsed rule.

    Args:
        holds: Whether the rule is true by the known values, which are by reference; ``None``: that depends on unknown
            values.
        references: Each variable of the rule once, as written there: ``/topic.field`` or ``~parameter``.
    """

    holds: _Holds
    references: tuple[str, ...]


def parse_rule(text: str, parameters: Collection[str], where: str = "rule") -> ContextRule:
    """Parse a rule.

    Args:
        text: A ``rule`` of the grammar above.
        parameters: Names of the resource's parameters.
        where: Description of the rule, for errors.

    Raises:
        ConfigError: The rule has a syntax error or an unknown parameter, or is too long or nested too deeply.
    """
    if len(text) > limits.CONTEXT_RULE_MAX:
        raise ConfigError(where, f"{len(text)} characters", f"at most {limits.CONTEXT_RULE_MAX}")
    parser = _RuleParser(text, where)
    holds = parser.parse()
    for name in (reference[1:] for reference in parser.references if reference.startswith("~")):
        if name not in parameters:
            near = did_you_mean(name, parameters)
            remedy = f"did you mean ~{near}?" if near else "declare it before the context"
            raise ConfigError(where, f"there is no parameter {name}", remedy)
    return ContextRule(holds, tuple(parser.references))


def split_reference(text: str) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Possible splits of a reference into a topic and its fields, longest topic first; no field: the only one."""
    topic, dot, fields = text.partition(".")
    if dot:
        yield topic, tuple(fields.split("."))
        return
    parts = topic.strip("/").split("/")
    for count in range(len(parts), 0, -1):
        yield "/" + "/".join(parts[:count]), tuple(parts[count:])


class _RuleParser:
    """A recursive-descent parser of one rule."""

    def __init__(self, text: str, where: str) -> None:
        self._text = text
        self._where = where
        self.references: dict[str, None] = {}
        self._tokens: deque[tuple[str, str]] = deque()
        at = 0
        while rest := text[at:].strip():
            if (match := _TOKEN.match(text, at)) is None:
                raise self._error(f"{rest[:20]!r} cannot be read")
            kind = match.lastgroup or ""
            self._tokens.append((kind, match[kind]))
            at = match.end()
        self._tokens.append(("", ""))

    def parse(self) -> _Holds:
        holds = self._rule(0)
        if self._tokens[0][0]:
            raise self._error(f"{self._tokens[0][1]!r} stands where the rule must end, or go on with and/or")
        return holds

    def _take(self, *lexemes: str) -> str:
        """Remove the next token and return it if it is one of these; else nothing."""
        return self._tokens.popleft()[1] if self._tokens[0][1] in lexemes else ""

    def _rule(self, depth: int) -> _Holds:
        return self._chain("or", lambda: self._chain("and", lambda: self._negation(depth)))

    def _chain(self, word: str, part: Callable[[], _Holds]) -> _Holds:
        parts = [part()]
        while self._take(word):
            parts.append(part())
        decisive = word == "or"  # one true decides an "or", one false an "and"

        def holds(values: Mapping[str, Scalar]) -> bool | None:
            found = [each(values) for each in parts]
            if decisive in found:
                return decisive
            return None if None in found else not decisive

        return holds

    def _negation(self, depth: int) -> _Holds:
        if depth > limits.CONTEXT_RULE_DEPTH:
            raise self._error(f"deeper than {limits.CONTEXT_RULE_DEPTH} brackets")
        if self._take("not"):
            inner = self._negation(depth + 1)
            return lambda values: None if (found := inner(values)) is None else not found
        if self._take("("):
            inner = self._rule(depth + 1)
            if not self._take(")"):
                raise self._error("a bracket is not closed")
            return inner
        left = self._value()
        sign = self._take(*_SIGNS)
        right = self._value() if sign else ("", True)
        return lambda values: _compare(_SIGNS[sign or "=="], *(values.get(r) if r else v for r, v in (left, right)))

    def _value(self) -> tuple[str, Scalar]:
        """A reference, or an empty one with a constant."""
        kind, piece = self._tokens[0]
        if kind == "word" and piece not in ("true", "false"):
            near = did_you_mean(piece, _KEYWORDS) if piece not in _KEYWORDS else None
            raise self._error(f"{piece!r} is no value", f"did you mean {near}?" if near else "texts have quotes")
        if not kind or kind == "sign":
            raise self._error(f"a value is missing in front of {piece!r}" if piece else "a value is missing")
        self._tokens.popleft()
        if kind == "reference":
            self.references[piece] = None
            return piece, ""
        return "", piece == "true" if kind == "word" else float(piece) if kind == "number" else piece[1:-1]

    def _error(
        self, problem: str, remedy: str = "for example /battery/charging == true and ~gain > 3"
    ) -> ConfigError:
        return ConfigError(self._where, f"{self._text!r}: {problem}", remedy)


def _compare(compare: Callable[[Any, Any], bool], left: Scalar | None, right: Scalar | None) -> bool | None:
    """Compare two values; numbers and booleans as Python does, since a ROS ``bool`` may be 0 or 1."""
    if left is None or right is None or left != left or right != right:  # noqa: PLR0124 - NaN
        return None
    if isinstance(left, str) != isinstance(right, str):
        return compare is operator.ne  # a text equals only texts
    if isinstance(left, str) and compare not in (operator.eq, operator.ne):
        return False  # texts have no order
    return compare(left, right)
