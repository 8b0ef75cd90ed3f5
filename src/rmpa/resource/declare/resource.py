"""What a user writes: a ``Resource`` and what it consists of. Nothing runs here; ``resource.run`` brings it to life.

::

    sonar = Resource("sonar", role="sensing")
    ranges = sonar.output("ranges", "sensor_msgs/Range", deadline="100 ms")
    gain = sonar.parameter("gain", 1.0, low=0.0, high=10.0)

    @sonar.profile(offers={"rate": "40 Hz"})
    def precise() -> None: ...

    @sonar.task(rate="40 Hz")
    def measure() -> None:
        ranges.publish(range=0.3)

A mistake is found when it is written: each call raises ``ConfigError`` with what is wrong and what to do.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError
from rmpa.core.names import is_legal_name
from rmpa.resource.decide.adaptation import AdaptationSettings
from rmpa.resource.declare.attributes import MEASURED, Attribute, Category, Direction, Scale
from rmpa.resource.declare.behaviour import Context, DeclaredProfile, Hook, OnFailure, Task, TaskFunction
from rmpa.resource.declare.connections import DeclaredAttribute, Demand, Input, Output, TopicType
from rmpa.resource.declare.context_rules import parse_rule
from rmpa.resource.declare.parameters import INT_MAX, INT_MIN, Parameter, ParameterValue
from rmpa.resource.declare.profiles import Profile, check_profiles
from rmpa.resource.declare.qos_request import QoSRequest, at_least, at_most, between, exactly
from rmpa.resource.declare.requirements import find_attribute
from rmpa.resource.declare.units import quantity
from rmpa.resource.declare.words import check_takes, read_contract, read_word

if TYPE_CHECKING:
    from rmpa.resource.declare.attributes import Value

__all__ = [
    "INT_MAX",
    "INT_MIN",
    "NOT_ATTRIBUTES",
    "RESERVED",
    "Context",
    "DeclaredAttribute",
    "DeclaredProfile",
    "Demand",
    "Hook",
    "Input",
    "OnFailure",
    "Output",
    "Parameter",
    "ParameterValue",
    "QoSRequest",
    "Resource",
    "Role",
    "Task",
    "TaskFunction",
    "at_least",
    "at_most",
    "between",
    "exactly",
]
_RATE_MAX: Final = 10_000
"""Hz, of a periodic task."""
_Function = TypeVar("_Function", bound=Callable[..., object])
RESERVED: Final = frozenset(
    {
        "alarms", "context", "decision", "descriptor", "observed", "parameter_descriptions", "parameter_updates",
        "profile", "quality", "requirements", "responses", "set_context", "set_parameters", "state",
    }
)  # fmt: skip
"""Names below a resource's node that are its own topics and services, and parameters with a meaning of their own."""
NOT_ATTRIBUTES: Final = frozenset({"expires", "priority", "profile", "reaction"})
"""What stands beside the attributes in a requirement or among the quality."""


class Role(StrEnum):
    """What a module is to the robot (paper, section 3)."""

    SENSING = "sensing"
    ACTING = "acting"
    CONTROLLING = "controlling"


class Resource:
    """One Smart Resource, as declared.

    Args:
        name: A ROS base name; its node is ``/<name>``.
        role: ``sensing``, ``acting`` or ``controlling``.
        physical: Whether there is a device; else it is simulated.
        description: For people.

    Raises:
        ConfigError: The name or role cannot be.
    """

    def __init__(self, name: str, *, role: str, physical: bool = True, description: str = "") -> None:
        if not name or not is_legal_name(name) or "/" in name or name.startswith("~"):
            raise ConfigError("resource", f"{name!r} is not a ROS base name", "letters, digits and _, a letter first")
        if role not in set(Role):
            near = did_you_mean(role, list(Role))
            remedy = f"did you mean {near}?" if near else f"it is one of {', '.join(Role)}"
            raise ConfigError(f"resource {name}", f"there is no role {role!r}", remedy)
        self.name = name
        self.role = Role(role)
        self.physical = physical
        self.description = description
        self.outputs: dict[str, Output] = {}
        self.inputs: dict[str, Input] = {}
        self.parameters: dict[str, Parameter] = {}
        self.declared_attributes: dict[str, DeclaredAttribute] = {}
        self.profiles: dict[str, DeclaredProfile] = {}
        self.contexts: dict[str, Context] = {}
        self.tasks: dict[str, Task] = {}
        self.demands: dict[str, Demand] = {}
        self.hooks: dict[str, Hook] = {}
        self.window = 1.0
        """Seconds of one quality window."""
        self.settings = AdaptationSettings()
        """How patient its loop is."""

    # --- what it offers and needs -------------------------------------------------------------------------------

    def output(self, name: str, kind: str, *, latch: bool = False, **contract: object) -> Output:
        """Declare a topic that it publishes.

        Args:
            name: In its namespace, or global (``/cmd_vel``).
            kind: The message type, ``package/Name``: one that comes with rmpa, or of this machine's ROS packages
                (``rmpa.ros.types.find``). One of another package is learnt from a publisher of that type, here or in
                another module, when the resource starts; until there is one, it waits.
            latch: Whether a late subscriber gets the last message.
            contract: The words of a ``[[contract]]``: ``deadline="100 ms"``, ``reliability="reliable"`` …

        Raises:
            ConfigError: A name twice, an illegal one, or a word that no contract has.
            DefinitionError: The type is malformed, or its package is known and has no such type.
        """
        self._new("output", name, self.outputs)
        if name in self.inputs:
            where = f"output {name} of {self.name}"
            raise ConfigError(where, "it is an input of the same resource", "a global name (/scan) is another topic")
        made = Output(name, TopicType(kind), read_contract(f"output {name} of {self.name}", contract), latch)
        self.outputs[name] = made
        return made

    def input(self, name: str, kind: str, *, required: bool = True, **contract: object) -> Input:
        """Declare a topic that it needs; arguments and errors as for ``output``.

        A type that is not known here is learnt from the topic's publisher; the resource does not wait for it.
        """
        self._new("input", name, self.inputs)
        if name in self.outputs:
            where = f"input {name} of {self.name}"
            raise ConfigError(where, "it is an output of the same resource", "a global name (/scan) is another topic")
        made = Input(name, TopicType(kind), read_contract(f"input {name} of {self.name}", contract), required)
        self.inputs[name] = made
        return made

    def asks(self, resource: str, *, priority: int = 0, **wishes: QoSRequest) -> Demand:
        """Declare what it asks of another resource: ``keeper.asks("sonar", accuracy=at_most("5 cm"))``.

        Args:
            resource: The other one's node, as this module's graph has it.
            priority: The higher one wins a conflict between clients.
            wishes: By the other one's attributes; a qualified one (``ranges.rate``) is written ``ranges__rate``.

        Raises:
            ConfigError: An illegal name, the same one twice, or its own.
        """
        where = f"what {self.name} asks of {resource}"
        name = resource if resource.startswith("/") else f"/{resource}"
        if not is_legal_name(name) or name == "/":
            raise ConfigError(where, f"{resource!r} is not a ROS name", "for example sonar, or /robot1/sonar")
        if name in self.demands:
            raise ConfigError(where, "it asks it already", "say all wishes at once, or change them by .ask()")
        if name == f"/{self.name}":
            raise ConfigError(where, "that is itself", "give its profiles what they need")
        made = Demand(name, dict(wishes), priority)
        self.demands[name] = made
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
    ) -> Parameter:
        """Declare a parameter; its type is that of its default.

        Raises:
            ConfigError: A name twice or an illegal one, bounds the wrong way round, a default that it cannot have.
        """
        self._new("parameter", name, self.parameters)
        where = f"parameter {name} of {self.name}"
        if type(default) not in (bool, int, float, str):
            raise ConfigError(where, f"{default!r} is no bool, int, float or str", "give a default of one of these")
        if (low is not None or high is not None) and isinstance(default, bool | str):
            raise ConfigError(where, f"bounds of {default!r}, which is no number", "leave low and high out")
        if low is not None and high is not None and low > high:
            raise ConfigError(where, f"low is {low:g} and high {high:g}", "the bounds are the wrong way round")
        made = Parameter(name, default, low, high, tuple(choices), unit, description)
        for value in (*choices, default):
            made.check(value)
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
    ) -> DeclaredAttribute:
        """Declare a quality of its own.

        Those in ``resource.declare.attributes.MEASURED`` are measured anyway.

        Args:
            name: ``accuracy``, ``energy`` …
            better: ``max``, ``min``, ``target`` or ``exact``.
            unit: See ``resource.declare.units``.
            scale: ``linear``, ``log``, ``ordinal`` or ``nominal``.
            category: ``temporal``, ``spatial``, ``reliability`` or ``performance``.
            tolerance: A shortfall of this size counts 1; with a unit, or a ratio on a log scale.
            words: Of ordinal and nominal scales.

        Raises:
            ConfigError: It cannot be.
        """
        where = f"attribute {name} of {self.name}"
        if name in self.attributes or name in MEASURED:
            raise ConfigError(where, "there is one of this name already", "name it otherwise")
        if not is_legal_name(name) or not name or "/" in name or name in NOT_ATTRIBUTES:
            remedy = f"letters, digits and _, a letter first, and none of {', '.join(sorted(NOT_ATTRIBUTES))}"
            raise ConfigError(where, f"{name!r} cannot be the name of one", remedy)
        plain = tolerance if tolerance is None else quantity(tolerance, unit if scale == "linear" else "", where)
        made = DeclaredAttribute(
            Attribute(
                name,
                read_word(Direction, better, where),
                unit,
                read_word(Scale, scale, where),
                read_word(Category, category, where),
                plain,
                tuple(words),
            )
        )
        self.declared_attributes[name] = made
        return made

    @property
    def labels(self) -> dict[str, str]:
        """What the qualities of each output and input are named by, outputs first.

        The last part of its name; where that is taken, as many parts as it needs; ``in.scan`` where all are.
        """
        found: dict[str, str] = {}
        for name in (*self.outputs, *self.inputs):
            parts = name.strip("/").split("/")
            several = [".".join(parts[-count:]) for count in range(1, len(parts) + 1)]
            several.append(f"{'in' if name in self.inputs else 'out'}.{several[-1]}")
            found[name] = next((label for label in several if label not in found.values()), several[-1])
        return found

    @property
    def attributes(self) -> dict[str, Attribute]:
        """Everything that can be asked for: its own attributes, and what is measured of each output and input.

        ``rate`` means the first output; ``scan.rate`` names the output or input (``labels``).
        """
        found: dict[str, Attribute] = {}
        for position, label in enumerate(self.labels.values()):
            for key, attribute in MEASURED.items():
                if position == 0 and self.outputs:
                    found[key] = attribute
                found[f"{label}.{key}"] = attribute
        return found | {name: declared.attribute for name, declared in self.declared_attributes.items()}

    # --- what it does -------------------------------------------------------------------------------------------

    def profile(
        self,
        *,
        offers: Mapping[str, float | str],
        cost: float = 0.0,
        best_effort: bool = False,
        needs: Callable[[], str | bool | None] | None = None,
        name: str = "",
        description: str = "",
    ) -> Callable[[_Function], _Function]:
        """Declare a System Profile; the function that is decorated applies it.

        Args:
            offers: The quality under it: attribute to value, with a unit (``"40 Hz"``) or in the attribute's own.
            cost: What it takes, beside the others.
            best_effort: Whether it runs when none can serve.
            needs: Its precondition: asked once a window, in a thread of its own, so that it may block. It returns
                true or ``None`` while the profile can be taken, else false or a text why it cannot.
            name: By default the function's.
            description: By default the first line of the function's docstring.

        Raises:
            ConfigError: A name twice, an unknown attribute or unit, a second best-effort profile.
        """

        def declare(function: _Function) -> _Function:
            title = name or function.__name__
            where = f"profile {title} of {self.name}"
            check_takes(function, 0, where)
            if needs is not None:
                check_takes(needs, 0, f"the precondition of {where}")
                if inspect.iscoroutinefunction(needs):
                    raise ConfigError(where, "its precondition is a coroutine function", "make it a plain one")
            if title in self.profiles:
                raise ConfigError(where, "there are two of this name", "name one of them otherwise")
            attributes = self.attributes
            values: dict[str, Value] = {}
            for key, value in offers.items():
                attribute = find_attribute(attributes, key, self.name)
                said = value if attribute.of_words else quantity(value, attribute.unit, f"{where}, {key}")
                values[key] = attribute.check(said, f"{where}, {key}")
            text = description or (function.__doc__ or "").strip().partition("\n")[0]
            made = Profile(title, values, cost, best_effort, text)
            check_profiles([*(p.profile for p in self.profiles.values()), made], attributes, self.name)
            self.profiles[title] = DeclaredProfile(made, function, needs)  # type: ignore[arg-type] # as told
            return function

        return declare

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
        """Declare a context; behind the profiles and attributes that it names.

        Raises:
            ConfigError: A name twice, an unknown profile or attribute, an output of another resource, or a rule that
                cannot be read.
        """
        where = f"context {name} of {self.name}"
        if name in self.contexts:
            raise ConfigError(where, "there are two of this name", "name one of them otherwise")
        for profile in profiles:
            if profile not in self.profiles:
                near = did_you_mean(profile, self.profiles)
                remedy = f"did you mean {near}?" if near else "declare the profile before the context"
                raise ConfigError(where, f"there is no profile {profile}", remedy)
        for key, wish in (requires or {}).items():
            wish.bound(find_attribute(self.attributes, key, self.name))
        if outputs is not None and (strange := [o.name for o in outputs if o not in self.outputs.values()]):
            raise ConfigError(where, f"{strange[0]} is no output of this resource", "name its own outputs")
        if when:
            parse_rule(when, self.parameters, where)
        names = tuple(output.name for output in outputs) if outputs is not None else None
        made = Context(name, when, dict(requires or {}), tuple(profiles), names, enter)
        self.contexts[name] = made
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
        """Declare what it does: periodically at a rate, or with each message of an input.

        Args:
            rate: Such as ``"10 Hz"``; or a parameter, whose value is the rate (Hz) also when it changes.
            on: The input.
            name: By default the function's.
            on_failure: ``restart``, ``stop`` or ``deactivate``.
            stuck_after: How long one run may take.

        Raises:
            ConfigError: Neither or both of ``rate`` and ``on``, a rate that cannot be, an input or a parameter of
                another resource.
        """

        def declare(function: _Function) -> _Function:
            title = name or function.__name__
            where = f"task {title} of {self.name}"
            if title in self.tasks:
                raise ConfigError(where, "there are two of this name", "name one of them otherwise")
            if (rate is None) == (on is None):
                raise ConfigError(where, "it needs either a rate or an input", 'rate="10 Hz", or on=an input')
            follows, hertz = None, None
            if isinstance(rate, Parameter):
                self._check_rate(rate, where)
                follows, hertz = rate, float(rate.default)
            elif rate is not None:
                hertz = quantity(rate, "Hz", where)
            if hertz is not None and not 0 < hertz <= _RATE_MAX:
                raise ConfigError(where, f"a rate of {hertz:g} Hz", "it is above 0 and at most 10 kHz")
            if on is not None and on not in self.inputs.values():
                raise ConfigError(where, f"{on.name} is no input of this resource", "declare it there first")
            seconds = quantity(stuck_after, "s", where) if stuck_after is not None else None
            check_takes(function, 1 if on is not None else 0, where)
            if seconds is not None and seconds <= 0:
                raise ConfigError(where, f"stuck after {seconds:g} s", "it is above 0")
            policy = read_word(OnFailure, on_failure, where)
            self.tasks[title] = Task(title, function, hertz, on, policy, seconds, follows)  # type: ignore[arg-type] # as told
            return function

        return declare

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
    ) -> None:
        """Say how quickly it adapts; without this, as the defaults say.

        Args:
            window: Seconds of one quality window.
            violations: So many violated windows …
            windows: … of the last so many are a disturbance.
            improvement: A change without a disturbance must lessen the distance by more than this.
            dwell: Seconds that a profile runs at least before such a change.
            settle: Seconds behind a change for which windows are not judged: what the profile before sent is still
                on its way.
            cool_down: Seconds that a profile is left out after it failed or disappointed; twice as long each time …
            cool_down_max: … up to this.
            apply_timeout: Seconds after which a profile that is being applied counts as hung.

        Raises:
            ConfigError: A time that cannot be, or more violations than windows.
        """
        where = f"adaptation of {self.name}"
        if not 1 <= violations <= windows <= 100:
            raise ConfigError(where, f"{violations} of {windows} windows", "1 <= violations <= windows <= 100")
        seconds = {
            name: quantity(value, "s", f"{where}, {name}")
            for name, value in (
                ("window", window),
                ("dwell", dwell),
                ("settle", settle),
                ("cool_down", cool_down),
                ("cool_down_max", cool_down_max),
                ("apply_timeout", apply_timeout),
            )
        }
        for name, least in (
            ("window", 0.05),
            ("dwell", 0.0),
            ("settle", 0.0),
            ("cool_down", 0.0),
            ("apply_timeout", 0.01),
        ):
            if not least <= seconds[name] <= 86400:
                raise ConfigError(where, f"{name} is {seconds[name]:g} s", f"at least {least:g} s, at most a day")
        self.window = seconds.pop("window")
        seconds["cool_down_max"] = max(seconds["cool_down_max"], seconds["cool_down"])
        self.settings = AdaptationSettings(violations=violations, windows=windows, improvement=improvement, **seconds)

    def on(self, event: str) -> Callable[[_Function], _Function]:
        """Declare what is done at a change of the life cycle.

        Args:
            event: ``configure``, ``activate``, ``deactivate`` or ``finalize``.

        Raises:
            ConfigError: There is no such change, or it has its function already.
        """
        known = ("configure", "activate", "deactivate", "finalize")
        if event not in known:
            near = did_you_mean(event, known)
            remedy = f"did you mean {near}?" if near else f"there are {', '.join(known)}"
            raise ConfigError(f"resource {self.name}", f"no change {event!r}", remedy)
        if event in self.hooks:
            raise ConfigError(f"resource {self.name}", f"{event} has its function already", "call both from one")

        def declare(function: _Function) -> _Function:
            check_takes(function, 0, f"what {self.name} does at {event}")
            self.hooks[event] = function  # type: ignore[assignment] # as told
            return function

        return declare

    def _check_rate(self, parameter: Parameter, where: str) -> None:
        if parameter not in self.parameters.values():
            raise ConfigError(where, f"{parameter.name} is no parameter of this resource", "declare it there first")
        low, high = parameter.bounds
        if parameter.type not in ("int", "double") or not low > 0 or not high <= _RATE_MAX:
            remedy = f"declare it with low above 0 and high at most {_RATE_MAX:g}"
            raise ConfigError(where, f"{parameter.name} may be what no rate can be", remedy)

    def _new(self, what: str, name: str, known: Mapping[str, object]) -> None:
        where = f"{what} {name} of {self.name}"
        if not name or not is_legal_name(name) or name.startswith("~"):
            raise ConfigError(where, f"{name!r} is not a ROS name", "letters, digits, _ and /, a letter or / first")
        if what == "parameter" and "/" in name:
            raise ConfigError(where, "a parameter has a base name", "leave the / out")
        if name in known:
            raise ConfigError(where, "there is one of this name already", "name it otherwise")
        if name.removeprefix(f"/{self.name}/") in RESERVED:
            raise ConfigError(where, "that name is the resource's own", f"not one of {', '.join(sorted(RESERVED))}")
