"""``rmpa profile`` and ``rmpa resource info``: what a resource has chosen, and choices by hand.

``rmpa profile list|get|set|explain``.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.cli.options import GraphOptions, completes, graph_options
from rmpa.cli.output import Column, print_json, print_line, print_table, warn
from rmpa.cli.resource import decision_of, known_name, run_with_resources
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.resource.quality import MEASURED
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence

    from rmpa.cli.resource import ResourceGraph, SeenResource
    from rmpa.resource.descriptor import Descriptor, ParameterDescriptor, TaskDescriptor, TopicDescriptor


# The commands ``get`` and ``set`` of ``rmpa profile`` and ``rmpa context``.


@dataclass(frozen=True, slots=True)
class ManualChoice:
    """A choice that a resource offers.

    Args:
        what: ``profile`` or ``context``: the word for it, and the parameter that chooses it.
        names: The names to choose from, by the resource's descriptor.
        present: Reads the present one: an object for JSON with the keys ``what`` and ``chosen`` (by hand).
    """

    what: str
    names: Callable[[Descriptor], Iterable[str]]
    present: Callable[[ResourceGraph, SeenResource], Awaitable[Mapping[str, Any]]]

    def get_command(self, text: str) -> click.Command:
        """The command ``get`` with its help text."""

        @click.command("get", help=text, epilog=f"\b\nExamples:\n  rmpa {self.what} get /sonar\n")
        @click.argument("resource", shell_complete=completes("resource"), required=False)
        @graph_options
        def get(resource: str | None, options: GraphOptions) -> None:
            async def body(graph: ResourceGraph) -> None:
                one = graph.pick(resource)
                present = await self.present(graph, one)
                if options.as_json:
                    print_json({**resource_json(one), **present})
                else:
                    print_line(str(present[self.what]))

            run_with_resources(options, body)

        return get

    def set_command(self, text: str, auto_text: str, example: str) -> click.Command:
        """The command ``set`` with its help text, that of ``--auto``, and a name for its examples."""
        examples = f"  rmpa {self.what} set /sonar {example}\n  rmpa {self.what} set base:/sonar --auto\n"

        @click.command("set", help=text, epilog=f"\b\nExamples:\n{examples}")
        @click.argument("resource", shell_complete=completes("resource"))
        @click.argument("name", required=False, metavar=f"[{self.what.upper()}]", shell_complete=completes(self.what))
        @click.option("--auto", is_flag=True, help=auto_text)
        @graph_options
        def set_(resource: str, name: str | None, auto: bool, options: GraphOptions) -> None:
            if (name is None) != auto:
                raise ConfigError(self.what.upper(), "say which one, or --auto", "one of both")

            async def body(graph: ResourceGraph) -> None:
                one = graph.pick(resource)
                names = list(self.names(one.descriptor))
                if not names:
                    raise ConfigError("RESOURCE", f"{one} has no {self.what}s", "")
                if name is not None:
                    known_name(self.what, name, names)
                await graph.configure(one, {self.what: name or ""})
                if options.as_json:
                    print_json({**resource_json(one), "chosen": name or ""})

            run_with_resources(options, body)

        return set_


def resource_json(one: SeenResource) -> dict[str, str | None]:
    """The resource of an answer, for JSON."""
    return {"resource": one.path, "peer": one.peer}


def shown(value: object, unit: str) -> str:
    """A value with its unit; ``-`` for none."""
    if value is None:
        return "-"
    return f"{value:.6g} {unit}".rstrip() if isinstance(value, int | float) else str(value)


def offers(descriptor: Descriptor, values: dict[str, float | str]) -> str:
    """The qualities that a profile offers, in one line."""
    units = {attribute.name: attribute.unit for attribute in descriptor.attributes}
    return ", ".join(f"{name} {shown(value, units.get(name, ''))}" for name, value in values.items())


async def _decision(graph: ResourceGraph, one: SeenResource) -> dict[str, Any]:
    (said,) = await graph.texts([one], "decision")
    if not said.get(one):
        raise RmpaError(f"{one} has decided nothing yet; is it active?")
    return decision_of(said[one])


@click.command("list", epilog="\b\nExamples:\n  rmpa profile list\n  rmpa profile list base:/sonar --json\n")
@click.argument("resource", required=False, shell_complete=completes("resource"))
@graph_options
def list_(resource: str | None, options: GraphOptions) -> None:
    """List a RESOURCE's profiles and what they offer."""

    async def body(graph: ResourceGraph) -> None:
        one = graph.pick(resource)
        decision = await _decision(graph, one)
        runs, chosen = decision.get("profile", ""), decision.get("chosen", "")
        left_out = {str(s.get("profile")): str(s.get("excluded", "")) for s in decision.get("scores", ())}
        if options.as_json:
            print_json(
                {
                    **resource_json(one),
                    "profile": runs,
                    "chosen": chosen,
                    "profiles": one.descriptor.profiles,
                    "left_out": {name: why for name, why in left_out.items() if why},
                }
            )
            return
        rows, colours = [], []
        for each in one.descriptor.profiles:
            why = left_out.get(each.name, "")
            state = ("runs, by hand" if each.name == chosen else "runs") if each.name == runs else ""
            colours.append("green" if state else "yellow" if why else "")
            notes = "; ".join(filter(None, ("best effort" if each.best_effort else "", each.description)))
            cells = (
                each.name,
                state or ("left out" if why else "-"),
                offers(one.descriptor, each.offers) or "-",
                f"{each.cost:g}",
                why or notes,
            )
            rows.append(cells)
        columns = (Column("PROFILE"), Column("STATE"), Column("OFFERS"), Column("COST", right=True), Column("NOTES"))
        print_table(columns, rows, colours=colours)

    run_with_resources(options, body)


async def _present(graph: ResourceGraph, one: SeenResource) -> dict[str, Any]:
    decision = await _decision(graph, one)
    return {key: decision.get(key, "") for key in ("profile", "applying", "chosen")}


_CHOICE = ManualChoice("profile", lambda descriptor: (each.name for each in descriptor.profiles), _present)
get = _CHOICE.get_command("Print the profile of a RESOURCE that runs.")
set_ = _CHOICE.set_command(
    """Choose the PROFILE of a RESOURCE by hand; returns when it runs.

    It runs whatever clients ask, until --auto. If it cannot be applied, what was chosen before stays.
    """,
    "Let the resource decide again.",
    "fine",
)


@click.command(
    epilog="""\
\b
D is the distance of a profile from what is asked: sqrt(sum(weight * shortfall^2) / sum(weight)) over its terms,
and a little for its cost. A shortfall of 1 is the tolerance of the attribute, or the range over all profiles. The
smallest D that falls short of nothing hard is taken.

\b
Examples:
  rmpa profile explain /sonar
  rmpa profile explain base:/sonar --json
"""
)
@click.argument("resource", required=False, shell_complete=completes("resource"))
@graph_options
def explain(resource: str | None, options: GraphOptions) -> None:
    """Show each term of a RESOURCE's last decision."""

    async def body(graph: ResourceGraph) -> None:
        one = graph.pick(resource)
        decision = await _decision(graph, one)
        if options.as_json:
            print_json({**resource_json(one), **decision})
        else:
            _print_explained(one, decision)

    run_with_resources(options, body)


def _print_explained(one: SeenResource, decision: dict[str, Any]) -> None:
    runs, chosen = str(decision.get("profile", "")), str(decision.get("chosen", ""))
    clients = ", ".join(map(str, decision.get("clients", ()))) or "no client"
    print_line(f"{one}: profile {runs or 'none'}" + (", chosen by hand" if chosen else ""))
    print_line(f"asked by {clients}")
    for conflict in decision.get("conflicts", ()):
        print_line(f"conflict: {conflict}")
    if decision.get("alarm"):
        print_line(f"alarm: {str(decision['alarm']).replace('_', '-')}")
    if decision.get("reaction") is not None:
        print_line(f"last reconfiguration took {decision['reaction']:.3g} s")
    print_line()
    units = {attribute.name: attribute.unit for attribute in one.descriptor.attributes}
    rows, colours = [], []
    for score in decision.get("scores", ()):
        name = str(score.get("profile"))
        head = (name, _verdict(score, runs, chosen), f"{score.get('distance', 0.0):.4g}")
        terms: list[dict[str, Any]] = score.get("terms") or [{}]
        for term in terms:
            attribute = str(term.get("attribute", "-"))
            shortfall = term.get("delta")
            cells = (
                *head,
                attribute,
                f"{term.get('wanted', '-')}" + (" hard" if term.get("hard") else ""),
                shown(term.get("offered"), units.get(attribute, "")),
                f"{shortfall:.4g}" if shortfall is not None else "-",
                f"{term['weight']:g}" if "weight" in term else "-",
            )
            rows.append(cells)
            colours.append("green" if name == runs else "yellow" if score.get("excluded") else "")
            head = ("", "", "")
    titles = ("PROFILE", "VERDICT", "D", "ATTRIBUTE", "WANTED", "OFFERED", "SHORTFALL", "WEIGHT")
    columns = [Column(title, right=title in ("D", "SHORTFALL", "WEIGHT")) for title in titles]
    print_table(columns, rows, colours=colours)


def _verdict(score: dict[str, Any], runs: str, chosen: str) -> str:
    if score.get("profile") == runs == chosen:
        return f"runs, by hand, though {score['excluded']}" if score.get("excluded") else "runs, by hand"
    if score.get("excluded"):
        return f"left out: {score['excluded']}"
    if score.get("profile") == runs:
        return "runs" if score.get("feasible") else "runs, best there is"
    return "can serve" if score.get("feasible") else "falls short"


# ``rmpa resource info``: all that a resource publishes about itself.


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
