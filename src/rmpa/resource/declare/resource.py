"""``Resource``: the declaration of a Smart Resource. Nothing runs here; ``rmpa.resource.run`` executes it.

::

    sonar = Resource("sonar", role="sensing")
    ranges = sonar.output("ranges", "sensor_msgs/Range", deadline="100 ms")
    gain = sonar.parameter("gain", 1.0, low=0.0, high=10.0)

    @sonar.profile(offers={"rate": "40 Hz"})
    def precise() -> None: ...

    @sonar.task(rate="40 Hz")
    def measure() -> None:
        ranges.publish(range=0.3)

Each call checks its arguments and raises ``ConfigError`` with the problem and a remedy.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError
from rmpa.core.names import is_legal_name
from rmpa.resource.declare.adaptation_settings import AdaptationSettings, read_adaptation
from rmpa.resource.declare.attributes import MEASURED, Attribute, Category, Direction, Scale
from rmpa.resource.declare.behaviour import Context, DeclaredProfile, Hook, OnFailure, Task
from rmpa.resource.declare.checks import check_arity, read_contract, read_enum
from rmpa.resource.declare.connections import DeclaredAttribute, Demand, Input, Output, TopicType
from rmpa.resource.declare.context_rules import parse_rule
from rmpa.resource.declare.parameters import Parameter, ParameterValue
from rmpa.resource.declare.profiles import Profile, check_profiles
from rmpa.resource.declare.requirements import find_attribute
from rmpa.resource.declare.units import quantity

if TYPE_CHECKING:
    from rmpa.resource.declare.qos_request import QoSRequest

_RATE_MAX: Final = 10_000
"""Hz, of a periodic task."""
_Function = TypeVar("_Function", bound=Callable[..., object])
RESERVED: Final = frozenset(
    {
        "alarms", "context", "decision", "descriptor", "observed", "parameter_descriptions", "parameter_updates",
        "profile", "quality", "requirements", "responses", "set_context", "set_parameters", "state",
    }
)  # fmt: skip
"""Names below a resource's node that are taken by its own topics, services and parameters."""
NOT_ATTRIBUTES: Final = frozenset({"expires", "priority", "profile", "reaction"})
"""Keys beside the attributes in a requirement or a quality report."""


class Role(StrEnum):
    """The function of a module in the robot (paper, section 3)."""

    SENSING = "sensing"
    ACTING = "acting"
    CONTROLLING = "controlling"


class Resource:
    """The declaration of one Smart Resource.

    Args:
        name: A ROS base name; its node is ``/<name>``.
        role: ``sensing``, ``acting`` or ``controlling``.
        physical: Whether there is a device; else it is simulated.
        description: For people.

    Raises:
        ConfigError: An illegal name, or an unknown role.
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
        """Parameters of its control loop."""

    # --- interfaces -------------------------------------------------------------------------------

    def output(self, name: str, kind: str, *, latch: bool = False, **contract: object) -> Output:
        """Declare a topic that it publishes.

        Args:
            name: In its namespace, or global (``/cmd_vel``).
            kind: The message type, ``package/Name``: one that comes with rmpa, or of this machine's ROS packages
                (``rmpa.ros.types.find``). A type of another package is learnt at the start from a publisher of that
                type, here or in another module; the resource waits for one.
            latch: Whether a late subscriber gets the last message.
            contract: The keys of a ``[[contract]]``: ``deadline="100 ms"``, ``reliability="reliable"`` …

        Raises:
            ConfigError: A duplicate or illegal name, or an unknown key of a contract.
            DefinitionError: The type's name is malformed, or its package is known and has no such type.
        """
        where = self._check_topic("output", name, self.outputs, self.inputs)
        made = self.outputs[name] = Output(name, TopicType(kind), read_contract(where, contract), latch)
        return made

    def input(self, name: str, kind: str, *, required: bool = True, **contract: object) -> Input:
        """Declare a topic that it needs; arguments and errors as for ``output``.

        A type that is unknown on this machine is learnt from the topic's publisher; the resource starts without it.
        """
        where = self._check_topic("input", name, self.inputs, self.outputs)
        made = self.inputs[name] = Input(name, TopicType(kind), read_contract(where, contract), required)
        return made

    def asks(self, resource: str, *, priority: int = 0, **requests: QoSRequest) -> Demand:
        """Declare a requirement on another resource: ``keeper.asks("sonar", accuracy=at_most("5 cm"))``.

        Args:
            resource: The other resource's node in this module's graph.
            priority: The higher one wins a conflict between clients.
            requests: By attribute of the other one; a qualified one (``ranges.rate``) is written ``ranges__rate``.

        Raises:
            ConfigError: An illegal or duplicate name, or the resource's own.
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
    ) -> Parameter:
        """Declare a parameter; its type is that of its default.

        Raises:
            ConfigError: A duplicate or illegal name, bounds the wrong way round, or a default out of range.
        """
        where = self._check_name("parameter", name, self.parameters)
        made = Parameter(name, default, low, high, tuple(choices), unit, description)
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
    ) -> DeclaredAttribute:
        """Declare a quality attribute of its own, beside ``resource.declare.attributes.MEASURED``.

        Args:
            name: ``accuracy``, ``energy`` …
            better: ``max``, ``min``, ``target`` or ``exact``.
            unit: See ``resource.declare.units``.
            scale: ``linear``, ``log``, ``ordinal`` or ``nominal``.
            category: ``temporal``, ``spatial``, ``reliability`` or ``performance``.
            tolerance: A shortfall of this size counts as 1; with a unit, or a ratio on a log scale.
            words: The values of ordinal and nominal scales.

        Raises:
            ConfigError: A duplicate or illegal name, or arguments that contradict each other.
        """
        where = f"attribute {name} of {self.name}"
        if name in self.attributes or name in MEASURED:
            raise ConfigError(where, "there is one of this name already", "name it otherwise")
        if not is_legal_name(name) or not name or "/" in name or name in NOT_ATTRIBUTES:
            remedy = f"letters, digits and _, a letter first, and none of {', '.join(sorted(NOT_ATTRIBUTES))}"
            raise ConfigError(where, f"{name!r} cannot be the name of one", remedy)
        plain = tolerance if tolerance is None else quantity(tolerance, unit if scale == "linear" else "", where)
        made = self.declared_attributes[name] = DeclaredAttribute(
            Attribute(
                name,
                read_enum(Direction, better, where),
                unit,
                read_enum(Scale, scale, where),
                read_enum(Category, category, where),
                plain,
                tuple(words),
            )
        )
        return made

    @property
    def labels(self) -> dict[str, str]:
        """The prefix of each output's and input's measured attributes, outputs first.

        The last part of its name; where that is taken, as many parts as are unique; ``in.scan`` if none are.
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
        """All attributes that clients may request: its own, and those measured of each output and input.

        ``rate`` is the first output's; ``scan.rate`` names the output or input (``labels``).
        """
        found: dict[str, Attribute] = {}
        for position, label in enumerate(self.labels.values()):
            for key, attribute in MEASURED.items():
                if position == 0 and self.outputs:
                    found[key] = attribute
                found[f"{label}.{key}"] = attribute
        return found | {name: declared.attribute for name, declared in self.declared_attributes.items()}

    # --- behaviour -------------------------------------------------------------------------------------------

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
        """Declare a System Profile; the decorated function applies it.

        Args:
            offers: The offered quality: attribute to value, with a unit (``"40 Hz"``) or in the attribute's own.
            cost: Relative cost; decides among profiles of nearly equal distance.
            best_effort: Whether it runs when no profile can serve.
            needs: Its precondition: called once a window in a thread of its own, so it may block. It returns true or
                ``None`` while the profile may be used, else false or a text with the reason.
            name: By default the function's.
            description: By default the first line of the function's docstring.

        Raises:
            ConfigError: A duplicate name, an unknown attribute or unit, a second best-effort profile.
        """

        def declare(function: _Function) -> _Function:
            title = name or function.__name__
            where = f"profile {title} of {self.name}"
            check_arity(function, 0, where)
            if needs is not None:
                check_arity(needs, 0, f"the precondition of {where}")
                if inspect.iscoroutinefunction(needs):
                    raise ConfigError(where, "its precondition is a coroutine function", "make it a plain one")
            if title in self.profiles:
                raise ConfigError(where, "there are two of this name", "name one of them otherwise")
            attributes = self.attributes
            values = {
                key: find_attribute(attributes, key, self.name).parse(value, f"{where}, {key}")
                for key, value in offers.items()
            }
            text = description or (function.__doc__ or "").strip().partition("\n")[0]
            made = Profile(title, values, cost, best_effort, text)
            check_profiles([*(p.profile for p in self.profiles.values()), made], attributes, self.name)
            self.profiles[title] = DeclaredProfile(made, function, needs)  # type: ignore[arg-type] # check_arity
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
        """Declare a context, after the profiles and attributes that it names (arguments: ``behaviour.Context``).

        Raises:
            ConfigError: A duplicate name, an unknown profile or attribute, an output of another resource, or a syntax
                error in the rule.
        """
        where = f"context {name} of {self.name}"
        if name in self.contexts:
            raise ConfigError(where, "there are two of this name", "name one of them otherwise")
        for profile in profiles:
            if profile not in self.profiles:
                near = did_you_mean(profile, self.profiles)
                remedy = f"did you mean {near}?" if near else "declare the profile before the context"
                raise ConfigError(where, f"there is no profile {profile}", remedy)
        for key, request in (requires or {}).items():
            request.bound(find_attribute(self.attributes, key, self.name))
        if outputs is not None and (strange := [o.name for o in outputs if o not in self.outputs.values()]):
            raise ConfigError(where, f"{strange[0]} is no output of this resource", "name its own outputs")
        if when:
            parse_rule(when, self.parameters, where)
        names = tuple(output.name for output in outputs) if outputs is not None else None
        made = self.contexts[name] = Context(name, when, dict(requires or {}), tuple(profiles), names, enter)
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
            rate: Such as ``"10 Hz"``; or a parameter, whose present value is the rate in Hz.
            on: The input.
            name: By default the function's.
            on_failure: ``restart``, ``stop`` or ``deactivate``.
            stuck_after: A run that takes longer, in seconds or with a unit, counts as stuck.

        Raises:
            ConfigError: Neither or both of ``rate`` and ``on``, a rate out of range, an input or a parameter of
                another resource.
        """

        def declare(function: _Function) -> _Function:
            title = name or function.__name__
            where = f"task {title} of {self.name}"
            if title in self.tasks:
                raise ConfigError(where, "there are two of this name", "name one of them otherwise")
            if (rate is None) == (on is None):
                raise ConfigError(where, "it needs either a rate or an input", 'rate="10 Hz", or on=an input')
            rate_parameter, hertz = None, None
            if isinstance(rate, Parameter):
                self._check_rate(rate, where)
                rate_parameter, hertz = rate, float(rate.default)
            elif rate is not None:
                hertz = quantity(rate, "Hz", where)
            if hertz is not None and not 0 < hertz <= _RATE_MAX:
                raise ConfigError(where, f"a rate of {hertz:g} Hz", "it is above 0 and at most 10 kHz")
            if on is not None and on not in self.inputs.values():
                raise ConfigError(where, f"{on.name} is no input of this resource", "declare it there first")
            seconds = quantity(stuck_after, "s", where) if stuck_after is not None else None
            check_arity(function, 1 if on is not None else 0, where)
            if seconds is not None and seconds <= 0:
                raise ConfigError(where, f"stuck after {seconds:g} s", "it is above 0")
            policy = read_enum(OnFailure, on_failure, where)
            self.tasks[title] = Task(title, function, hertz, on, policy, seconds, rate_parameter)  # type: ignore[arg-type] # check_arity
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
        """Set the parameters of the control loop: ``AdaptationSettings`` explains them; times may have a unit.

        Args:
            window: Length of a quality window.
            violations: Violated windows …
            windows: … of the last so many that are a disturbance.
            improvement: Least improvement for a change without a disturbance.
            dwell: Least time between such changes.
            settle: Time after a change in which windows are not judged.
            cool_down: Exclusion of a profile that failed or was violated …
            cool_down_max: … at most, if that happens repeatedly.
            apply_timeout: Time-out of a profile's function.

        Raises:
            ConfigError: A time out of range, or more violations than windows.
        """
        times = {
            "window": window,
            "dwell": dwell,
            "settle": settle,
            "cool_down": cool_down,
            "cool_down_max": cool_down_max,
            "apply_timeout": apply_timeout,
        }
        where = f"adaptation of {self.name}"
        self.window, self.settings = read_adaptation(where, violations, windows, improvement, times)

    def on(self, event: str) -> Callable[[_Function], _Function]:
        """Declare the callback of a life-cycle transition.

        Args:
            event: ``configure``, ``activate``, ``deactivate`` or ``finalize``.

        Raises:
            ConfigError: An unknown transition, or one that has its function already.
        """
        known = ("configure", "activate", "deactivate", "finalize")
        if event not in known:
            near = did_you_mean(event, known)
            remedy = f"did you mean {near}?" if near else f"there are {', '.join(known)}"
            raise ConfigError(f"resource {self.name}", f"no change {event!r}", remedy)
        if event in self.hooks:
            raise ConfigError(f"resource {self.name}", f"{event} has its function already", "call both from one")

        def declare(function: _Function) -> _Function:
            check_arity(function, 0, f"what {self.name} does at {event}")
            self.hooks[event] = function  # type: ignore[assignment] # check_arity
            return function

        return declare

    def _check_rate(self, parameter: Parameter, where: str) -> None:
        if parameter not in self.parameters.values():
            raise ConfigError(where, f"{parameter.name} is no parameter of this resource", "declare it there first")
        low, high = parameter.bounds
        if parameter.type not in ("int", "double") or not low > 0 or not high <= _RATE_MAX:
            remedy = f"declare it with low above 0 and high at most {_RATE_MAX:g}"
            raise ConfigError(where, f"{parameter.name} may be what no rate can be", remedy)

    def _check_topic(self, kind: str, name: str, same: Mapping[str, object], other: Mapping[str, object]) -> str:
        where = self._check_name(kind, name, same)
        if name in other:
            opposite = "an input" if kind == "output" else "an output"
            remedy = "a global name (/scan) is another topic"
            raise ConfigError(where, f"it is {opposite} of the same resource", remedy)
        return where

    def _check_name(self, kind: str, name: str, known: Mapping[str, object]) -> str:
        """Check a new name; return its description for errors."""
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
