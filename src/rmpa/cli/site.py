"""``rmpa site list|info``: other sites that gateways join."""

from __future__ import annotations

import contextlib
import os
from typing import TYPE_CHECKING, Final, TypeVar

import click
import msgspec

from rmpa.cli.options import agent_option, json_option
from rmpa.cli.output import Column, duration, print_json, print_line, print_table, printable, warn
from rmpa.config.values import did_you_mean
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError
from rmpa.observe import limits
from rmpa.observe.control import GATEWAY_REPORT
from rmpa.observe.control_client import ControlClient, choose_agent
from rmpa.observe.operations import INFO, REPORT
from rmpa.observe.peer_info import SitesReport

if TYPE_CHECKING:
    from rmpa.observe.peer_info import SiteInfo

_T = TypeVar("_T")
_COLOURS: Final = {"this site": "green", "joined": "green", "no gateway": "yellow", "unreachable": "red"}
_COLUMNS: Final = (
    *map(Column, ("SITE", "STATE")),
    *(Column(title, right=True) for title in ("SINCE", "GATEWAYS", "MODULES", "SOURCES", "SHOWN")),
    Column("BY"),
)
_MODULES: Final = (Column("  MODULE"), *(Column(title, right=True) for title in ("TOPICS", "SERVICES", "SHOWN")))
_SOURCES: Final = tuple(map(Column, ("  NAME", "KIND", "TYPE", "MODULE", "NODE", "HERE")))

name_option = click.option("--name", metavar="GATEWAY", help="Ask this gateway of this machine, not --agent's.")


def _connect(agent: str | None, name: str | None) -> ControlClient:
    return ControlClient(choose_agent(os.environ, name or agent).path, timeout=limits.CONTROL_HANDLER_TIMEOUT)


def _ask(client: ControlClient, what: str, kind: type[_T], **args: object) -> _T:
    try:
        value: object = client.call("site", object, what=what, args=args)
    except PeerRefused as error:
        raise RmpaError(error.reason) from None  # the agent only passes on what a gateway says
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(f"the gateway answers in another way: {error}; is it another version?") from None


@click.command(
    "list",
    epilog="""\
\b
Exit codes: 0 each site is joined; 1 one is not, or no gateway answers.

\b
Examples:
  rmpa site list
  rmpa site list --name store-gateway
  rmpa site list --json | jq -r '.[].sites[].name'
""",
)
@json_option
@agent_option
@name_option
def list_(as_json: bool, agent: str | None, name: str | None) -> int:
    """List this site and the others that its gateways join.

    SOURCES are the topics (one for each publisher) and services that a site offers, SHOWN those that are in the
    graph here. BY is the gateway that was asked; one that stands by shows nothing.
    """
    with _connect(agent, name) as client:
        reports = _ask(client, REPORT, tuple[SitesReport, ...])
        absent = "" if reports else _why_none(client)
    if not reports:
        warn(absent)
    if as_json:
        print_json(reports)
    elif reports:
        rows = [(report, site) for report in reports for site in report.sites]
        print_table(
            _COLUMNS,
            [_row(report, site) for report, site in rows],
            colours=[_COLOURS.get(s.state, "") for _, s in rows],
        )
        for report in reports:
            if report.problem:
                warn(f"{report.gateway}: {report.problem}")
            if not any(site.state != "this site" for site in report.sites):
                warn(f"{report.gateway} of site {report.site} knows no other site{_where(report)}")
    well = all(s.state in ("this site", "joined") for report in reports for s in report.sites)
    return 0 if reports and well and not any(report.problem for report in reports) else 1


def _why_none(client: ControlClient) -> str:
    """Why no gateway answers: this agent is a gateway whose session is not open, or it knows none."""
    with contextlib.suppress(RmpaError):  # no gateway: it has no such operation
        problem = str(client.call(GATEWAY_REPORT, dict[str, object]).get("problem", ""))
        return f"{client.name} joins no site: {problem or 'it is a gateway without --site'}"
    start = "start one with `rmpa gateway --site NAME`; in a secured mesh `relays` of [trust] names it"
    return f"{client.name} is no gateway, and is linked to none: {start}"


def _where(report: SitesReport) -> str:
    if report.endpoints:
        return f": it is connected to {', '.join(report.endpoints)}, where no other gateway is"
    return ": it is connected to nothing; is the router of gateway.connect there?"


def _row(report: SitesReport, site: SiteInfo) -> list[str]:
    sources = sum(module.topics + module.services for module in site.modules)
    shown = sum(module.shown for module in site.modules)
    return [
        site.name,
        site.state,
        duration(site.since_ago),
        str(site.gateways),
        str(len({module.name for module in site.modules})),
        str(sources),
        str(shown),
        report.gateway + ("" if report.leads else " (stands by)"),
    ]


@click.command(
    epilog="""\
\b
Exit codes: 0 the site is joined, or this one; 1 it is not there, or not known.

\b
Examples:
  rmpa site info warehouse
  rmpa site info warehouse --json | jq '.sites[0].sources[] | select(.here == "")'
"""
)
@click.argument("site")
@json_option
@agent_option
@name_option
def info(site: str, as_json: bool, agent: str | None, name: str | None) -> int:
    """Show the modules of SITE, what they offer, its name here, and why something does not cross."""
    with _connect(agent, name) as client:
        report = _ask(client, INFO, SitesReport, site=site)
    found = next((each for each in report.sites if each.name == site), None)
    if found is None:
        raise RmpaError(_unknown(report, site))
    if as_json:
        print_json(report)
    else:
        _show(report, found)
    return 0 if found.state in ("this site", "joined") else 1


def _unknown(report: SitesReport, site: str) -> str:
    known = [each.name for each in report.sites]
    near = did_you_mean(site, known)
    return f"{report.gateway} knows no site {printable(site)!r}; " + (
        f"did you mean {near}?" if near else f"known are {', '.join(known)}"
    )


def _show(report: SitesReport, site: SiteInfo) -> None:
    since = f" for {duration(site.since_ago)}" if site.since_ago is not None else ""
    facts = [
        ("Site", site.name),
        ("State", site.state + since),
        ("Gateways", str(site.gateways)),
        ("Seen by", f"{report.gateway} of site {report.site}" + ("" if report.leads else ", which stands by")),
        ("Connected", ", ".join(report.endpoints) or "to nothing"),
    ]
    if site.not_shown:
        facts.append(("Kept out", f"{site.not_shown} topics and services, by rules or for their names"))
    if site.beyond:
        facts.append(("Limit", f"{site.beyond} topics and services were left out: the site has too many"))
    for label, text in facts:
        print_line(f"{label + ':':<10} {text}")
    if site.modules:
        click.echo("\nModules:")
        rows = [[f"  {m.name}", str(m.topics), str(m.services), str(m.shown)] for m in site.modules]
        print_table(_MODULES, rows)
    if site.sources:
        click.echo("\nTopics and services:")
        print_table(
            _SOURCES, [[f"  {s.name}", s.kind, s.type, s.module, s.node, s.here or "-"] for s in site.sources]
        )
    for source in site.sources:
        if source.problem:
            warn(f"{source.name} of {source.module}: {source.problem}")
