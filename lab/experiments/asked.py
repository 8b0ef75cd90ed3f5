"""From the command line's options to the plan of a run and its cells."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from lab.bed.plan import Plan
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, StartError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from lab.bed.plan import Client, Size
    from lab.experiments.model import Cell

    WhyNot = Callable[[Plan], str]
    """Says why a plan cannot be followed here, or an empty string."""

Bed = Literal["auto", "namespaces", "loopback"]
_RATE: Final = re.compile(r"[1-9]\d*(\.\d+)?[kmg]?bit")
_ROS: Final[tuple[Client, ...]] = ("rospy", "roscpp")
_OWN: Final[tuple[Client, ...]] = ("own",)


@dataclass(frozen=True, slots=True)
class Asked:
    """What the command line says; ``None`` and empty: nothing.

    Args:
        size: Short or full.
        bed: Where.
        clients: Whose nodes.
        link: What a cable carries, or ``none``.
        seed: Of chance.
    """

    size: Size | None = None
    bed: Bed = "auto"
    clients: tuple[Client, ...] = ()
    link: str | None = None
    seed: int | None = None


def choose(asked: Asked, why_not: WhyNot, before: Plan | None = None) -> tuple[Plan, str]:
    """Decide on a plan.

    Args:
        asked: The options.
        why_not: Tells what is missing here.
        before: The plan of the run that is to go on; what was not asked is as it was then.

    Returns:
        The plan, and what should be said about it.

    Raises:
        ConfigError: It is a contradiction.
        StartError: It cannot be done here.
    """
    _check(asked)
    bed = before.bed if before is not None and asked.bed == "auto" else asked.bed
    if bed != "auto":
        plan = _plan(asked, bed, before)
        _demand(plan, why_not)
        return plan, ""
    hosts = _plan(asked, "namespaces", None)
    if not (why := why_not(hosts)):
        return hosts, ""
    if hosts.link and asked.link:
        raise StartError("hosts as network namespaces", why)
    plan = _plan(asked, "loopback", None)
    _demand(plan, why_not)
    return plan, f"{why}: all on loopback, with {'our own nodes and' if plan.clients == _OWN else 'our own'} core"


def select(cells: Sequence[Cell], only: Mapping[str, Sequence[str]]) -> list[Cell]:
    """The cells that have each of these settings with one of its values.

    Args:
        cells: To choose from.
        only: Values as texts by the setting's name; empty for all cells.
    """
    return [
        cell
        for cell in cells
        if all(name in cell.settings and str(cell.settings[name]) in values for name, values in only.items())
    ]


def parse_only(texts: Sequence[str], cells: Sequence[Cell]) -> dict[str, list[str]]:
    """Read ``SETTING=VALUE`` texts.

    Args:
        texts: As they were written.
        cells: That there are.

    Raises:
        ConfigError: One is written otherwise, or no cell has such a setting or value.
    """
    known: dict[str, list[str]] = {}
    for cell in cells:
        for name, value in cell.settings.items():
            values = known.setdefault(name, [])
            if (text := str(value)) not in values:
                values.append(text)
    only: dict[str, list[str]] = {}
    for text in texts:
        name, mark, value = (part.strip() for part in text.partition("="))
        if not mark:
            raise ConfigError("--only", f"{text!r} is not SETTING=VALUE", "for example system=rmpa")
        if name not in known:
            near = did_you_mean(name, known)
            raise ConfigError(
                "--only",
                f"no cell has a setting {name!r}",
                f"did you mean {near}?" if near else f"there are {', '.join(known)}",
            )
        if value.lower() not in (each.lower() for each in known[name]):
            raise ConfigError("--only", f"no cell has {name}={value}", f"{name} is {', '.join(known[name])}")
        only.setdefault(name, []).extend(each for each in known[name] if each.lower() == value.lower())
    return only


def _check(asked: Asked) -> None:
    if asked.link not in (None, "none") and not _RATE.fullmatch(asked.link or ""):
        raise ConfigError("--link", f"{asked.link!r} is no rate", "write it as tc does (100mbit), or none")
    if asked.bed == "loopback" and asked.link not in (None, "none"):
        raise ConfigError("--link", "loopback has no cables to shape", "leave it out, or take --bed namespaces")
    if len(set(asked.clients)) != len(asked.clients):
        raise ConfigError("--client", "one was given twice")


def _plan(asked: Asked, bed: Literal["namespaces", "loopback"], before: Plan | None) -> Plan:
    same = before if before is not None and before.bed == bed else None
    default = Plan()
    hosts = bed == "namespaces"
    if asked.link is not None:
        link = "" if asked.link == "none" else asked.link
    else:
        link = same.link if same else default.link if hosts else ""
    return Plan(
        size=asked.size or (before or default).size,
        bed=bed,
        clients=asked.clients or (same.clients if same else _ROS if hosts else _OWN),
        link=link,
        seed=asked.seed if asked.seed is not None else (before or default).seed,
    )


def _demand(plan: Plan, why_not: WhyNot) -> None:
    if why := why_not(plan):
        what = "hosts as network namespaces" if plan.bed == "namespaces" else "everything on loopback"
        raise StartError(what, why)
