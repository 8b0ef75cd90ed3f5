"""``rmpa resource info``: all that a resource publishes about itself."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.cli.options import GraphOptions, completes, graph_options
from rmpa.cli.output import Column, print_json, print_line, print_table, warn
from rmpa.cli.profile import offers, shown
from rmpa.cli.resource_graph import run_with_resources
from rmpa.resource.declare.attributes import MEASURED
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from rmpa.cli.resource_graph import ResourceGraph, SeenResource
    from rmpa.resource.run.descriptor import Descriptor, ParameterDescriptor, TaskDescriptor, TopicDescriptor

_TIMES: Final = frozenset({"deadline", "lifespan", "liveliness_lease"})


@click.command(epilog="\b\nExamples:\n  rmpa resource info /sonar\n  rmpa resource info base:/arm --json\n")
@click.argument("resource", required=False, shell_complete=completes("resource"))
@graph_options
def info(resource: str | None, options: GraphOptions) -> None:
    """Show all of a RESOURCE: topics, parameters, qualities, profiles, contexts, tasks, what it asks, and clients."""

    async def body(graph: ResourceGraph) -> None:
        one = graph.pick(resource)
        texts, values, quality, responses = await asyncio.gather(
            graph.texts([one], "state", "profile", "context"),
            graph.configuration(one),
            graph.hear([one], "quality", ARRAY_TYPE),
            graph.hear([one], "responses", ARRAY_TYPE),
        )
        state, profile, context = (said.get(one, "") for said in texts)
        health, *_ = [*_statuses(quality.get(one)), None]
        about: dict[str, Any] = {
            "name": one.path,
            "peer": one.peer,
            "node": one.caller,
            "state": state,
            "profile": profile,
            "context": context,
            "health": health,
            "parameters": values,
            "clients": _statuses(responses.get(one)),
        }
        if options.as_json:
            print_json(about | {"descriptor": one.descriptor})
        else:
            _print_info(one, about)

    run_with_resources(options, body)


def _statuses(message: Any) -> list[dict[str, Any]]:
    """The elements of a ``DiagnosticArray``."""
    if message is None:
        return []
    return [
        {
            "name": str(status.name),
            "level": DiagnosticLevel(int(status.level) & 3).name,
            "message": str(status.message),
            "values": {str(pair.key): str(pair.value) for pair in status.values},
        }
        for status in message.status
    ]


def _print_info(one: SeenResource, about: dict[str, Any]) -> None:
    said, health = one.descriptor, about["health"]
    kind = "device" if said.physical else "simulated"
    _line("Resource", f"{one} ({said.role}, {kind})")
    if said.description:
        _line("Description", said.description)
    if one.peer is not None:
        whose = "module" if "/" in one.peer else "peer"
        _line("Node", f"{said.node} of {whose} {one.peer}, by its proxy {one.caller}")
    _line("State", about["state"] or "does not answer")
    _line("Profile", about["profile"] or "none runs")
    if said.contexts:
        _line("Context", about["context"] or "none")
    if health is None:
        warn(f"{one} has sent no quality while we listened")
    else:
        _line("Health", f"{health['level']}: {health['message']}")
    _topics("OUTPUT", said.outputs)
    _topics("INPUT", said.inputs)
    _table(
        ("PARAMETER", "VALUE", "RANGE", "DESCRIPTION"), (_parameter(p, about["parameters"]) for p in said.parameters)
    )
    _table(("QUALITY", "NOW", "BETTER", "CLASS"), _qualities(said, health["values"] if health else {}))
    _table(
        ("PROFILE", "COST", "OFFERS", "DESCRIPTION"),
        ((p.name, f"{p.cost:g}", offers(said, p.offers) or "-", p.description) for p in said.profiles),
    )
    _table(("CONTEXT", "WHEN"), ((c.name, c.when or "by hand") for c in said.contexts))
    _table(("TASK", "RUNS"), ((t.name, _runs(t, about["parameters"])) for t in said.tasks))
    _table(
        ("ASKS OF", "FOR", "PRIORITY"),
        (
            (a.resource, "; ".join(f"{k} {v}" for k, v in a.wishes.items()) or "nothing at present", str(a.priority))
            for a in said.asks
        ),
    )
    _table(
        ("CLIENT", "IS TOLD", "ASKS"),
        (
            (c["name"], f"{c['level']}: {c['message']}", "; ".join(f"{k} {v}" for k, v in c["values"].items()) or "-")
            for c in about["clients"]
        ),
    )


def _runs(task: TaskDescriptor, values: dict[str, Any]) -> str:
    """The rate at which a task runs, or the topic that starts it."""
    if task.follows in values:
        return f"{values[task.follows]:g} Hz (parameter {task.follows})"
    return f"{task.rate:g} Hz" if task.rate else f"on {task.on}"


def _parameter(one: ParameterDescriptor, values: dict[str, Any]) -> Sequence[str]:
    low, high = ("" if bound is None else f"{bound:g}" for bound in (one.low, one.high))
    within = " | ".join(map(str, one.choices)) or (f"{low} .. {high}" if low or high else one.type)
    value = values.get(one.name, one.default)
    text = str(value).lower() if isinstance(value, bool) else shown(value, one.unit)
    return one.name, text, within, one.description


def _qualities(said: Descriptor, values: dict[str, str]) -> list[Sequence[str]]:
    """The declared attributes, and the general ones that are measured."""
    return [
        (each.name, values.get(each.name, "not measured"), each.better, each.category)
        for each in said.attributes
        if each.name in values or each.name.rpartition(".")[2] not in MEASURED
    ]


def _topics(title: str, topics: Sequence[TopicDescriptor]) -> None:
    _table(
        (title, "TYPE", "CONTRACT"),
        ((t.topic, t.type, ", ".join(_term(key, value) for key, value in t.contract.items()) or "-") for t in topics),
    )


def _term(key: str, value: object) -> str:
    """A term of a contract; times are in seconds."""
    return f"{key} {value:g} s" if isinstance(value, float) and key in _TIMES else f"{key} {value}"


def _line(title: str, text: str) -> None:
    print_line(f"{title}: {text}")


def _table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    if made := list(rows):
        print_line()
        print_table(tuple(map(Column, titles)), made)
