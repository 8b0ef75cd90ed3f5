"""``rmpa profile list|get|set|explain``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from rmpa.cli.manual_choice import ManualChoice, resource_json
from rmpa.cli.options import GraphOptions, completes, graph_options
from rmpa.cli.output import Column, print_json, print_line, print_table
from rmpa.cli.resource_graph import decision_of, run_with_resources
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from rmpa.cli.resource_graph import ResourceGraph, SeenResource
    from rmpa.resource.run.descriptor import Descriptor


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
