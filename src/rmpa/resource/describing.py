"""What a running node shows, and the description of a resource that is written of it (``rmpa resource describe``).

A node shows the rates of its topics, dynamic_reconfigure, parameters, diagnostics and its process; ``checking``
compares a description with it. In what is written all that nearly every resource needs is active; all else that was
found stands in comments, ready to be used.
"""

from __future__ import annotations

import ast
import asyncio
import contextlib
import math
import re
import struct
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.settings import toml_value
from rmpa.core.identity import is_legal_name
from rmpa.core.limits import INT32_MAX, INT32_MIN
from rmpa.resource.actuation import read_config
from rmpa.resource.declare import ParameterValue, Role
from rmpa.resource.description import SUFFIX, read_description
from rmpa.resource.reconfigure import DESCRIPTION_TYPE
from rmpa.ros.types.definitions import ARRAY_TYPE, known_types
from rmpa.ros.types.descriptor import CONFIG_TYPE
from rmpa.runtime.programs import figures

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from rmpa.ros.environment import NodeFacts
    from rmpa.ros.node.endpoints import Received, Subscriber
    from rmpa.ros.node.node import Node
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

DESCRIPTIONS: Final = "/parameter_descriptions"
UPDATES: Final = "/parameter_updates"
DIAGNOSTICS: Final = "/diagnostics"
# Messages from which a rate can be told.
_FEW: Final = 3
# Above it a bound is the largest number of its type.
_BOUNDLESS: Final = 1e300
# The begin of a definition whose first field is a header, behind comments, and of such a message.
_STAMPED: Final = re.compile(r"(\s*(#.*)?\n)*\s*(std_msgs/)?Header\s")
_STAMP: Final = struct.Struct("<III")
# Seconds before the measurement begins.
_WARM_UP: Final = 0.5
# The name of a resource by the type of what it publishes.
_NAMES: Final = {
    "sensor_msgs/Image": "camera",
    "sensor_msgs/CompressedImage": "camera",
    "sensor_msgs/LaserScan": "laser",
    "sensor_msgs/PointCloud2": "cloud",
    "sensor_msgs/Imu": "imu",
    "sensor_msgs/Range": "sonar",
    "sensor_msgs/NavSatFix": "gps",
    "nav_msgs/Odometry": "base",
}
_COMMANDS: Final = re.compile(r"(geometry_msgs/Twist|ackermann_msgs/|trajectory_msgs/JointTrajectory)|cmd|command")
# Topics of every node, and those that image_transport's plugins add to each image.
_OF_ALL: Final = re.compile(r"^/(rosout|diagnostics|clock)$|/parameter_(descriptions|updates)$|/bond$")
_PLUGIN: Final = re.compile(r"/(compressed|compressedDepth|theora)$")
_RATE: Final = re.compile(r"rate|fps|freq|hz", re.IGNORECASE)
# Outputs, and inputs, that are active in the file.
_ACTIVE: Final = 3
# A smaller profile has so much of the present rate.
_SMALLER: Final = 1 / 3


@dataclass(slots=True)
class Flow:
    """What came on one topic from one node while it was measured; times in seconds."""

    count: int = 0
    size: int = 0
    first: float = 0.0
    last: float = 0.0

    def add(self, data: memoryview, now: float, *, stamped: bool) -> None:
        """Count a message, by its stamp where it has one: what waited for this process comes all at once."""
        if stamped and len(data) >= _STAMP.size:
            _, seconds, nanoseconds = _STAMP.unpack_from(data)
            now = seconds + nanoseconds / 1e9 or now
        self.first = self.first or now
        self.last = now
        self.count += 1
        self.size += len(data)

    @property
    def rate(self) -> float:
        """Messages a second; 0 where too few came."""
        return (self.count - 1) / (self.last - self.first) if self.count >= _FEW and self.last > self.first else 0.0

    @property
    def bandwidth(self) -> float:
        """Bytes a second; 0 where too few messages came."""
        return self.rate * self.size / self.count if self.count else 0.0


@dataclass(frozen=True, slots=True)
class Knob:
    """A parameter of a node's dynamic_reconfigure.

    Args:
        name: Its name there.
        type: ``bool``, ``int``, ``double`` or ``str``.
        value: The present value, or the default where the node does not say it.
        low: The least value of a number; ``None``: no bound.
        high: The greatest value of a number; ``None``: no bound.
        choices: The values of an enumeration by their names.
        description: A text for people.
    """

    name: str
    type: str
    value: ParameterValue
    low: float | None = None
    high: float | None = None
    choices: Mapping[str, ParameterValue] = field(default_factory=dict)
    description: str = ""


@dataclass(frozen=True, slots=True)
class LiveGraph:
    """What was seen of a graph while it was looked at.

    Args:
        flows: By topic, then by node.
        knobs: By the name of the dynamic_reconfigure server, then by parameter.
        private: The values below each node on the parameter server.
        diagnostics: The values by key of each status on /diagnostics, by its name.
        status_of: The node that published each status.
    """

    flows: Mapping[str, Mapping[str, Flow]]
    knobs: Mapping[str, Mapping[str, Knob]]
    private: Mapping[str, Mapping[str, XmlRpcValue]]
    diagnostics: Mapping[str, Mapping[str, str]]
    status_of: Mapping[str, str]

    def rate(self, topic: str, node: str = "") -> float:
        """Messages a second on a topic, of one node or of all together."""
        return sum(flow.rate for caller, flow in self.flows.get(topic, {}).items() if node in ("", caller))


async def look(
    node: Node,
    *,
    topics: Collection[str],
    servers: Collection[str],
    owners: Collection[str],
    diagnostics: bool,
    seconds: float,
) -> LiveGraph:
    """Listen for a while.

    Args:
        node: A node at the core.
        topics: The topics that are measured.
        servers: The names of nodes, or of namespaces in them, that have dynamic_reconfigure.
        owners: The nodes whose private parameters are read.
        diagnostics: Whether /diagnostics is read.
        seconds: How long.

    Raises:
        UnreachableError: The master does not answer.
    """
    flows: dict[str, dict[str, Flow]] = {topic: {} for topic in topics}
    told: dict[str, Any] = {}
    statuses: dict[str, dict[str, str]] = {}
    status_of: dict[str, str] = {}

    def count(topic: str, data: memoryview, header: Mapping[str, str]) -> None:
        now = time.monotonic()
        if now >= begin:
            stamped = _STAMPED.match(header.get("message_definition", "")) is not None
            flows[topic].setdefault(header.get("callerid", ""), Flow()).add(data, now, stamped=stamped)

    def tell(topic: str, received: Received) -> None:
        told[topic] = received.message

    def diagnose(received: Received) -> None:
        for status in received.message.status:
            statuses.setdefault(str(status.name), {}).update((str(p.key), str(p.value)) for p in status.values)
            status_of[str(status.name)] = received.caller_id

    subscribers: list[Subscriber] = []
    begin = math.inf
    for topic in topics:
        counted = await node.subscribe(topic, None, on_bytes=lambda data, header, t=topic: count(t, data, header))  # type: ignore[misc]
        subscribers.append(counted)
    for topic, kind in ((f"{s}{end}", kind) for s in servers for end, kind in _LATCHED):
        subscribers.append(await node.subscribe(topic, kind, lambda received, t=topic: tell(t, received)))  # type: ignore[misc]
    if diagnostics:
        subscribers.append(await node.subscribe(DIAGNOSTICS, ARRAY_TYPE, diagnose))
    # What comes first may have waited: in the publisher's queue, or for the imports of this process.
    begin = time.monotonic() + _WARM_UP
    try:
        await asyncio.sleep(seconds + _WARM_UP)
    finally:
        for subscriber in subscribers:
            await subscriber.close()
    knobs = {
        server: {one.name: one for one in _knobs(told[f"{server}{DESCRIPTIONS}"], told.get(f"{server}{UPDATES}"))}
        for server in servers
        if f"{server}{DESCRIPTIONS}" in told
    }
    private = {}
    for owner in owners:
        found = await node.get_param(owner, default={})
        private[owner] = found if isinstance(found, dict) else {}
    return LiveGraph(flows, knobs, private, statuses, status_of)


_LATCHED: Final = ((DESCRIPTIONS, DESCRIPTION_TYPE), (UPDATES, CONFIG_TYPE))


def _knobs(description: Any, updates: Any) -> Iterable[Knob]:
    low, high, values = (read_config(config) for config in (description.min, description.max, description.dflt))
    if updates is not None:
        values |= read_config(updates)
    for one in (each for group in description.groups for each in group.parameters):
        name, kind = str(one.name), str(one.type)
        choices = _choices(str(one.edit_method))
        least, most = _bound(low.get(name)), _bound(high.get(name))
        if kind not in ("int", "double") or choices:
            least = most = None
        if name in values:
            yield Knob(name, kind, values[name], least, most, choices, str(one.description).strip())


def _bound(value: ParameterValue | None) -> float | None:
    """A declared bound; ``None`` for those that servers have where their author gave none."""
    if value is None or isinstance(value, str) or not math.isfinite(value):
        return None
    return None if value in (INT32_MIN, INT32_MAX) or abs(value) > _BOUNDLESS else value


def _choices(edit_method: str) -> dict[str, ParameterValue]:
    """The enumeration in an ``edit_method``, which is written as a Python expression."""
    with contextlib.suppress(ValueError, SyntaxError, MemoryError, RecursionError, TypeError, KeyError):
        found = ast.literal_eval(edit_method or "{}")
        return {str(one["name"]): one["value"] for one in found.get("enum", ())}
    return {}


def started_by(pid: int) -> dict[str, str | tuple[str, ...]]:
    """How a process of this machine seems to have been started: ``run``, ``launch`` or ``command``, and ``args``.

    Args:
        pid: Its process id; empty is returned where it cannot be read.
    """
    words = _command(pid)
    if not words:
        return {}
    about = figures(pid)
    parent = _command(about.parent) if about is not None else []
    at = next((n for n, word in enumerate(parent) if Path(word).name == "roslaunch"), -1)
    if at >= 0 and (launched := [word for word in parent[at + 1 :] if not word.startswith("-")]):
        files = [word for word in launched if ":=" not in word]
        return {"launch": " ".join(files), "args": tuple(word for word in launched if ":=" in word)}
    begin = 0
    if re.match(r"python[\d.]*$", Path(words[0]).name):
        begin = next((n for n, word in enumerate(words) if n and not word.startswith("-")), 0)
    program = Path(words[begin])
    args = tuple(word for word in words[begin + 1 :] if not re.match(r"__(name|log|ns):=", word))
    package = next((folder.name for folder in program.parents[:3] if (folder / "package.xml").exists()), "")
    if not package and program.parent.parent.name in ("lib", "libexec"):
        package = program.parent.name
    started: dict[str, str | tuple[str, ...]] = {"command": tuple(words[: begin + 1])}
    if package:
        started = {"run": f"{package} {program.name}"}
    return started | ({"args": args} if args else {})


def _command(pid: int) -> list[str]:
    try:
        data = Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return []
    return [word.decode(errors="replace") for word in data.rstrip(b"\0").split(b"\0") if word]


@dataclass(frozen=True, slots=True)
class Found:
    """What is known of the node that is described.

    Args:
        name: As the user writes it: ``/usb_cam``, ``arm:/usb_cam``.
        facts: Its registrations in this graph.
        live: What was seen while it was looked at.
        server: The name of its dynamic_reconfigure server; empty: it has none.
        started: How it seems to have been started.
        seconds: For how long it was looked at.
    """

    name: str
    facts: NodeFacts
    live: LiveGraph
    server: str = ""
    started: Mapping[str, str | tuple[str, ...]] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def knobs(self) -> Mapping[str, Knob]:
        """The parameters of dynamic_reconfigure."""
        return self.live.knobs.get(self.server, {})

    @property
    def outputs(self) -> list[str]:
        """What it publishes, the most telling first: with a rate, then by bandwidth."""
        topics = [topic for topic in self.facts.publications if not _OF_ALL.search(topic)]
        flows = {topic: self.live.flows.get(topic, {}).get(self.facts.name) for topic in topics}

        def telling(topic: str) -> tuple[bool, float, str]:
            flow = flows[topic]
            plugin = _PLUGIN.search(topic) is not None and topic.rpartition("/")[0] in self.facts.publications
            return plugin, -flow.bandwidth if flow is not None else 0.0, topic

        return sorted(topics, key=telling)

    @property
    def inputs(self) -> list[str]:
        """What it subscribes to."""
        return [topic for topic in self.facts.subscriptions if not _OF_ALL.search(topic)]

    @property
    def role(self) -> Role:
        """The role that it seems to have."""
        if any(_COMMANDS.search(f"{kind} {topic}") for topic, kind in self._kinds(self.inputs)):
            return Role.ACTING
        if any(_COMMANDS.search(f"{kind} {topic}") for topic, kind in self._kinds(self.outputs)):
            return Role.CONTROLLING
        sensing = any(kind in _NAMES for _, kind in self._kinds(self.outputs))
        processing = any(kind in _NAMES for _, kind in self._kinds(self.inputs))
        return Role.CONTROLLING if processing or (self.inputs and not sensing) else Role.SENSING

    def _kinds(self, topics: Iterable[str]) -> Iterator[tuple[str, str]]:
        yield from ((t, self.facts.publications.get(t) or self.facts.subscriptions.get(t, "*")) for t in topics)

    @property
    def title(self) -> str:
        """A name for the resource, which must not be the node's own."""
        base = self.name.rpartition("/")[2]
        kinds = [kind for _, kind in self._kinds(self.outputs)] if self.role is not Role.CONTROLLING else []
        name = next((_NAMES[kind] for kind in kinds if kind in _NAMES), base)
        return f"{name}_resource" if self.name.rpartition(":")[2] == f"/{name}" else name


def describe(found: Found, title: str = "") -> str:
    """The text of a file, which ``read_description`` accepts.

    Args:
        found: What was found.
        title: The resource's name; by default one that fits.

    Raises:
        ConfigError: A name of the node cannot stand in a description.
    """
    title = title or found.title
    lines = [
        f"# Written by `rmpa resource describe {found.name}`, which looked at it for {found.seconds:g} s.",
        "# Lines with # are what else was found. `rmpa resource check FILE` compares the file with the live graph.",
        *_assigned({"name": title, "role": found.role}),
        *_node(found),
    ]
    labels: list[str] = []
    for number, topic in enumerate(found.outputs):
        flows = found.live.rate(topic, found.facts.name) > 0
        lines += _topic(found, "output", topic, labels, active=number < _ACTIVE and (not number or flows))
    for number, topic in enumerate(found.inputs):
        lines += _topic(found, "input", topic, labels, active=number < _ACTIVE)
    pace = _pace(found)
    for knob in found.knobs.values():
        lines += _parameter(knob, active=knob is pace)
    lines += [*_private(found), *_attributes(found), *_profiles(found, pace)]
    text = "\n".join(lines) + "\n"
    read_description(text.encode(), Path(f"{title}{SUFFIX}"))
    return text


def _assigned(values: Mapping[str, object]) -> list[str]:
    return [f"{key} = {toml_value(value)}" for key, value in values.items()]


def _table(kind: str, key: str, values: Mapping[str, object], *notes: str, active: bool = True) -> list[str]:
    name = key if re.fullmatch(r"[\w-]+", key, re.ASCII) else toml_value(key)
    sign = "" if active else "# "
    body = [f"{sign}{line}" for line in (f"[{kind}.{name}]", *_assigned(values))]
    return ["", *(f"# {note}" for note in notes), *body]


def _node(found: Found) -> list[str]:
    module, _, name = found.name.rpartition(":")
    server = {"server": found.server} if found.server not in ("", name) else {}
    lines = _table("node", "driver", {"name": name} | server, *([f"It runs at the module {module}."] * bool(module)))
    if found.started:
        guessed = [f"# {line}" for line in _assigned(found.started)]
        return [*lines, "# Start it too: (what is set here is guessed from its process)", *guessed]
    return [*lines, '# run = "PACKAGE EXECUTABLE", launch = "PACKAGE FILE" or command = ["PROGRAM"] would start it.']


def _topic(found: Found, kind: str, topic: str, labels: list[str], *, active: bool) -> list[str]:
    type_name = (found.facts.publications if kind == "output" else found.facts.subscriptions)[topic]
    parts = [part for part in topic.split("/") if part]
    label = next(
        (made for n in range(1, len(parts) + 1) if (made := "_".join(parts[-n:])) not in labels),
        f"{kind}_{len(labels)}",
    )
    labels.append(label)
    flow = found.live.flows.get(topic, {}).get(found.facts.name) if kind == "output" else None
    note = f"{flow.rate:.3g} Hz, {flow.bandwidth / 1e3:.3g} kB/s" if flow is not None and flow.rate else ""
    if kind == "output" and not note:
        note = "no regular messages came"
    if type_name == "*" or (not flow and type_name not in known_types() and kind == "input"):
        active = False  # nothing says yet what it is
    return _table(kind, label, {"topic": topic, "type": type_name}, *filter(None, [note]), active=active)


def _pace(found: Found) -> Knob | None:
    """The parameter that seems to say the rate, with room below its present value."""
    for knob in found.knobs.values():
        number = isinstance(knob.value, int | float) and not isinstance(knob.value, bool) and not knob.choices
        if number and _RATE.search(knob.name) and knob.low is not None and _smaller(knob) < float(knob.value):
            return knob
    return None


def _smaller(knob: Knob) -> float:
    value = max(float(knob.value) * _SMALLER, knob.low or 0.0)
    return max(1, round(value)) if isinstance(knob.value, int) else float(f"{value:.2g}")


def _parameter(knob: Knob, *, active: bool) -> list[str]:
    if not is_legal_name(knob.name) or "/" in knob.name:
        return []
    bounds = {"low": knob.low, "high": knob.high}
    values: dict[str, object] = {"dynamic": knob.name, "default": _shown(knob.value, knob.type)}
    values |= {key: int(bound) if knob.type == "int" else bound for key, bound in bounds.items() if bound is not None}
    if knob.choices:
        values["choices"] = tuple(_shown(value, knob.type) for value in knob.choices.values())
    names = ", ".join(f"{value}: {name}" for name, value in knob.choices.items())
    notes = filter(None, [" ".join(knob.description.split())[:110], names[:110]])
    return _table("parameter", knob.name, values, *notes, active=active)


def _shown(value: ParameterValue, kind: str = "") -> ParameterValue:
    """A value whose text in TOML is of its own type: 30.0 is no whole number."""
    return _Decimal(value) if kind == "double" or isinstance(value, float) else value


class _Decimal(float):
    """A number that has a point in TOML even where it is whole."""

    def __format__(self, spec: str) -> str:
        text = float.__format__(self, spec)
        return text if re.search(r"[.en]", text) else f"{text}.0"


def _private(found: Found) -> list[str]:
    lines = []
    for name, value in found.live.private.get(found.facts.name, {}).items():
        if name not in found.knobs and isinstance(value, bool | int | float | str) and is_legal_name(name) and name:
            values = {"private": name, "default": _shown(value)}
            lines += _table(
                "parameter", name, values, "Read at its start: the node must be started here.", active=False
            )
    return lines


def _attributes(found: Found) -> list[str]:
    lines = []
    for name, values in found.live.diagnostics.items():
        if found.live.status_of.get(name) != found.facts.name:
            continue
        for key, value in values.items():
            if re.match(r"\s*[-+]?\d", value) and not {"'", '"'} & {*name, *key}:
                label = re.sub(r"\W+", "_", key).strip("_").lower()
                about = {"value": f"diagnostics('{name}', '{key}')", "better": "min"}
                lines += _table("attribute", label, about, f"It says {value!r} there.", active=False)
    if found.started:
        lines += _table("attribute", "load", {"value": "cpu()", "better": "min"}, active=False)
    return lines


def _profiles(found: Found, pace: Knob | None) -> list[str]:
    rate = found.live.rate(found.outputs[0], found.facts.name) if found.outputs else 0.0

    def profile(name: str, value: float | None, hertz: float, rest: Mapping[str, object]) -> list[str]:
        sets = f"{{ {pace.name} = {toml_value(_shown(value, pace.type))} }}" if pace and value is not None else ""
        offers = f'{{ rate = "{hertz:.3g} Hz" }}' if hertz else "{ }"
        middle = [f"set = {sets}"] if sets else []
        return ["", f"[profile.{name}]", *middle, f"offers = {offers}", *_assigned(rest)]

    if pace is None:
        return profile("normal", None, rate, {"best_effort": True})
    smaller = _smaller(pace)
    return [
        *profile("full", float(pace.value) if pace.type == "double" else int(pace.value), rate, {"cost": 2}),
        *profile("small", smaller, rate * smaller / float(pace.value), {"cost": 1, "best_effort": True}),
    ]
