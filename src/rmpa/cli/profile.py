"""``rmpa resource info``, ``rmpa profile`` and ``rmpa context``: what one resource says, and choices by hand."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Any, Final

import click
import msgspec

from rmpa.cli.graph import suggestion
from rmpa.cli.options import Options, argument, completes, flag, graph_verb, options_of
from rmpa.cli.output import Table, Text, printable, warn
from rmpa.cli.resource import resource_names, resource_verb, run_with_resources, status_of
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.resource.quality import MEASURED
from rmpa.ros.types.definitions import ARRAY_TYPE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from rmpa.cli.resource import ResourceGraph, SeenResource
    from rmpa.ros.types.descriptor import Descriptor, ParameterDescriptor, TaskDescriptor

_TIMES: Final = frozenset({"deadline", "lifespan", "liveliness_lease"})


def _shown(value: object, unit: str) -> str:
    """A value with its unit; ``-`` for none."""
    if value is None:
        return "-"
    return f"{value:.6g} {unit}".rstrip() if isinstance(value, int | float) else str(value)


def _offers(descriptor: Descriptor, values: dict[str, float | str]) -> str:
    """The qualities that a profile offers, in one line."""
    units = {attribute.name: attribute.unit for attribute in descriptor.attributes}
    return ", ".join(f"{name} {_shown(value, units.get(name, ''))}" for name, value in values.items()) or "-"


def _learnt(descriptor: Descriptor, figures: dict[str, dict[str, Any]]) -> str:
    """What a profile has given, in one line: the median, the spread between the quartiles, the number of windows."""
    units = {attribute.name: attribute.unit for attribute in descriptor.attributes}
    return ", ".join(f"{name} {_measured(one, units.get(name, ''))}" for name, one in figures.items()) or "-"


def _measured(one: dict[str, Any] | None, unit: str) -> str:
    return f"{_shown(one['median'], unit)} (spread {one['spread']:.3g}, n {one['n']})" if one else "-"


async def _decision(graph: ResourceGraph, one: SeenResource) -> dict[str, Any]:
    """A resource's account of its last decision.

    Raises:
        RmpaError: There is none, or it is no JSON object.
    """
    (said,) = await graph.texts([one], "decision")
    if not said.get(one):
        raise RmpaError(f"{one} has decided nothing yet; is it active?", code="resource-trouble")
    try:
        return msgspec.json.decode(said[one], type=dict[str, Any])
    except msgspec.DecodeError as error:
        raise RmpaError(f"its decision cannot be read: {error}", code="resource-trouble") from None


@resource_verb()
async def profile_list(graph: ResourceGraph, one: SeenResource, options: Options) -> None:
    """List a RESOURCE's profiles, what they offer, and what they have given.

    ---
    OFFERS is what its author declared. LEARNT is the median of the last windows that were judged while it ran, with
    the spread from the first to the third quartile and the number of windows; it is kept over restarts. With
    adaptation.offers = "learnt" profiles are compared by it once there are ten windows.

    Examples:
      rmpa profile list
      rmpa profile list base:/sonar --json
    """
    decision = await _decision(graph, one)
    said, runs, chosen = one.descriptor, decision.get("profile", ""), decision.get("chosen", "")
    scores = ((str(s.get("profile")), str(s.get("excluded", ""))) for s in decision.get("scores", ()))
    left_out = {name: why for name, why in scores if why}
    learnt: dict[str, Any] = decision.get("learnt", {})
    rows, colours = [], []
    for each in said.profiles:
        why = left_out.get(each.name, "")
        state = ("runs, by hand" if each.name == chosen else "runs") if each.name == runs else ""
        colours.append("green" if state else "yellow" if why else "")
        notes = "; ".join(filter(None, ("best effort" if each.best_effort else "", each.description)))
        state = state or ("left out" if why else "-")
        given = (_learnt(said, learnt.get(each.name, {})),) if learnt else ()
        rows.append((each.name, state, _offers(said, each.offers), *given, f"{each.cost:g}", why or notes))
    about = {**one.named, "profile": runs, "chosen": chosen, "profiles": said.profiles, "left_out": left_out}
    about |= {"learnt": learnt, "by_hand": decision.get("by_hand", {})}
    table = Table(f"PROFILE, STATE, OFFERS, {'LEARNT, ' if learnt else ''}>COST, NOTES", rows, colours)
    options.show(about, table, *_by_hand(one, decision))


def _by_hand(one: SeenResource, decision: dict[str, Any]) -> Iterator[Text]:
    """What people have set at nodes, which profiles leave alone."""
    if by_hand := decision.get("by_hand"):
        values = ", ".join(f"{name} = {value}" for name, value in by_hand.items())
        yield f"by hand: {values}; `rmpa profile set {one} --auto` gives it back"


@resource_verb()
async def profile_get(graph: ResourceGraph, one: SeenResource, options: Options) -> None:
    """Print the profile of a RESOURCE that runs.

    ---

    Examples:
      rmpa profile get /sonar
    """
    decision = await _decision(graph, one)
    present = {key: decision.get(key, "") for key in ("profile", "applying", "chosen")}
    options.show({**one.named, **present}, str(present["profile"]))


def _set_verb(what: str, auto: str) -> Callable[[Callable[..., Any]], click.Command]:
    """A verb that chooses a profile or context by hand, or lets the resource decide again."""

    def offered(ctx: click.Context, _: str) -> Iterable[str]:
        """The profiles or contexts of the resource that stands before them in the line."""

        async def names(graph: ResourceGraph) -> list[str]:
            one = graph.pick(ctx.params.get("resource")).descriptor
            return [each.name for each in (one.profiles if what == "profile" else one.contexts)]

        return run_with_resources(options_of(ctx), names)

    complete = completes(offered, "rmpa.ros.node.node")
    name = click.argument("name", required=False, metavar=f"[{what.upper()}]", shell_complete=complete)
    return graph_verb(argument("resource", resource_names), name, flag("--auto", auto))


def _set(what: str, resource: str, name: str | None, *, auto: bool, options: Options) -> None:
    if (name is None) != auto:
        raise ConfigError(what.upper(), "say which one, or --auto", "one of both")

    async def body(graph: ResourceGraph) -> None:
        one = graph.pick(resource)
        offered: Sequence[Any] = one.descriptor.profiles if what == "profile" else one.descriptor.contexts
        if not offered:
            raise ConfigError("RESOURCE", f"{one} has no {what}s", "")
        names = [each.name for each in offered]
        if name is not None and name not in names:
            remedy = suggestion(name, names, f"there are {printable(', '.join(names))}")
            raise ConfigError(what.upper(), f"there is no {what} {name!r}", remedy)
        await graph.configure(one, {what: name or ""})
        options.show({**one.named, "chosen": name or ""})

    run_with_resources(options, body)


@_set_verb("profile", "Let the resource decide again.")
def profile_set(resource: str, name: str | None, auto: bool, options: Options) -> None:
    """Choose the PROFILE of a RESOURCE by hand; returns when it runs.

    It runs until --auto, whatever clients ask for. If it cannot be applied, the earlier choice stays. Either gives
    parameters of nodes that people have set back to the profiles.

    ---

    Examples:
      rmpa profile set /sonar fine
      rmpa profile set base:/sonar --auto
    """
    _set("profile", resource, name, auto=auto, options=options)


@resource_verb()
async def profile_explain(graph: ResourceGraph, one: SeenResource, options: Options) -> None:
    """Show each term of a RESOURCE's last decision.

    ---
    D is the distance of a profile from what is asked: sqrt(sum(weight * shortfall^2) / sum(weight)) over its terms,
    and a little for its cost. A shortfall of 1 is the tolerance of the attribute, or the range over all profiles. The
    smallest D that falls short of nothing hard is taken. Below are the last ten decisions, the newest last, with
    their reasons, and how long each took from its cause until it was in force.

    Examples:
      rmpa profile explain /sonar
      rmpa profile explain base:/sonar --json
    """
    decision = await _decision(graph, one)
    options.show({**one.named, **decision}, _explained(one, decision))


def _explained(one: SeenResource, decision: dict[str, Any]) -> Iterator[Text]:
    runs, chosen = str(decision.get("profile", "")), str(decision.get("chosen", ""))
    yield f"{one}: profile {runs or 'none'}" + (", chosen by hand" if chosen else "")
    yield f"asked by {', '.join(map(str, decision.get('clients', ()))) or 'no client'}"
    yield from (f"conflict: {conflict}" for conflict in decision.get("conflicts", ()))
    if decision.get("alarm"):
        yield f"alarm: {str(decision['alarm']).replace('_', '-')}"
    if decision.get("reaction") is not None:
        yield f"last reconfiguration took {decision['reaction']:.3g} s"
    yield from _by_hand(one, decision)
    yield ""
    units = {attribute.name: attribute.unit for attribute in one.descriptor.attributes}
    scores = decision.get("scores", ())
    learnt = any(term.get("learnt") for score in scores for term in score.get("terms", ()))
    rows, colours = [], []
    for score in scores:
        name = str(score.get("profile"))
        head = (name, _verdict(score, runs, chosen), f"{score.get('distance', 0.0):.4g}")
        for term in score.get("terms") or [{}]:
            attribute, shortfall = str(term.get("attribute", "-")), term.get("delta")
            wanted = f"{term.get('wanted', '-')}" + (" hard" if term.get("hard") else "")
            unit = units.get(attribute, "")
            given = (_measured(term.get("learnt"), unit),) if learnt else ()
            cells = (attribute, wanted, _shown(term.get("offered"), unit), *given)
            weight = f"{term['weight']:g}" if "weight" in term else "-"
            rows.append((*head, *cells, f"{shortfall:.4g}" if shortfall is not None else "-", weight))
            colours.append("green" if name == runs else "yellow" if score.get("excluded") else "")
            head = ("", "", "")
    titles = f"PROFILE, VERDICT, >D, ATTRIBUTE, WANTED, OFFERED, {'LEARNT, ' if learnt else ''}>SHORTFALL, >WEIGHT"
    yield Table(titles, rows, colours)
    if history := [_decided(each) for each in decision.get("history", ())]:
        yield ""
        yield Table("AT, FROM, TO, >TOOK, WHY", history)


def _decided(one: dict[str, Any]) -> Sequence[str]:
    """One of the last decisions."""
    why = f"{one.get('why', '')}; failed: {one['failed']}" if "failed" in one else str(one.get("why", ""))
    at = time.strftime("%H:%M:%S", time.localtime(one.get("at", 0)))
    return at, str(one.get("from") or "-"), str(one.get("to")), f"{one.get('took', 0):.3f} s", why


def _verdict(score: dict[str, Any], runs: str, chosen: str) -> str:
    if score.get("profile") == runs == chosen:
        return f"runs, by hand, though {score['excluded']}" if score.get("excluded") else "runs, by hand"
    if score.get("excluded"):
        return f"left out: {score['excluded']}"
    if score.get("profile") == runs:
        return "runs" if score.get("feasible") else "runs, best there is"
    return "can serve" if score.get("feasible") else "falls short"


@resource_verb()
async def context_list(graph: ResourceGraph, one: SeenResource, options: Options) -> None:
    """List a RESOURCE's contexts, their rules and what they require.

    ---

    Examples:
      rmpa context list
      rmpa context list base:/sonar --json
    """
    present = await _context(graph, one)
    rows = []
    for each in one.descriptor.contexts:
        now = "by hand" if each.name == present["chosen"] else "yes"
        requires = ", ".join(f"{key} {bound}" for key, bound in each.requires.items()) or "-"
        outputs = ", ".join(each.outputs) or "none" if each.outputs is not None else "all"
        ends = (requires, ", ".join(each.profiles) or "any", outputs)
        rows.append((each.name, now if each.name == present["context"] else "", each.when or "by hand", *ends))
    table = Table("CONTEXT, NOW, WHEN, REQUIRES, PROFILES, OUTPUTS", rows)
    options.show({**one.named, **present, "contexts": one.descriptor.contexts}, table)


async def _context(graph: ResourceGraph, one: SeenResource) -> dict[str, str]:
    """The present context, and the one chosen by hand."""
    if not one.descriptor.contexts:
        return {"context": "", "chosen": ""}
    (said,), values = await asyncio.gather(graph.texts([one], "context"), graph.configuration(one))
    if one not in said:
        raise RmpaError(f"{one} does not say its context; does it run?", code="resource-trouble")
    return {"context": said[one], "chosen": str(values.get("context", ""))}


@resource_verb()
async def context_get(graph: ResourceGraph, one: SeenResource, options: Options) -> None:
    """Print the present context of a RESOURCE; an empty line for none.

    ---

    Examples:
      rmpa context get /sonar
    """
    present = await _context(graph, one)
    options.show({**one.named, **present}, present["context"])


@_set_verb("context", "Let the rules decide again.")
def context_set(resource: str, name: str | None, auto: bool, options: Options) -> None:
    """Choose the CONTEXT of a RESOURCE by hand; returns when it is active.

    ---

    Examples:
      rmpa context set /sonar docked
      rmpa context set base:/sonar --auto
    """
    _set("context", resource, name, auto=auto, options=options)


@resource_verb()
async def resource_info(graph: ResourceGraph, one: SeenResource, options: Options) -> None:
    """Show all of a RESOURCE: topics, parameters, qualities, profiles, contexts, tasks, what it asks, and clients.

    ---

    Examples:
      rmpa resource info /sonar
      rmpa resource info base:/arm --json
    """
    texts, values, quality, responses = await asyncio.gather(
        graph.texts([one], "state", "profile", "context", "decision"),
        graph.configuration(one),
        graph.hear([one], "quality", ARRAY_TYPE),
        graph.hear([one], "responses", ARRAY_TYPE),
    )
    state, profile, context, decision = (said.get(one, "") for said in texts)
    about: dict[str, Any] = {"name": one.path, "peer": one.peer, "node": one.caller}
    about |= {"state": state, "profile": profile, "context": context}
    about |= {"health": next(_statuses(quality.get(one)), None), "parameters": values}
    about |= {"clients": [*_statuses(responses.get(one))]}
    with contextlib.suppress(msgspec.DecodeError):  # it has decided nothing yet
        about["by_hand"] = msgspec.json.decode(decision, type=dict[str, Any]).get("by_hand", {})
    options.show(about | {"descriptor": one.descriptor}, _info(one, about))


def _statuses(message: Any) -> Iterator[dict[str, Any]]:
    """The elements of a ``DiagnosticArray``."""
    for status in message.status if message is not None else ():
        yield {"name": str(status.name), **status_of(status)}


def _info(one: SeenResource, about: dict[str, Any]) -> Iterator[Text]:
    said, health, values = one.descriptor, about["health"], about["parameters"]
    yield f"Resource: {one} ({said.role}, {'device' if said.physical else 'simulated'})"
    if said.description:
        yield f"Description: {said.description}"
    if one.peer is not None:
        whose = "module" if "/" in one.peer else "peer"
        yield f"Node: {said.node} of {whose} {one.peer}, by its proxy {one.caller}"
    yield f"State: {about['state'] or 'does not answer'}"
    yield f"Profile: {about['profile'] or 'none runs'}"
    if said.contexts:
        yield f"Context: {about['context'] or 'none'}"
    if health is None:
        warn(f"{one} has sent no quality while we listened", "resource-trouble")
    else:
        yield f"Health: {health['level']}: {health['message']}"
    tables: dict[str, Iterable[Sequence[str]]] = {
        "OUTPUT, TYPE, CONTRACT": ((t.topic, t.type, _terms(t.contract)) for t in said.outputs),
        "INPUT, TYPE, CONTRACT": ((t.topic, t.type, _terms(t.contract)) for t in said.inputs),
        "NODE, NAME, HOW": ((n.key, n.name, n.how) for n in said.nodes),
        "PARAMETER, VALUE, RANGE, DESCRIPTION": (_parameter(p, values, about) for p in said.parameters),
        "QUALITY, NOW, BETTER, CLASS": _qualities(said, health["values"] if health else {}),
        "PROFILE, COST, OFFERS, DESCRIPTION": (
            (p.name, f"{p.cost:g}", _offers(said, p.offers), p.description) for p in said.profiles
        ),
        "CONTEXT, WHEN": ((c.name, c.when or "by hand") for c in said.contexts),
        "TASK, RUNS": ((t.name, _runs(t, values)) for t in said.tasks),
        "ASKS OF, FOR, PRIORITY": (
            (a.resource, _pairs(a.wishes) or "nothing at present", str(a.priority)) for a in said.asks
        ),
        "CLIENT, IS TOLD, ASKS": (
            (c["name"], f"{c['level']}: {c['message']}", _pairs(c["values"]) or "-") for c in about["clients"]
        ),
    }
    for titles, rows in tables.items():
        if made := list(rows):
            yield ""
            yield Table(titles, made)


def _pairs(values: dict[str, str]) -> str:
    return "; ".join(f"{key} {value}" for key, value in values.items())


def _runs(task: TaskDescriptor, values: dict[str, Any]) -> str:
    """The rate at which a task runs, or the topic that starts it."""
    if task.follows in values:
        return f"{values[task.follows]:g} Hz (parameter {task.follows})"
    return f"{task.rate:g} Hz" if task.rate else f"on {task.on}"


def _parameter(one: ParameterDescriptor, values: dict[str, Any], about: dict[str, Any]) -> Sequence[str]:
    low, high = ("" if bound is None else f"{bound:g}" for bound in (one.low, one.high))
    within = " | ".join(map(str, one.choices)) or (f"{low} .. {high}" if low or high else one.type)
    value = values.get(one.name, one.default)
    text = str(value).lower() if isinstance(value, bool) else _shown(value, one.unit)
    by_hand = " by hand" if one.name in about.get("by_hand", {}) else ""
    where = f"{one.description} [{one.binding}]".lstrip() if one.binding else one.description
    return one.name, text + by_hand, within, where


def _qualities(said: Descriptor, values: dict[str, str]) -> Iterator[Sequence[str]]:
    """The declared attributes, and the general ones that are measured."""
    for each in said.attributes:
        if each.name in values or each.name.rpartition(".")[2] not in MEASURED:
            yield each.name, values.get(each.name, "not measured"), each.better, each.category


def _terms(contract: dict[str, str | int | float | None]) -> str:
    """The terms of a contract; times are in seconds."""
    timed = {key for key, value in contract.items() if isinstance(value, float) and key in _TIMES}
    return ", ".join(f"{k} {v:g} s" if k in timed else f"{k} {v}" for k, v in contract.items()) or "-"
