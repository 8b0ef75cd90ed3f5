"""``rmpa why`` through gateways: what the gateways of two sites tell each other, and the stages at one of them.

The importing gateway asks the exporting one (``get`` on ``rmpa/1/<site>/-gateway/why``), whose stages it shows as
they are told, between those of the site and its own::

    site ─ source there ─ rule there ─ demand there ─ sent ─ rule here ─ shown ─ header (md5) ─ demand here ─ arrived

Without I/O.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import is_global_name
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.keys import GATEWAY, ROOT
from rmpa.observe.check import FAIL, OK, WARN, Check
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.ros.wire.tcpros import printable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.ros.wire.tcpros import Buffer

_T = TypeVar("_T")
DEMAND_THERE: Final = "demand there"
"""The stage of the other sites' subscribers, as the exporting gateway hears of them."""
NO_DEMAND: Final = "that is no fault; to try it: rmpa topic echo"
ROUTER: Final = "allow it by [[permission]] of the router, for the names of both gateways (zenohd: access_control)"
_RULES: Final = "change [[gateway.rule]] in the rmpa.toml of the gateway of {}, and run rmpa reload there"
_PERMISSIONS: Final = (
    "change [[permission]] in the rmpa.toml of the gateway of {} and of its modules, and reload them"
)


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
        found = _parse(data, cls, limits.KEY_MAX)
        if not is_global_name(found.name):
            raise RemoteProtocolError(f"{found.name[:80]!r} is not a topic, nor a service")
        return found


def parse_ways(data: Buffer) -> tuple[Diagnosis, ...]:
    """The answer of the leading gateway of a site, its texts without control characters: ways out of that site.

    Raises:
        RemoteProtocolError: It is none.
    """
    ways = _parse(data, tuple[Diagnosis, ...], limits.SITE_WHY_MAX)
    return tuple(msgspec.structs.replace(way, stages=tuple(map(_printable, way.stages))) for way in ways)


def _parse(data: Buffer, kind: type[_T], most: int) -> _T:
    if len(data) > most:
        raise RemoteProtocolError(f"a text of rmpa why has {len(data)} bytes, more than {most}")
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RemoteProtocolError(f"not a text of rmpa why: {printable(str(error))}") from None


def _printable(stage: Check) -> Check:
    return Check(printable(stage.name), stage.level, printable(stage.text), printable(stage.remedy))


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


def sent_stages(site: str, report: Mapping[str, Any], *, asked: bool) -> list[Check]:
    """The stages of a topic behind its rule at the exporting gateway.

    Args:
        site: Its site.
        report: What its part reports.
        asked: Whether another site asks, which knows whether it subscribes; else it is a fault that none does.
    """
    if not report.get("wanted"):
        text = f"no other site subscribes, as the gateway of {site} hears: nothing is sent"
        return [Check(DEMAND_THERE, WARN if asked else FAIL, text, NO_DEMAND)]
    losses = {
        "dropped": "were dropped by its queue, for the way is slower than the topic",
        "limited": "were left out by rate or size of the rule",
    }
    lost = [f"{report[key]} {words}" for key, words in losses.items() if report.get(key)]
    text = f"the gateway of {site} has sent {report.get('messages', 0)} messages"
    if waiting := report.get("waiting"):
        text += f", {waiting} wait"
    remedy = "rate and size of a [[gateway.rule]] say what may be left out; a contract says what goes first"
    sent = Check("sent", OK if report.get("messages") else WARN, text)
    if lost:
        sent = Check("sent", WARN, f"{text}; {', '.join(lost)}", remedy)
    return [Check(DEMAND_THERE, OK, "another site subscribes"), sent]


def here_stages(own: str, found: SourceHere) -> list[Check]:
    """The stages of the importing site, whose name is ``own``."""
    if found.refused:
        return [refused_stage("here", found.refused, own)]
    was = f" (its {found.name})" if found.here != found.name else ""
    shown = f"it is {found.here} here{was}, at /rmpa/{found.site}/{found.module}{found.node}"
    stages = [Check("rule here", OK, found.rule or "it may come in"), Check("shown", OK, shown)]
    report = found.report or {}
    if problem := report.get("problem"):
        name = "md5" if "md5" in str(problem) else "header" if found.kind is SourceKind.TOPIC else "calls"
        level = FAIL if found.kind is SourceKind.TOPIC else WARN
        return [*stages, Check(name, level, str(problem), ROUTER if name == "header" else "")]
    if found.kind is SourceKind.SERVICE:
        calls, failed = int(report.get("calls", 0)), int(report.get("failed", 0))
        return [*stages, Check("calls", OK, f"{calls} calls from here, {failed} failed")]
    if not report.get("wanted"):
        text = "no node of this site subscribes: it crosses once one does"
        return [*stages, Check("demand here", FAIL, text, NO_DEMAND)]
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
