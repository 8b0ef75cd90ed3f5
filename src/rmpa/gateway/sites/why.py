"""``rmpa why`` through gateways: the stages of the way of a topic or a service between two sites. Without I/O.

The importing gateway asks the exporting one (``get`` on ``rmpa/1/<site>/-gateway/why``), and judges both halves::

    site ─ source there ─ rule there ─ demand there ─ sent ─ rule here ─ shown ─ header (md5) ─ demand here ─ arrived
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.names import is_global_name
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.keys import GATEWAY, ROOT
from rmpa.observe.check import FAIL, OK, UNKNOWN, WARN, Check, CheckLevel

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.ros.wire.tcpros import Buffer

_RULES: Final = "change [[gateway.rule]] in the rmpa.toml of the gateway of {}, and run rmpa reload there"
_PERMISSIONS: Final = (
    "change [[permission]] in the rmpa.toml of the gateway of {} and of its modules, and reload them"
)
_ROUTER: Final = "allow it by [[permission]] of the router, for the names of both gateways (zenohd: access_control)"
_NO_DEMAND: Final = "that is no fault; to try it: rmpa topic echo"


class WhyQuestion(msgspec.Struct, kw_only=True, frozen=True):
    """What one gateway asks another.

    Attributes:
        site: The site that asks.
        name: A topic or service, by its name in its module.
        module: Of this module alone; empty for all.
        service: Whether a service is meant.
    """

    site: str
    name: str
    module: str = ""
    service: bool = False

    @classmethod
    def parse(cls, data: Buffer) -> WhyQuestion:
        """Read one.

        Raises:
            RemoteProtocolError: It is none.
        """
        if len(data) > limits.KEY_MAX:
            raise RemoteProtocolError(f"a question of rmpa why has {len(data)} bytes")
        try:
            found = msgspec.json.decode(data, type=cls)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise RemoteProtocolError(f"not a question of rmpa why: {error}") from None
        if not is_global_name(found.name):
            raise RemoteProtocolError(f"{found.name[:80]!r} is not a topic, nor a service")
        return found


class SourceThere(msgspec.Struct, kw_only=True, frozen=True):
    """What an exporting gateway knows of one topic or service.

    Attributes:
        kind: ``t`` or ``s``.
        module: The module.
        node: Its node there; empty where permissions deny the name, whether or not it is there.
        type: ``package/Name``.
        rule: The rule that lets it cross to the site that asks.
        refused: Why it may not cross to the site that asks; empty if it may.
        wanted: Whether another site subscribes.
        messages: That were sent to other sites; calls, for a service.
        waiting: In the queue to Zenoh.
        dropped: By that queue; calls that failed, for a service.
        limited: Left out for the rate or size of the rule.
        problem: Why it does not work there; empty for nothing.
    """

    kind: str
    module: str
    node: str
    type: str = "*"
    rule: str = ""
    refused: str = ""
    wanted: bool = False
    messages: int = 0
    waiting: int = 0
    dropped: int = 0
    limited: int = 0
    problem: str = ""


class WhyAnswer(msgspec.Struct, kw_only=True, frozen=True):
    """The answer of the leading gateway of a site.

    Attributes:
        sources: All that have the name.
        modules: The modules of the site.
    """

    sources: tuple[SourceThere, ...] = ()
    modules: tuple[str, ...] = ()

    @classmethod
    def parse(cls, data: Buffer) -> WhyAnswer:
        """Read one.

        Raises:
            RemoteProtocolError: It is none.
        """
        if len(data) > limits.SITE_WHY_MAX:
            raise RemoteProtocolError(f"an answer of rmpa why has {len(data)} bytes")
        try:
            return msgspec.json.decode(data, type=cls)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise RemoteProtocolError(f"not an answer of rmpa why: {error}") from None


def why_key(site: str) -> str:
    """The key at which the gateways of a site answer."""
    return f"{ROOT}/{site}/{GATEWAY}/why"


@dataclass(frozen=True, slots=True)
class SourceHere:
    """What the importing gateway knows of one topic or service of another site.

    Args:
        kind: What it is.
        site: Its site.
        module: Its module.
        node: Its node there.
        name: Its name there.
        here: Its name here; empty if it is not shown.
        refused: Why it is not shown; empty if it is.
        rule: The rule that lets it come in.
        report: What its part reports; empty if it was never used.
    """

    kind: SourceKind
    site: str
    module: str
    node: str
    name: str
    here: str = ""
    refused: str = ""
    rule: str = ""
    report: Mapping[str, Any] | None = None


def site_stage(site: str, gateways: int, away: float | None, *, known: bool) -> Check:
    """The stage of the site itself.

    Args:
        site: Its name.
        gateways: How many gateways lead it or stand by.
        away: Seconds since it left; ``None`` if it did not, or was never there.
        known: Whether anything of it is there.
    """
    if not known and away is not None:
        text = f"site {site} is unreachable since {away:.0f} s"
        return Check("site", FAIL, text, "is its gateway on, and its way to the router? `rmpa site list` there")
    if not known:
        text = f"no gateway of a site {site} is at the routers that this site's gateway reaches"
        return Check("site", FAIL, text, "`rmpa site list` shows the sites; gateway.connect of both must meet")
    if not gateways:
        text = f"there is no gateway at site {site} any more, and what it announced is about to go"
        return Check("site", FAIL, text, f"start `rmpa gateway --site {site}` there")
    return Check("site", OK, f"site {site} is joined by {gateways} gateway{'s' if gateways > 1 else ''}")


def there_stages(
    site: str, module: str, name: str, found: SourceThere | None, refusal: str, *, wanted_here: bool = False
) -> list[Check]:
    """The stages of the exporting site.

    Args:
        site: That site.
        module: The module; empty if none is meant.
        name: The topic or service there.
        found: What its gateway answered; ``None``: it has none of that name, or did not answer.
        refusal: Why it did not answer; empty if it did.
        wanted_here: Whether a node of the site that asks subscribes.
    """
    whose = f"{module} at {site}" if module else f"a module at {site}"
    if refusal:
        return [Check("source there", UNKNOWN, f"the gateway of {site} does not tell: {refusal}")]
    if found is None:
        text = f"no node of {whose} has {name}, as the gateway there sees it"
        remedy = f"start it there; or the [bridge] or [services] of {whose} keeps it at home: `rmpa why {name}` there"
        return [Check("source there", FAIL, text, remedy)]
    # Of what its permissions deny a gateway does not tell whether it is there.
    told = [Check("source there", OK, f"{found.node} of {found.module} at {site} has it: {found.type}")]
    stages = told if found.node else []
    if found.refused:
        return [*stages, refused_stage("there", found.refused, site)]
    stages.append(Check("rule there", OK, found.rule or "it may go out"))
    if found.problem:
        return [*stages, Check("publisher there", FAIL, found.problem, f"`rmpa why {name}` at {site}")]
    if found.kind == SourceKind.SERVICE.value:
        return stages
    if wanted_here and not found.wanted:
        text = f"a node here subscribes, and the gateway of {site} hears of none: a router between them keeps it back"
        return [*stages, Check("router", FAIL, text, _ROUTER)]
    return [*stages, *sent_stages(site, found)]


def sent_stages(site: str, found: SourceThere, no_demand: CheckLevel = WARN) -> list[Check]:
    """The stages of a topic behind its rule at the exporting gateway.

    Args:
        site: Its site.
        found: What it knows.
        no_demand: What it means that no other site subscribes: by itself nothing, if the reason is at the other site.
    """
    if not found.wanted:
        text = f"no other site subscribes, as the gateway of {site} hears: nothing is sent"
        return [Check("demand there", no_demand, text, _NO_DEMAND)]
    stages = [Check("demand there", OK, "another site subscribes")]
    lost = []
    if found.dropped:
        lost.append(f"{found.dropped} were dropped by its queue, for the way is slower than the topic")
    if found.limited:
        lost.append(f"{found.limited} were left out by rate or size of the rule")
    sent = f"the gateway of {site} has sent {found.messages} messages"
    waiting = f", {found.waiting} wait" if found.waiting else ""
    if lost:
        remedy = "rate and size of a [[gateway.rule]] say what may be left out; a contract says what goes first"
        return [*stages, Check("sent", WARN, f"{sent}{waiting}; {', '.join(lost)}", remedy)]
    return [*stages, Check("sent", OK if found.messages else WARN, sent + waiting)]


def here_stages(own: str, found: SourceHere) -> list[Check]:
    """The stages of the importing site, whose name is ``own``."""
    if found.refused:
        return [refused_stage("here", found.refused, own)]
    stages = [Check("rule here", OK, found.rule or "it may come in")]
    was = f" (its {found.name})" if found.here != found.name else ""
    stages.append(
        Check("shown", OK, f"it is {found.here} here{was}, at /rmpa/{found.site}/{found.module}{found.node}")
    )
    report = found.report or {}
    if problem := report.get("problem"):
        name = "md5" if "md5" in str(problem) else "header" if found.kind is SourceKind.TOPIC else "calls"
        level = FAIL if found.kind is SourceKind.TOPIC else WARN
        remedy = _ROUTER if name == "header" else ""
        return [*stages, Check(name, level, str(problem), remedy)]
    if found.kind is SourceKind.SERVICE:
        calls, failed = int(report.get("calls", 0)), int(report.get("failed", 0))
        return [*stages, Check("calls", OK, f"{calls} calls from here, {failed} failed")]
    if not report.get("wanted"):
        text = "no node of this site subscribes: it crosses once one does"
        return [*stages, Check("demand here", FAIL, text, _NO_DEMAND)]
    return [*stages, Check("demand here", OK, "a node of this site subscribes"), _arrived(report)]


def refused_stage(where: str, refused: str, site: str) -> Check:
    """The stage of a source that may not cross.

    Args:
        where: ``here`` or ``there``.
        refused: The rule or permission that decided, as text.
        site: The site whose gateway has refused it.
    """
    if "[[permission]]" in refused or refused.startswith("the permissions"):
        return Check(f"permission {where}", FAIL, refused, _PERMISSIONS.format(site))
    return Check(f"rule {where}", FAIL, refused, _RULES.format(site))


def _arrived(report: Mapping[str, Any]) -> Check:
    messages, rate = int(report.get("messages", 0)), float(report.get("rate", 0.0))
    if not messages:
        return Check("arrived", WARN, "no message has come since then", "does its publisher publish?")
    text = f"{messages} messages have come, {rate:.1f} Hz"
    losses = {
        "lost": "were lost between the gateways",
        "mismatched": "have another md5 sum than their header",
        "dropped": "were dropped here for slow subscribers",
    }
    lost = [f"{report[key]} {words}" for key, words in losses.items() if report.get(key)]
    return Check("arrived", WARN if lost else OK, "; ".join((text, *lost)))
