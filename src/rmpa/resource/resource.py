"""``Resource``: the declaration of a Smart Resource. Nothing runs here; ``rmpa.resource.node`` executes it.

::

    sonar = Resource("sonar", role="sensing")
    ranges = sonar.output("ranges", "sensor_msgs/Range", deadline="100 ms")
    gain = sonar.parameter("gain", 1.0, low=0.0, high=10.0)

    @sonar.profile(offers={"rate": "40 Hz"})
    def precise() -> None: ...

    @sonar.task(rate="40 Hz")
    def measure() -> None:
        ranges.publish(range=0.3)

Each of these calls checks its arguments and raises ``ConfigError`` with the problem and a remedy.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

from rmpa.config.values import suggestion
from rmpa.core.errors import ConfigError
from rmpa.core.identity import is_legal_name
from rmpa.resource import declare
from rmpa.resource.adaptation import AdaptationSettings
from rmpa.resource.decision import OfferSource, Profile
from rmpa.resource.declare import AlarmRule, Context, DeclaredAttribute, Demand, Input, Output, Parameter, Role, Task
from rmpa.resource.expression import Expression, parse_expression
from rmpa.resource.quality import MEASURED, Attribute, Category, Direction, Scale, find_attribute, quantity
from rmpa.runtime.programs import StartRule

if TYPE_CHECKING:
    from pathlib import Path

    from rmpa.resource.declare import Binding, Hook, ManagedNode, ParameterValue
    from rmpa.resource.quality import QoSRequest

# The highest rate of a periodic task, in Hz.
_RATE_MAX: Final = 10_000
# Functions of rules that are about a node, without an argument about the only one.
_OF_NODES: Final = ("cpu", "memory", "running")
_Function = TypeVar("_Function", bound=Callable[..., object])
# Names below a resource's node that are reserved for topics, services and parameters of every resource.
RESERVED: Final = frozenset(
    {
        "alarms", "attributes", "context", "decision", "descriptor", "observed", "parameter_descriptions",
        "parameter_updates", "profile", "quality", "requirements", "responses", "set_context", "set_parameters",
        "state",
    }
)  # fmt: skip
# Keys of requirements and quality reports that cannot be names of attributes.
NOT_ATTRIBUTES: Final = frozenset({"expires", "level_for", "priority", "profile", "reaction"})


class Resource:
    """The declaration of one Smart Resource. Its tables have the parts in the order in which they were declared.

    Args:
        name: A ROS base name; the resource's node is ``/<name>``.
        role: ``sensing``, ``acting`` or ``controlling``.
        physical: Whether the resource has a real device; else it is simulated.
        description: A text for people.

    Raises:
        ConfigError: The name is illegal or the role is unknown.
    """

    def __init__(self, name: str, *, role: str, physical: bool = True, description: str = "") -> None:
        if not name or not is_legal_name(name) or "/" in name or name.startswith("~"):
            raise ConfigError("resource", f"{name!r} is not a ROS base name", "letters, digits and _, a letter first")
        if role not in set(Role):
            remedy = suggestion(role, list(Role), f"it is one of {', '.join(Role)}")
            raise ConfigError(f"resource {name}", f"there is no role {role!r}", remedy)
        self.name = name
        self.role = Role(role)
        self.physical = physical
        self.description = description
        self.outputs: dict[str, Output] = {}
        self.inputs: dict[str, Input] = {}
        self.parameters: dict[str, Parameter] = {}
        self.declared_attributes: dict[str, DeclaredAttribute] = {}
        self.profiles: dict[str, Profile] = {}
        self.contexts: dict[str, Context] = {}
        self.tasks: dict[str, Task] = {}
        self.demands: dict[str, Demand] = {}
        self.hooks: dict[str, Hook] = {}
        # Nodes that exist without the resource, by their declared names.
        self.nodes: dict[str, ManagedNode] = {}
        self.alarms: dict[str, AlarmRule] = {}
        self.start = StartRule()
        # Base name of the file that declares it; empty: unknown.
        self.file = ""
        # The folder of the file that declares it, in which its nodes are started; ``None``: that of the process.
        self.folder: Path | None = None
        # Parameters of the control loop.
        self.settings = AdaptationSettings()

    @property
    def bound(self) -> dict[str, Binding]:
        """Where other nodes have the values of parameters, by parameter."""
        return {name: one.binding for name, one in self.parameters.items() if one.binding is not None}

    @property
    def labels(self) -> dict[str, str]:
        """The prefix of the measured attributes of each output and input, by name, outputs first.

        The prefix is the last part of the name; if that is taken, as many last parts as make it unique, joined by
        dots; if all are taken, the whole name after ``in.`` or ``out.``.
        """
        topics = self.outputs | self.inputs
        found = {name: topic.label for name, topic in topics.items() if topic.label}
        for name in (name for name in topics if name not in found):
            parts = name.strip("/").split("/")
            several = [".".join(parts[-count:]) for count in range(1, len(parts) + 1)]
            several.append(f"{'in' if name in self.inputs else 'out'}.{several[-1]}")
            found[name] = next((label for label in several if label not in found.values()), several[-1])
        return {name: found[name] for name in topics}

    @property
    def attributes(self) -> dict[str, Attribute]:
        """All attributes that clients may request: the declared ones, and those measured of each output and input.

        ``rate`` is that of the first output; ``scan.rate`` names the output or input by its label (``labels``).
        """
        found: dict[str, Attribute] = {}
        for position, label in enumerate(self.labels.values()):
            for key, attribute in MEASURED.items():
                if position == 0 and self.outputs:
                    found[key] = attribute
                found[f"{label}.{key}"] = attribute
        return found | {name: declared.attribute for name, declared in self.declared_attributes.items()}

    def expression(self, text: str, where: str) -> Expression:
        """Parse an expression over the resource's topics, parameters, attributes and ``expression.SOURCES``.

        Raises:
            ConfigError: It is invalid, or names a node that is not declared; ``where`` begins the error's text.
        """
        parsed = parse_expression(text, self.parameters, where, attributes=self.attributes)
        for source in [one for one in parsed.sources.values() if one.function in _OF_NODES]:
            if not source.arguments and len(self.nodes) != 1:
                raise ConfigError(where, f"{source.function}() of which node?", f"there are {len(self.nodes)}")
            declare.check_known("node", source.arguments[:1], self.nodes, where)
        return parsed

    def expressions(self) -> Iterator[tuple[tuple[str, str, str], Expression]]:
        """All expressions of the declaration; each with its kind, its name and its key, as in a description."""
        rules = (
            *(("context", one.name, "when", one.when) for one in self.contexts.values()),
            *(("alarm", one.name, "when", one.when) for one in self.alarms.values()),
            *(("profile", one.name, "needs", one.rule) for one in self.profiles.values()),
            *(("attribute", name, "value", one.value) for name, one in self.declared_attributes.items()),
        )
        return (((kind, name, key), rule) for kind, name, key, rule in rules if rule is not None)

    def output(
        self,
        name: str,
        kind: str,
        *,
        latch: bool = False,
        observed: bool = False,
        measure: str = "auto",
        label: str = "",
        **contract: object,
    ) -> Output:
        """Declare a topic that the resource publishes, or that another node publishes for it.

        Args:
            name: A name in the resource's namespace, or a global one (``/cmd_vel``).
            kind: The message type, ``package/Name``: one that comes with rmpa, or of this machine's ROS packages
                (``rmpa.ros.types.find``). A type of another package is learnt at the start from a publisher of that
                type, here or in another module; the resource waits for one.
            latch: Whether a late subscriber gets the last message.
            observed: Whether another node publishes it; the resource measures it, and passes nothing on.
            measure: How an observed one is measured: ``declare.Measure``.
            label: The prefix of its measured attributes; by default made of the name.
            contract: The keys of a ``[[contract]]``: ``deadline="100 ms"``, ``reliability="reliable"`` …

        Raises:
            ConfigError: The name is illegal or taken, or the contract has an unknown key or an invalid value.
            DefinitionError: The type's name is malformed, or its package is known and has no such type.
        """
        where = self._check_topic("output", name, label)
        made = Output(name, kind, declare.read_contract(where, contract), label)
        made.latch, made.observed = latch, observed
        made.measure = declare.read_enum(declare.Measure, measure, where)
        self.outputs[name] = made
        return made

    def input(
        self,
        name: str,
        kind: str,
        *,
        required: bool = True,
        observed: bool = False,
        label: str = "",
        **contract: object,
    ) -> Input:
        """Declare a topic that the resource needs; arguments and errors as for ``output``, except ``required``.

        A type that is unknown on this machine is learnt from the topic's publisher; the resource starts without it.
        ``required``: whether the resource is stale while the topic has no publisher. ``observed``: another node
        receives it; the resource only looks whether it is published.
        """
        where = self._check_topic("input", name, label)
        made = Input(name, kind, declare.read_contract(where, contract), label)
        made.required, made.observed = required, observed
        self.inputs[name] = made
        return made

    def asks(self, resource: str, *, priority: int = 0, **requests: QoSRequest) -> Demand:
        """Declare a requirement on another resource: ``keeper.asks("sonar", accuracy=at_most("5 cm"))``.

        Args:
            resource: Name of the other resource's node in this module's graph.
            priority: In a conflict between clients the higher priority wins.
            requests: By attribute of the other resource; ``ranges.rate`` is written ``ranges__rate``.

        Raises:
            ConfigError: The name is illegal, is the resource's own, or has a requirement already.
        """
        where = f"what {self.name} asks of {resource}"
        name = resource if resource.startswith("/") else f"/{resource}"
        if not is_legal_name(name) or name == "/":
            raise ConfigError(where, f"{resource!r} is not a ROS name", "for example sonar, or /robot1/sonar")
        if name in self.demands:
            raise ConfigError(where, "it asks it already", "say all wishes at once, or change them by .ask()")
        if name == f"/{self.name}":
            raise ConfigError(where, "that is itself", "give its profiles what they need")
        made = self.demands[name] = Demand(name, dict(requests), priority)
        return made

    def parameter(
        self,
        name: str,
        default: ParameterValue,
        *,
        low: float | None = None,
        high: float | None = None,
        choices: Sequence[ParameterValue] = (),
        unit: str = "",
        description: str = "",
        binding: Binding | None = None,
    ) -> Parameter:
        """Declare a parameter, whose type is that of its default; ``Parameter`` explains the arguments.

        Raises:
            ConfigError: The name is illegal or taken, the bounds are the wrong way round, the default is invalid, or
                the binding names no declared node.
        """
        where = self._check_name("parameter", name, self.parameters)
        if binding is not None:
            declare.check_known("node", [binding.node], self.nodes, where)
            if binding.kind == "private" and binding.name in self.nodes[binding.node].params:
                remedy = "leave it out there: default is its first value"
                raise ConfigError(where, f"{binding.name} is among the params of node {binding.node} too", remedy)
        made = Parameter(name, default, low, high, tuple(choices), unit, description, binding=binding)
        made.check_declaration(where)
        self.parameters[name] = made
        return made

    def attribute(
        self,
        name: str,
        *,
        better: str,
        unit: str = "",
        scale: str = "linear",
        category: str = "performance",
        tolerance: float | str | None = None,
        words: Sequence[str] = (),
        value: str = "",
    ) -> DeclaredAttribute:
        """Declare a quality attribute that the user's code observes, in addition to ``quality.MEASURED``.

        Args:
            name: ``accuracy``, ``energy`` …
            better: ``max``, ``min``, ``target`` or ``exact``.
            unit: Unit of the values (``resource.quality``); empty: a ratio.
            scale: ``linear``, ``log``, ``ordinal`` or ``nominal``.
            category: ``temporal``, ``spatial``, ``reliability`` or ``performance``.
            tolerance: A shortfall of this size counts as 1; with a unit, or a ratio on a log scale.
            words: The values of ordinal and nominal scales.
            value: An expression (``resource.expression``) that gives its value at the end of each window, over all
                that was declared before; empty: ``observe`` gives it.

        Raises:
            ConfigError: The name is illegal or taken, or the arguments contradict each other.
        """
        where = f"attribute {name} of {self.name}"
        if name in self.attributes or name in MEASURED:
            raise ConfigError(where, "there is one of this name already", "name it otherwise")
        if not is_legal_name(name) or not name or "/" in name or name in NOT_ATTRIBUTES:
            remedy = f"letters, digits and _, a letter first, and none of {', '.join(sorted(NOT_ATTRIBUTES))}"
            raise ConfigError(where, f"{name!r} cannot be the name of one", remedy)
        plain = tolerance if tolerance is None else quantity(tolerance, unit if scale == "linear" else "", where)
        attribute = Attribute(
            name=name,
            direction=declare.read_enum(Direction, better, where),
            unit=unit,
            scale=declare.read_enum(Scale, scale, where),
            category=declare.read_enum(Category, category, where),
            tolerance=plain,
            words=tuple(words),
        )
        made = DeclaredAttribute(attribute, value=self.expression(value, where) if value else None)
        self.declared_attributes[name] = made
        return made

    def profile(
        self,
        *,
        offers: Mapping[str, float | str],
        cost: float = 0.0,
        best_effort: bool = False,
        needs: Callable[[], str | bool | None] | None = None,
        name: str = "",
        description: str = "",
        sets: Mapping[str, ParameterValue] | None = None,
        nodes: Sequence[str] = (),
        rule: str = "",
    ) -> Callable[[_Function], _Function]:
        """Declare a System Profile; the decorated function applies it.

        Args:
            offers: The offered quality: attribute to value, with a unit (``"40 Hz"``) or in the attribute's own.
            cost: Relative cost; decides among profiles of nearly equal distance.
            best_effort: Whether the profile runs when none meets the requirements.
            needs: The precondition, called once in each window in a thread of its own, so it may block. It returns
                true or ``None`` while the profile may be used, else false or a text with the reason.
            name: By default the function's name.
            description: By default the first line of the function's docstring.
            sets: Values of parameters that it sets before the function is called.
            nodes: Declared nodes that must run in it; one that no profile names always runs.
            rule: A rule over topics, parameters and attributes; while it is false the profile is not used.

        Raises:
            ConfigError: The name is taken, an attribute or unit is unknown, a value is invalid, or there is a
                best-effort profile already.
        """

        def decorate(function: _Function) -> _Function:
            title = name or function.__name__
            where = self._new("profile", title, self.profiles)
            declare.check_arity(function, 0, where)
            if needs is not None:
                declare.check_arity(needs, 0, f"the precondition of {where}")
                if inspect.iscoroutinefunction(needs):
                    raise ConfigError(where, "its precondition is a coroutine function", "make it a plain one")
            if not (math.isfinite(cost) and cost >= 0):
                raise ConfigError(where, f"a cost of {cost:g}", "it is at least 0")
            for one in self.profiles.values():
                if best_effort and one.best_effort:
                    problem = f"{one.name} is the best-effort profile already"
                    raise ConfigError(where, problem, "mark one of them only")
            attributes = self.attributes
            values = {
                key: find_attribute(attributes, key, self.name).parse(value, f"{where}, {key}")
                for key, value in offers.items()
            }
            text = description or (function.__doc__ or "").strip().partition("\n")[0]
            given = {key: self._parameter_value(key, value, where) for key, value in (sets or {}).items()}
            declare.check_known("node", nodes, self.nodes, where)
            parsed = self.expression(rule, where) if rule else None
            apply = cast("Hook", function)
            self.profiles[title] = Profile(
                title, values, cost, best_effort, text, apply, needs, given, tuple(nodes), parsed
            )
            return function

        return decorate

    def context(
        self,
        name: str,
        *,
        when: str = "",
        requires: Mapping[str, QoSRequest] | None = None,
        profiles: Sequence[str] = (),
        outputs: Sequence[Output] | None = None,
        enter: Hook | None = None,
    ) -> Context:
        """Declare a context; the profiles and attributes that it names must be declared before.

        ``declare.Context`` explains the arguments.

        Raises:
            ConfigError: The name is taken, a profile or attribute is unknown, an output is another resource's, or the
                rule is invalid.
        """
        where = self._new("context", name, self.contexts)
        declare.check_known("profile", profiles, self.profiles, where, "declare the profile before the context")
        for key, request in (requires or {}).items():
            request.bound(find_attribute(self.attributes, key, self.name))
        if outputs is not None and (strange := [o.name for o in outputs if o not in self.outputs.values()]):
            raise ConfigError(where, f"{strange[0]} is no output of this resource", "name its own outputs")
        rule = self.expression(when, where) if when else None
        names = tuple(output.name for output in outputs) if outputs is not None else None
        made = self.contexts[name] = Context(name, rule, dict(requires or {}), tuple(profiles), names, enter)
        return made

    def node(self, key: str, name: str = "", **how: Any) -> ManagedNode:
        """Declare a ROS node that exists without the resource; ``ManagedNode`` explains the arguments.

        Args:
            key: Its name in the declaration.
            name: Global name of the node; by default ``/<key>``.
            how: The other fields of ``ManagedNode``.

        Raises:
            ConfigError: A name is illegal or taken, or there are several ways to start it.
        """
        where = self._new("node", key, self.nodes)
        made = declare.ManagedNode(key, name or f"/{key}", **how)
        made.check(where)
        if any(other.name == made.name for other in self.nodes.values()) or made.name == f"/{self.name}":
            raise ConfigError(where, f"{made.name} is declared already, or the resource itself", "name it once")
        for (kind, owner, _), rule in self.expressions() if len(self.nodes) == 1 else ():
            if any(one.function in _OF_NODES and not one.arguments for one in rule.sources.values()):
                problem = f"{kind} {owner} has a rule that names no node: {rule}"
                raise ConfigError(where, problem, "name the node there")
        self.nodes[key] = made
        return made

    def alarm(self, name: str, when: str, *, level: str = "warn", text: str = "") -> AlarmRule:
        """Declare an alarm that stands while a rule is true.

        Args:
            name: Unique within the resource.
            when: The rule (``resource.expression``).
            level: ``warn`` or ``error``.
            text: What people read; by default the rule.

        Raises:
            ConfigError: The name is taken, the level is unknown or the rule is invalid.
        """
        where = self._new("alarm", name, self.alarms)
        if level not in ("warn", "error"):
            raise ConfigError(where, f"there is no level {level!r}", "it is warn or error")
        made = self.alarms[name] = AlarmRule(name, self.expression(when, where), level == "error", text)
        return made

    def task(
        self,
        *,
        rate: float | str | Parameter | None = None,
        on: Input | None = None,
        name: str = "",
        on_failure: str = "restart",
        stuck_after: float | str | None = None,
    ) -> Callable[[_Function], _Function]:
        """Declare a task, which runs periodically at a rate or on each message of an input.

        Args:
            rate: The rate, such as ``"10 Hz"``, or a parameter whose present value is the rate in Hz.
            on: The input on whose messages the task runs.
            name: By default the function's name.
            on_failure: ``restart``, ``stop`` or ``deactivate`` (``declare.OnFailure``).
            stuck_after: A run that takes longer counts as stuck; in seconds or with a unit.

        Raises:
            ConfigError: Neither or both of ``rate`` and ``on`` are given, the rate is out of range, or the input or
                parameter is another resource's.
        """

        def decorate(function: _Function) -> _Function:
            title = name or function.__name__
            where = self._new("task", title, self.tasks)
            if (rate is None) == (on is None):
                raise ConfigError(where, "it needs either a rate or an input", 'rate="10 Hz", or on=an input')
            rate_parameter, hertz = None, None
            if isinstance(rate, Parameter):
                if rate not in self.parameters.values():
                    problem = f"{rate.name} is no parameter of this resource"
                    raise ConfigError(where, problem, "declare it there first")
                rate.check_rate(_RATE_MAX, where)
                rate_parameter, hertz = rate, float(rate.default)
            elif rate is not None:
                hertz = quantity(rate, "Hz", where)
            if hertz is not None and not 0 < hertz <= _RATE_MAX:
                raise ConfigError(where, f"a rate of {hertz:g} Hz", "it is above 0 and at most 10 kHz")
            if on is not None and on not in self.inputs.values():
                raise ConfigError(where, f"{on.name} is no input of this resource", "declare it there first")
            seconds = quantity(stuck_after, "s", where) if stuck_after is not None else None
            declare.check_arity(function, 1 if on is not None else 0, where)
            if seconds is not None and seconds <= 0:
                raise ConfigError(where, f"stuck after {seconds:g} s", "it is above 0")
            policy = declare.read_enum(declare.OnFailure, on_failure, where)
            self.tasks[title] = Task(title, function, hertz, on, policy, seconds, rate_parameter)  # type: ignore[arg-type] # check_arity
            return function

        return decorate

    def adaptation(
        self,
        *,
        window: float | str = 1.0,
        violations: int = 2,
        windows: int = 3,
        improvement: float = 0.05,
        dwell: float | str = 2.0,
        settle: float | str = 1.0,
        cool_down: float | str = 10.0,
        cool_down_max: float | str = 160.0,
        apply_timeout: float | str = 5.0,
        offers: str = "declared",
    ) -> None:
        """Set the parameters of the control loop: ``AdaptationSettings`` explains them; times may have a unit.

        Args:
            window: Length of a quality window.
            violations: Number of violated windows among the last ``windows`` that is a disturbance.
            windows: Number of last windows that are considered.
            improvement: Least improvement of the distance for a change without a disturbance.
            dwell: Least time that a profile runs before such a change.
            settle: Time after a change in which windows are not judged.
            cool_down: Time for which a profile is excluded after it failed or was violated.
            cool_down_max: The longest such time, if that happens repeatedly.
            apply_timeout: Time-out of a profile's function.
            offers: ``declared`` or ``learnt``: by what profiles are compared.

        Raises:
            ConfigError: A time is out of range, or ``violations`` is greater than ``windows``.
        """
        where = f"adaptation of {self.name}"
        texts = {"window": window, "dwell": dwell, "settle": settle, "cool_down": cool_down}
        texts |= {"cool_down_max": cool_down_max, "apply_timeout": apply_timeout}
        times = {name: quantity(value, "s", f"{where}, {name}") for name, value in texts.items()}
        times["cool_down_max"] = max(times["cool_down_max"], times["cool_down"])
        source = declare.read_enum(OfferSource, offers, where)
        made = AdaptationSettings(violations, windows, improvement, **times, offers=source)
        made.check(where)
        self.settings = made

    def on(self, event: str) -> Callable[[_Function], _Function]:
        """Declare the callback of a life-cycle transition.

        Args:
            event: ``configure``, ``activate``, ``deactivate`` or ``finalize``.

        Raises:
            ConfigError: The transition is unknown, or has a callback already.
        """
        known = ("configure", "activate", "deactivate", "finalize")
        if event not in known:
            remedy = suggestion(event, known, f"there are {', '.join(known)}")
            raise ConfigError(f"resource {self.name}", f"no change {event!r}", remedy)
        if event in self.hooks:
            raise ConfigError(f"resource {self.name}", f"{event} has its function already", "call both from one")

        def decorate(function: _Function) -> _Function:
            declare.check_arity(function, 0, f"what {self.name} does at {event}")
            self.hooks[event] = function  # type: ignore[assignment] # check_arity
            return function

        return decorate

    def _new(self, kind: str, name: str, known: Mapping[str, object]) -> str:
        """Refuse a name that is taken, and return a description of the declared item for errors."""
        where = f"{kind} {name} of {self.name}"
        if name in known:
            raise ConfigError(where, "there are two of this name", "name one of them otherwise")
        return where

    def _parameter_value(self, name: str, value: ParameterValue, where: str) -> ParameterValue:
        declare.check_known("parameter", [name], self.parameters, where)
        try:
            return self.parameters[name].check(value)
        except ConfigError as error:
            raise ConfigError(f"{where}, {error.source}", error.problem, error.remedy) from None

    def _check_topic(self, kind: str, name: str, label: str) -> str:
        where = self._check_name(kind, name, self.outputs if kind == "output" else self.inputs)
        if name in (self.inputs if kind == "output" else self.outputs):
            problem = f"it is {'an input' if kind == 'output' else 'an output'} of the same resource"
            raise ConfigError(where, problem, "a global name (/scan) is another topic")
        if label and (not is_legal_name(label) or "/" in label or label in self.labels.values()):
            raise ConfigError(where, f"{label!r} cannot be its label", "letters, digits and _, and none twice")
        return where

    def _check_name(self, kind: str, name: str, known: Mapping[str, object]) -> str:
        """Check a new name, and return a description of the declared item for errors."""
        where = f"{kind} {name} of {self.name}"
        if not name or not is_legal_name(name) or name.startswith("~"):
            raise ConfigError(where, f"{name!r} is not a ROS name", "letters, digits, _ and /, a letter or / first")
        if kind == "parameter" and "/" in name:
            raise ConfigError(where, "a parameter has a base name", "leave the / out")
        if name in known:
            raise ConfigError(where, "there is one of this name already", "name it otherwise")
        if name.removeprefix(f"/{self.name}/") in RESERVED:
            raise ConfigError(where, "that name is the resource's own", f"not one of {', '.join(sorted(RESERVED))}")
        return where
