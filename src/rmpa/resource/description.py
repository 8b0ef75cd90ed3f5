"""Resources described in TOML: ``camera.resource.toml`` says of nodes that exist what a Python file declares.

::

    role = "sensing"

    [node.driver]
    name = "/usb_cam"
    run = "usb_cam usb_cam_node"

    [output.image]
    topic = "/usb_cam/image_raw"
    type = "sensor_msgs/Image"

    [parameter.fps]
    dynamic = "frame_rate"
    default = 30

    [profile.full]
    set = { fps = 30 }
    offers = { rate = "30 Hz" }

The file is read into the declaration of ``rmpa.resource.resource``; nothing of it is code. Each mistake is a
``ConfigError`` with line and key.
"""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.rules import CONTRACT_RULES, TERMS
from rmpa.config.schema import NEEDED, Setting
from rmpa.config.toml_file import dotted, line_of, read_toml
from rmpa.config.values import BOOL, TEXT, BadValue, JsonSchema, Place, ValueType, list_of, member_of, text_type
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.core.identity import is_legal_name
from rmpa.resource import limits
from rmpa.resource.decision import OfferSource
from rmpa.resource.declare import Binding, BindingKind, Measure, RestartPolicy, Role
from rmpa.resource.quality import Category, Direction, QoSRequest, Scale, parse_request, quantity
from rmpa.resource.resource import Resource
from rmpa.runtime.programs import StartRule

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path


# The end of the name of a file that describes a resource.
SUFFIX: Final = ".resource.toml"
_SCALAR: Final = {"type": ["string", "number", "integer", "boolean"]}


def _any(kind: str | list[str], **more: Any) -> ValueType[Any]:
    """A type whose values ``Resource`` checks."""
    return ValueType(lambda raw: raw, {"type": kind, **more})


def _table_of(values: JsonSchema) -> ValueType[Any]:
    return _any("object", additionalProperties=values)


_VALUE: Final = _any(_SCALAR["type"])
_NUMBER: Final = _any(["number", "integer"])
_QUANTITY: Final = _any(["string", "number", "integer"])
_TEXTS: Final = list_of(TEXT)
# Arguments may be repeated; the schema has checked that they are texts.
_WORDS: Final[ValueType[tuple[str, ...]]] = ValueType(tuple, {"type": "array", "items": TEXT.json_schema})
_NAME: Final = text_type(lambda raw: raw, "/camera/image_raw")
_CONTRACT: Final = CONTRACT_RULES.json_schema["items"]["properties"]

# The keys of the file itself; the tables follow.
_RESOURCE: Final = {
    "name": Setting(TEXT, "The resource's name, a ROS base name; by default that of the file."),
    "role": Setting(member_of(Role, "a role"), "sensing, acting or controlling.", NEEDED),
    "physical": Setting(BOOL, "Whether it has a real device; else it is simulated.", default=True),
    "description": Setting(TEXT, "A text for people."),
}
_NODE: Final = {
    "name": Setting(_NAME, "The node's name in the graph; by default /NAME of the table."),
    "run": Setting(TEXT, "Started as by rosrun: PACKAGE EXECUTABLE."),
    "launch": Setting(TEXT, "Started by roslaunch: PACKAGE FILE, or a path beside this file."),
    "command": Setting(_WORDS, "Started as this program with its arguments."),
    "args": Setting(_WORDS, "Further arguments, or NAME:=VALUE of the launch file."),
    "params": Setting(_table_of(_SCALAR), "Private parameters that are set before it starts."),
    "remap": Setting(_table_of({"type": "string"}), "Names of topics and services, by the node's own name for them."),
    "env": Setting(_table_of({"type": "string"}), "Variables of its environment."),
    "restart": Setting(member_of(RestartPolicy, "a policy"), "When it is started again after its end.", "on-failure"),
    "stop_after": Setting(_QUANTITY, "How long it may take to end before it is killed.", "10 s"),
    "server": Setting(_NAME, "Its dynamic_reconfigure server, where that has another name, as of a nodelet."),
}
_TOPIC: Final = {
    "topic": Setting(_NAME, "The topic's name in the graph.", NEEDED),
    "type": Setting(TEXT, "The message type, package/Name.", NEEDED),
}
_TERMS: Final = {
    term: Setting(ValueType(lambda raw: raw, _CONTRACT[term]), _CONTRACT[term]["description"]) for term in TERMS
}
_OUTPUT: Final = {
    **_TOPIC,
    "measure": Setting(
        member_of(Measure, "a way to measure"),
        "subscribe: each message, with its latency; counters: rate and bandwidth by the node's own counters; auto: "
        "counters for much data, else subscribe.",
        "auto",
    ),
    **_TERMS,
}
_INPUT: Final = {
    **_TOPIC,
    "required": Setting(BOOL, "Whether the resource is stale while it has no publisher.", default=True),
    "measure": Setting(BOOL, "Whether the resource subscribes, to measure what arrives.", default=False),
    **_TERMS,
}
_PARAMETER: Final = {
    "default": Setting(_VALUE, "The initial value; its type is the parameter's.", NEEDED),
    "dynamic": Setting(TEXT, "Its name in dynamic_reconfigure of the node."),
    "private": Setting(TEXT, "Its name below the node on the parameter server; the node is restarted."),
    "arg": Setting(TEXT, "Its name as an argument of the launch file, which is restarted."),
    "node": Setting(TEXT, "The table of the node that has it; needed where there are several."),
    "restart": Setting(BOOL, "false: the node reads a private parameter while it runs.", default=True),
    "low": Setting(_NUMBER, "The least value."),
    "high": Setting(_NUMBER, "The greatest value."),
    "choices": Setting(_any("array", items=_SCALAR), "The only values."),
    "unit": Setting(TEXT, "The unit, for people."),
    "description": Setting(TEXT, "A text for people."),
}
_ATTRIBUTE: Final = {
    "value": Setting(TEXT, "The expression that gives its value."),
    "better": Setting(
        member_of(Direction, "a direction"), "Which values are better: max, min, target, exact.", NEEDED
    ),
    "unit": Setting(TEXT, "Unit of its values; without one it is a ratio."),
    "scale": Setting(member_of(Scale, "a scale"), "How distances are measured.", "linear"),
    "category": Setting(member_of(Category, "a category"), "Its class in reports.", "performance"),
    "tolerance": Setting(_QUANTITY, "A shortfall of this size counts as 1."),
    "words": Setting(_TEXTS, "The values of ordinal and nominal scales."),
}
_PROFILE: Final = {
    "set": Setting(_table_of(_SCALAR), "The values of parameters in it."),
    "offers": Setting(_table_of({"type": _QUANTITY.json_schema["type"]}), "The quality that it promises.", NEEDED),
    "cost": Setting(_NUMBER, "Decides among profiles that serve equally well.", 0),
    "best_effort": Setting(BOOL, "Whether it runs when none can serve.", default=False),
    "nodes": Setting(_TEXTS, "Nodes that must run in it; one that no profile names always runs."),
    "needs": Setting(TEXT, "A rule; while it is false the profile is not used."),
    "description": Setting(TEXT, "A text for people."),
}
_CONTEXT: Final = {
    "when": Setting(TEXT, "The rule that selects it; without one it is chosen by hand."),
    "requires": Setting(_table_of({"type": "string"}), "Requirements on the resource itself, by attribute."),
    "profiles": Setting(_TEXTS, "The only profiles that may run in it."),
}
_ALARM: Final = {
    "when": Setting(TEXT, "The rule; the alarm stands while it is true.", NEEDED),
    "level": Setting(TEXT, "warn or error.", "warn"),
    "text": Setting(TEXT, "What people read."),
}
_ASK: Final = {"priority": Setting(_any("integer"), "In a conflict between clients the higher one wins.", 0)}
_TIMES: Final = {
    name: Setting(_QUANTITY, about)
    for name, about in {
        "window": "Length of a quality window.",
        "dwell": "Least time that a profile runs before a change without a disturbance.",
        "settle": "Time after a change in which windows are not judged.",
        "cool_down": "Time for which a profile is excluded after it failed or was violated.",
        "cool_down_max": "The longest such time.",
        "apply_timeout": "Longest time that a change of profile may take.",
    }.items()
}
_ADAPTATION: Final = {
    **_TIMES,
    "violations": Setting(_any("integer"), "Violated windows that are a disturbance.", 2),
    "windows": Setting(_any("integer"), "The last windows that are considered.", 3),
    "improvement": Setting(_NUMBER, "Least improvement for a change without a disturbance.", 0.05),
    "offers": Setting(
        member_of(OfferSource, "a source"), "By what profiles are compared: declared, or learnt.", "declared"
    ),
}
_START: Final = {
    "boot": Setting(BOOL, "Whether the module's agent starts it.", default=False),
    "delay": Setting(_QUANTITY, "How long after the conditions hold.", "0 s"),
    "topics": Setting(_TEXTS, "Topics that must be published before."),
    "after": Setting(_TEXTS, "Resources of the module that must be active before."),
}
# Tables that the user names: [profile.full].
_NAMED: Final[Mapping[str, tuple[str, dict[str, Setting]]]] = {
    "node": ("A ROS node that exists: it is attached to, and started if it says how.", _NODE),
    "output": ("A topic that a node publishes.", _OUTPUT),
    "input": ("A topic that a node needs.", _INPUT),
    "parameter": ("A value that profiles set and people change.", _PARAMETER),
    "attribute": ("A quality of its own, beside those measured of each topic.", _ATTRIBUTE),
    "profile": ("One way in which it can run.", _PROFILE),
    "context": ("A state of the world, with what it requires.", _CONTEXT),
    "alarm": ("A rule that raises an alarm.", _ALARM),
    "ask": ("A requirement on another resource: attribute = request.", _ASK),
}
_SINGLE: Final = {
    "adaptation": ("The control loop.", _ADAPTATION),
    "start": ("When the agent starts it.", _START),
}


def resource_schema() -> JsonSchema:
    """The JSON Schema (draft 7) of a file that describes a resource."""

    def table(keys: Mapping[str, Setting], *, more: JsonSchema | bool = False) -> JsonSchema:
        made: JsonSchema = {"type": "object", "additionalProperties": more, "properties": {}}
        for name, key in keys.items():
            made["properties"][name] = key.type.json_schema | {"description": key.help}
            if key.default not in (None, NEEDED):
                made["properties"][name]["default"] = key.default
        needed = [name for name, key in keys.items() if key.default is NEEDED]
        return made | ({"required": needed} if needed else {})

    root: JsonSchema = {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": f"NAME{SUFFIX}",
        "description": "A Smart Resource of nodes that exist (docs/guides/smart-resources.md).",
        **table(_RESOURCE),
    }
    for name, (about, keys) in _NAMED.items():
        inner = table(keys, more={"type": "string"} if name == "ask" else False)
        root["properties"][name] = {"type": "object", "description": about, "additionalProperties": inner}
    for name, (about, keys) in _SINGLE.items():
        root["properties"][name] = table(keys) | {"description": about}
    return root


_SCHEMA: Final = resource_schema()


def read_description(data: bytes, path: Path) -> Resource:
    """Read the description of a resource.

    Args:
        data: UTF-8 text in TOML.
        path: The file, which names the resource if its text does not.

    Raises:
        ConfigError: With line and key, for the first mistake.
    """
    if len(data) > limits.DESCRIPTION_MAX:
        problem = f"{len(data)} bytes, more than {limits.DESCRIPTION_MAX}"
        raise ConfigError("the file", problem, "is it the right file?", path, 1, code="unreadable-settings")
    text, table = read_toml(data, path, _SCHEMA)
    return _Reader(text, table, path).read()


def description_mistakes(data: bytes, path: Path) -> list[ConfigError]:
    """What is wrong in a description: all unknown keys and wrong types, else the first of other mistakes."""
    found: list[ConfigError] = []
    try:
        read_toml(data, path, _SCHEMA, found)
        if not found:
            read_description(data, path)
    except ConfigError as error:
        found.append(error)
    return found


def schema_text() -> str:
    """The JSON Schema as it is printed and stands in docs/."""
    return json.dumps(_SCHEMA, indent=2, ensure_ascii=False) + "\n"


class _Reader:
    """Reads one file; keeps the place that is being read, for errors."""

    def __init__(self, text: str, table: dict[str, Any], path: Path) -> None:
        self._text = text
        self._table = table
        self._path = path
        self._place: Place = ()

    def read(self) -> Resource:
        try:
            return self._resource()
        except BadValue as error:
            remedy = error.remedy or (f"did you mean {error.better}?" if error.better else "")
            place = (*self._place, *error.at)
            raise self._error(place, dotted(place) or "the file", error.problem, remedy) from None
        except ConfigError as error:
            raise self._error(self._blamed(error), error.source, error.problem, error.remedy) from None
        except RmpaError as error:  # a type that there is not
            raise self._error(self._blamed(error), dotted(self._place), str(error), "") from None

    def _error(self, place: Place, where: str, problem: str, remedy: str) -> ConfigError:
        line = next((n for size in range(len(place), 0, -1) if (n := line_of(self._text, place[:size]))), 1)
        return ConfigError(where, problem, remedy, self._path, line)

    def _blamed(self, error: RmpaError) -> Place:
        """The key that an error of ``Resource`` is about: one that its text names, or whose value it shows."""
        table: Any = self._table
        for part in self._place:
            table = table[part]
        source = getattr(error, "source", "")
        last = re.split(r",| of ", source)[-1]
        words = re.findall(r"[\w.]+", f"{last} {str(error).replace(source, '', 1)}")
        found: Place = self._place
        best = 0
        for place, value in _places(self._place, table):
            shown = not isinstance(value, dict | list | bool) and len(str(value)) > 1 and str(value) in str(error)
            shown |= isinstance(value, str) and repr(value) in str(error)
            score = 2 * shown + (str(place[-1]) in words) + 2 * (str(place[-1]) in last)
            if score > best:
                found, best = place, score
        return found

    def _keys(self, place: Place, keys: Mapping[str, Setting]) -> dict[str, Any]:
        """The values of a table by key, each read by its type."""
        self._place = place
        table: Any = self._table
        for part in place:
            table = table[part]
        found = {}
        for name, key in keys.items():
            if name in table:
                self._place = (*place, name)
                found[name] = key.type.read(table[name])
                self._place = place
            elif key.default is NEEDED:
                raise BadValue(f"it has no {name}", key.help)
        return found

    def _named(self, kind: str) -> Iterator[tuple[str, dict[str, Any]]]:
        for name in self._table.get(kind, {}):
            yield name, self._keys((kind, name), _NAMED[kind][1])

    def _resource(self) -> Resource:
        about = self._keys((), _RESOURCE)
        name = about.pop("name", self._path.name.removesuffix(SUFFIX).removesuffix(".toml"))
        if not is_legal_name(name) or "/" in name:
            raise ConfigError("name", f"{name!r} is not a ROS base name", 'give one: name = "camera"')
        made = Resource(name, **about)
        made.file = self._path.name
        for key, node in self._named("node"):
            node["stop_after"] = quantity(node.get("stop_after", 10.0), "s", "stop_after")
            made.node(key, **node)
        for key, values in self._named("parameter"):
            made.parameter(key, values.pop("default"), binding=self._binding(made, values), **values)
        for label, values in self._named("output"):
            made.output(values.pop("topic"), values.pop("type"), observed=True, label=label, **values)
        for label, values in self._named("input"):
            observed = not values.pop("measure", False)
            made.input(values.pop("topic"), values.pop("type"), observed=observed, label=label, **values)
        for key, values in self._named("attribute"):
            made.attribute(key, **values)
        for key, values in self._named("profile"):
            sets, rule = values.pop("set", {}), values.pop("needs", "")
            made.profile(name=key, sets=sets, rule=rule, **values)(lambda: None)
        if not made.profiles:
            self._place = ("profile",)
            raise BadValue("it has no System Profile", 'write one: [profile.full] with offers = { rate = "30 Hz" }')
        self._rest(made)
        return made

    def _rest(self, made: Resource) -> None:
        """What may refer to profiles and attributes."""
        for key, values in self._named("alarm"):
            made.alarm(key, values.pop("when"), **values)
        for key, values in self._named("context"):
            values["requires"] = self._requests(("context", key, "requires"), values.get("requires", {}))
            self._place = ("context", key)
            made.context(key, **values)
        for key in self._table.get("ask", {}):
            self._asks(made, key)
        if "adaptation" in self._table:
            made.adaptation(**self._keys(("adaptation",), _ADAPTATION))
        if "start" in self._table:
            self._start(made)

    def _binding(self, made: Resource, values: dict[str, Any]) -> Binding | None:
        """The binding of a parameter, whose keys are taken out of its values."""
        node, restart = values.pop("node", ""), values.pop("restart", True)
        given = {kind: values.pop(kind) for kind in BindingKind if kind in values}
        if not given:
            if node:
                raise BadValue("it names a node, and not what it is there", 'add dynamic = "NAME", private or arg')
            return None
        if len(given) > 1:
            raise BadValue(f"{' and '.join(given)} are two places for one value", "keep one", at=(list(given)[-1],))
        kind, name = next(iter(given.items()))
        if not node and len(made.nodes) != 1:
            there = ", ".join(made.nodes) or "none"
            raise BadValue(f"it does not say of which node (there are: {there})", 'add node = "NAME"')
        key = node or next(iter(made.nodes))
        declared = made.nodes.get(key)
        restart = kind is BindingKind.ARGUMENT or (kind is BindingKind.PRIVATE and restart)
        if declared is not None and kind is BindingKind.ARGUMENT and not declared.launch:
            raise BadValue(
                f"node {key} is not started by a launch file", 'give it launch = "PACKAGE FILE"', at=("arg",)
            )
        if declared is not None and restart and not declared.started:
            remedy = "say how (run, launch, command), or restart = false if the node reads it while it runs"
            raise BadValue(f"node {key} must be restarted to take it, and is not started here", remedy, at=(kind,))
        return Binding(kind, key, name, restart)

    def _requests(self, place: Place, texts: Mapping[str, str]) -> dict[str, QoSRequest]:
        found = {}
        for name, text in texts.items():
            self._place = (*place, name)
            found[name] = parse_request(text, name)
        return found

    def _asks(self, made: Resource, key: str) -> None:
        place = ("ask", key)
        priority = self._keys(place, _ASK).get("priority", 0)
        texts = {name: text for name, text in self._table["ask"][key].items() if name not in _ASK}
        requests = self._requests(place, texts)
        self._place = place
        made.asks(key, priority=priority, **{name.replace(".", "__"): one for name, one in requests.items()})

    def _start(self, made: Resource) -> None:
        values = self._keys(("start",), _START)
        delay = quantity(values.get("delay", 0.0), "s", "delay")
        if delay < 0:
            raise BadValue(f"{delay:g} s", "a delay is at least 0", at=("delay",))
        if made.name in values.get("after", ()):
            raise BadValue("it would wait for itself", "name other resources", at=("after",))
        for topic in values.get("topics", ()):
            if not topic.startswith("/") or not is_legal_name(topic):
                raise BadValue(f"{topic!r} is not a global name", "for example /scan", at=("topics",))
        made.start = StartRule(
            values.get("boot", False), delay, tuple(values.get("topics", ())), tuple(values.get("after", ()))
        )


def _places(place: Place, value: object) -> Iterator[tuple[Place, object]]:
    """All places in a table, with their values."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield (*place, key), inner
            yield from _places((*place, key), inner)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield (*place, index), inner
