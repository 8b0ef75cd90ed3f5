"""Compares the description of a resource with the live graph (``rmpa resource check``).

``GraphCheck`` is a function of the declaration and of what was seen of the graph;
it changes nothing.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from xml.etree import ElementTree as ET

from rmpa.config.toml_file import line_of
from rmpa.config.values import Place, did_you_mean, suggestion
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.resource.declare import BindingKind, ManagedNode, Parameter, ParameterValue
from rmpa.resource.describing import DESCRIPTIONS, Knob, LiveGraph
from rmpa.resource.expression import split_reference
from rmpa.resource.processes import command_of
from rmpa.ros.types.descriptor import TOPIC
from rmpa.ros.types.find import find_message_type
from rmpa.ros.types.installed import SearchPath, package_folders

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping
    from pathlib import Path

    from rmpa.resource.decision import Profile
    from rmpa.resource.resource import Resource

# A measured rate that is so much below an offer contradicts it.
_SHORT: Final = 0.85


@dataclass(frozen=True, slots=True)
class Misfit:
    """Something that does not fit.

    Args:
        line: In the file, from 1.
        where: The table and key: ``parameter.fps.dynamic``.
        problem: What does not fit.
        remedy: What to do; may be empty.
        error: Whether the resource cannot work so; else it is a warning: that may be right, or become so.
    """

    line: int
    where: str
    problem: str
    remedy: str = ""
    error: bool = True


@dataclass(frozen=True, slots=True)
class GraphCheck:
    """One comparison.

    Args:
        resource: The declaration.
        text: The file's text.
        path: The file.
        publishers: The nodes by topic.
        types: The types by topic, where they are known.
        running: The nodes that are registered.
        seen: What was measured, read and heard.
    """

    resource: Resource
    text: str
    path: Path
    publishers: Mapping[str, Collection[str]]
    types: Mapping[str, str]
    running: Collection[str]
    seen: LiveGraph

    def misfits(self) -> list[Misfit]:
        """All that does not fit, by line."""
        each = (self._nodes(), self._topics(), self._parameters(), self._rules(), self._offers(), self._asks())
        return sorted((one for some in each for one in some), key=lambda one: one.line)

    def _misfit(self, place: Place, problem: str, remedy: str = "", *, error: bool = True) -> Misfit:
        sizes = range(len(place), 0, -1)
        line = next((found for size in sizes if (found := line_of(self.text, place[:size]))), 1)
        return Misfit(line, ".".join(map(str, place)), problem, remedy, error)

    def _up(self, node: ManagedNode) -> bool:
        return node.name in self.running

    def _knobs(self, key: str) -> Mapping[str, Knob]:
        node = self.resource.nodes[key]
        return self.seen.knobs.get(node.server or node.name, {})

    def _nodes(self) -> Iterator[Misfit]:
        for key, node in self.resource.nodes.items():
            place = ("node", key)
            if not self._up(node) and not node.started:
                remedy = suggestion(
                    node.name, self.running, "start it, or say how it is started: run, launch, command"
                )
                yield self._misfit((*place, "name"), f"no node {node.name} runs", remedy)
            if node.started and (problem := _missing(node, self.path.parent)):
                how = next(each for each in ("run", "launch", "command") if getattr(node, each))
                yield self._misfit((*place, how), problem, "is its workspace sourced here?")

    def _topics(self) -> Iterator[Misfit]:
        resource, names = self.resource, {node.name for node in self.resource.nodes.values()}
        all_up = all(map(self._up, resource.nodes.values()))
        for kind, topics in (("output", resource.outputs), ("input", resource.inputs)):
            for topic in topics.values():
                place, there = (kind, topic.label), self.publishers.get(topic.name, ())
                known = self.types.get(topic.name, topic.type_name)
                if known != topic.type_name:
                    yield self._misfit((*place, "type"), f"{topic.name} is {known}", f'write type = "{known}"')
                if there and kind == "output" and names and names.isdisjoint(there):
                    problem = f"{topic.name} is published by {', '.join(there)}, which is no node of this file"
                    yield self._misfit(
                        (*place, "topic"), problem, "add a [node.NAME], or name another topic", error=False
                    )
                if not there and (kind == "output" or getattr(topic, "required", False)):
                    remedy = suggestion(topic.name, self.publishers, "`rmpa topic list` shows all")
                    certain = kind == "output" and all_up and bool(names)
                    yield self._misfit((*place, "topic"), f"no node publishes {topic.name}", remedy, error=certain)

    def _parameters(self) -> Iterator[Misfit]:
        for name, parameter in self.resource.parameters.items():
            binding = parameter.binding
            if binding is None:
                continue
            node, place = self.resource.nodes[binding.node], ("parameter", name, binding.kind.value)
            if binding.kind is BindingKind.ARGUMENT:
                if problem := _no_argument(node.launch, self.path.parent, binding.name):
                    yield self._misfit(place, problem)
            elif not self._up(node):
                continue
            elif binding.kind is BindingKind.PRIVATE:
                yield from self._private(node, parameter, binding.name, place)
            elif not (knobs := self._knobs(binding.node)):
                ends = [t for t, nodes in self.publishers.items() if t.endswith(DESCRIPTIONS) and node.name in nodes]
                others = " or ".join(f'server = "{topic.removesuffix(DESCRIPTIONS)}"' for topic in ends)
                problem = f"there is no dynamic_reconfigure {node.server or node.name}"
                yield self._misfit(place, problem, f"the node has {others}" if others else "is it private?")
            elif (knob := knobs.get(binding.name)) is None:
                remedy = suggestion(binding.name, knobs, f"it has {', '.join(knobs)}")
                yield self._misfit(place, f"{node.name} has no parameter {binding.name}", remedy)
            else:
                yield from self._dynamic(parameter, knob)

    def _private(self, node: ManagedNode, parameter: Parameter, name: str, place: Place) -> Iterator[Misfit]:
        there: object = self.seen.private.get(node.name, {})
        for part in name.strip("/").split("/"):
            there = there.get(part) if isinstance(there, dict) else None
        if there is None:
            remedy = suggestion(name, self.seen.private.get(node.name, {}), "does the node read it?")
            yield self._misfit(place, f"the parameter server has no {node.name}/{name}", remedy, error=False)
        elif not _fits(there, parameter.type):
            problem = f"it is {there!r} on the parameter server, and {parameter.default!r} here"
            yield self._misfit((*place[:-1], "default"), problem, "write it in the node's own type", error=False)

    def _dynamic(self, parameter: Parameter, knob: Knob) -> Iterator[Misfit]:
        place = ("parameter", parameter.name)
        if knob.type != parameter.type:
            problem = f"{knob.name} is of type {knob.type}, not {parameter.type}"
            yield self._misfit((*place, "default"), problem, f"write it like {_example(knob)}")
            return
        low, high = parameter.bounds
        takes = f"the node takes {_range(knob)}"
        if parameter.low is not None and knob.low is not None and low < knob.low:
            yield self._misfit((*place, "low"), f"{low:g} is below what {takes}", f"low = {knob.low:g}")
        if parameter.high is not None and knob.high is not None and high > knob.high:
            yield self._misfit((*place, "high"), f"{high:g} is above what {takes}", f"high = {knob.high:g}")
        for choice in parameter.choices:
            yield from self._value((*place, "choices"), choice, knob)
        yield from self._value((*place, "default"), parameter.default, knob)
        for name, profile in self.resource.profiles.items():
            if parameter.name in profile.sets:
                yield from self._value(("profile", name, "set", parameter.name), profile.sets[parameter.name], knob)

    def _value(self, place: Place, value: ParameterValue, knob: Knob) -> Iterator[Misfit]:
        if knob.choices and value not in knob.choices.values():
            names = ", ".join(f"{each!r} ({name})" for name, each in knob.choices.items())
            yield self._misfit(place, f"the node has no value {value!r} of {knob.name}", f"it has {names}")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            low, high = knob.low, knob.high
            if (low is not None and value < low) or (high is not None and value > high):
                yield self._misfit(place, f"{value:g} is not what the node takes, {_range(knob)}")

    def _rules(self) -> Iterator[Misfit]:
        for place, expression in self.resource.expressions():
            for reference in expression.references:
                if reference.startswith("/") and (problem := self._reference(reference)):
                    yield self._misfit(place, *problem, error=False)
            for source in expression.sources.values():
                if source.function == "diagnostics" and (problem := self._status(*source.arguments)):
                    yield self._misfit(place, *problem, error=False)

    def _reference(self, reference: str) -> tuple[str, str] | None:
        for topic, fields in split_reference(reference):
            if topic not in self.publishers:
                continue
            with contextlib.suppress(RmpaError):  # a type that is not known here: the publisher tells it at run time
                kind = find_message_type(self.types.get(topic, ""))
                value: object = kind.make()
                for name in fields or tuple(field.name for field in kind.fields[:1]):
                    if not hasattr(value, name):
                        has = ", ".join(field.name for field in kind.fields)
                        return f"{topic} is {kind.name}, which has no {'.'.join(fields)}", f"it has {has}"
                    value = getattr(value, name)
            return None
        nearest = (did_you_mean(topic, self.publishers) for topic, _ in split_reference(reference))
        near = next(filter(None, nearest), "")
        return f"no node publishes {reference}", f"did you mean {near}?" if near else "it is unknown until one does"

    def _status(self, name: str, key: str | None = None) -> tuple[str, str] | None:
        found = self.seen.diagnostics.get(name)
        if found is None:
            known = self.seen.diagnostics
            return f"/diagnostics has had no status {name!r}", suggestion(name, known, f"it has {_some(known)}")
        if key is not None and key not in found:
            return f"the status {name!r} has no {key!r}", suggestion(key, found, f"it has {_some(found)}")
        return None

    def _offers(self) -> Iterator[Misfit]:
        """Rates that are offered by the profile whose values the nodes have now, and were not measured."""
        first = next(iter(self.resource.outputs), "")
        for profile in self.resource.profiles.values():
            if not self._present(profile):
                continue
            for key, offer in profile.offers.items():
                label = key.rpartition(".")[0]
                names = {one.label: name for name, one in self.resource.outputs.items()}
                topic = names.get(label, "" if label else first)
                measured = self.seen.rate(topic) if topic else 0.0
                if key.rpartition(".")[2] == "rate" and measured and measured < _SHORT * float(offer):
                    problem = f"{topic} has {measured:.3g} Hz now, with the values of this profile"
                    remedy = "offer what it gives, or see what holds it up"
                    yield self._misfit(("profile", profile.name, "offers", key), problem, remedy, error=False)

    def _present(self, profile: Profile) -> bool:
        """Whether the nodes have now what a profile sets, as far as dynamic_reconfigure tells."""
        if not profile.sets:
            return len(self.resource.profiles) == 1
        for name, value in profile.sets.items():
            binding = self.resource.parameters[name].binding
            if binding is None or binding.kind is not BindingKind.DYNAMIC:
                return False
            knob = self._knobs(binding.node).get(binding.name)
            if knob is None or knob.value != value:
                return False
        return True

    def _asks(self) -> Iterator[Misfit]:
        for name in self.resource.demands:
            if f"{name}/{TOPIC}" not in self.publishers:
                key = name if name in self.text else name[1:]
                yield self._misfit(("ask", key), f"there is no resource {name}", "`rmpa resource list`", error=False)


def _range(knob: Knob) -> str:
    low = f"{knob.low:g}" if knob.low is not None else "any"
    return f"{low} to {knob.high:g}" if knob.high is not None else f"{low} or more"


def _example(knob: Knob) -> str:
    return f"{float(knob.value)!r}" if knob.type == "double" else f"{knob.value!r}"


def _some(names: Collection[str]) -> str:
    return ", ".join(map(repr, list(names)[:5])) or "none"


def _fits(value: object, kind: str) -> bool:
    types = {"bool": (bool,), "int": (int,), "double": (int, float), "str": (str,)}[kind]
    return isinstance(value, types) and (kind == "bool" or not isinstance(value, bool))


def _missing(node: ManagedNode, folder: Path) -> str:
    """Why what starts a node is not found on this machine; empty if it is."""
    if node.command:
        program = node.command[0]
        found = shutil.which(program) or ("/" in program and os.access(folder / program, os.X_OK))
        return "" if found else f"there is no program {program} on this machine"
    try:
        command_of(node, {}, os.environ)
    except PeerRefused as error:
        return f"{error.peer}: {error.reason}"
    lost = node.launch and _launch_file(node.launch.split(), folder) is None
    return f"there is no launch file {node.launch} on this machine" if lost else ""


def _launch_file(words: list[str], folder: Path) -> Path | None:
    if len(words) == 1:
        return beside if (beside := folder / words[0]).is_file() else None
    path = SearchPath.read(os.environ)
    roots = (*path.packages, *(f"{prefix}/share" for prefix in (*path.prefixes, *path.system)))
    places = (place for root in roots for place in package_folders(words[0], root))
    return next((found for place in places for found in sorted(place.rglob(words[1]))), None)


def _no_argument(launch: str, folder: Path, name: str) -> str:
    """Why a launch file does not have an argument; empty if it has, or cannot be read."""
    path = _launch_file(launch.split(), folder)
    try:
        text = path.read_text(encoding="utf-8") if path is not None else ""
        if not text or re.search(r"<!(DOCTYPE|ENTITY)", text):
            return ""
        args = [each.get("name", "") for each in ET.fromstring(text).iter("arg")]  # noqa: S314 - no entities
    except (OSError, ValueError, ET.ParseError):
        return ""
    return (
        "" if name in args else f"{launch} has no argument {name}; {suggestion(name, args, 'it has ' + _some(args))}"
    )
