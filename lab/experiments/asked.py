"""From the command line's options to the plan of a run and its cells."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from lab.bed.plan import Client, Plan, Size
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from lab.experiments.model import Cell


_RATE: Final = re.compile(r"[1-9]\d*(\.\d+)?[kmg]?bit")


def choose(
    size: Size | None, clients: tuple[Client, ...], link: str | None, seed: int | None, before: Plan | None = None
) -> Plan:
    """Decide on a plan; ``None`` and empty: not asked for.

    Args:
        size: Short or full.
        clients: Whose nodes.
        link: What a cable carries, or ``none``.
        seed: Of chance.
        before: The plan of the run that is to go on; what was not asked is as it was then.

    Raises:
        ConfigError: It is a contradiction.
    """
    if link not in (None, "none") and not _RATE.fullmatch(link or ""):
        raise ConfigError("--link", f"{link!r} is no rate", "write it as tc does (100mbit), or none")
    if len(set(clients)) != len(clients):
        raise ConfigError("--client", "one was given twice")
    was = before or Plan()
    return Plan(
        size=size or was.size,
        clients=clients or was.clients,
        link=was.link if link is None else "" if link == "none" else link,
        seed=was.seed if seed is None else seed,
    )


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
