"""The systems that are compared, and their order in a round: classic ROS at its best, as it comes, and RMPA."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from lab.bed.plan import Kind
    from lab.experiments.model import Cell, Measured, Results, Value


@dataclass(frozen=True, slots=True)
class Contender:
    """One way to run the same nodes.

    Args:
        label: Its name in tables and legends.
        system: Which system.
        nodelay: Whether subscribers ask for tcp_nodelay.
        relays: How many relays in C++ a message passes on its way.
    """

    label: str
    system: Kind
    nodelay: bool = True
    relays: int = 0

    @property
    def settings(self) -> dict[str, Value]:
        """Those that tell it from the others in a cell.

        ``nodelay`` is one of classic ROS: an agent sends at once whatever its subscribers ask for.
        """
        if self.system == "rmpa":
            return {"system": self.system}
        relayed: dict[str, Value] = {"relays": self.relays} if self.relays else {}
        return {"system": self.system, "nodelay": self.nodelay, **relayed}

    def select(self, results: Results, **settings: Value) -> Iterator[tuple[Cell, Measured]]:
        """The cells of this one, and of no other, that have these settings."""
        for cell, measured in results.select(**self.settings, **settings):
            if relays_of(cell) == self.relays:
                yield cell, measured


CLASSIC: Final = Contender("classic", "classic")
"""With tcp_nodelay: its best setting, and what RMPA is held against."""
DEFAULTS: Final = Contender("classic, nodelay off", "classic", nodelay=False)
"""As it comes."""
RELAYS: Final = Contender("classic, two relays", "classic", relays=2)
"""With as many processes between as RMPA has: a relay in C++ on either host, also with tcp_nodelay."""
RMPA: Final = Contender("RMPA", "rmpa")


def turn(order: Sequence[Contender], number: int) -> list[Contender]:
    """The order of one round; each round starts with another system, so that none always follows the same one."""
    first = number % len(order)
    return [*order[first:], *order[:first]]


def system_of(cell: Cell) -> Kind:
    """The kind of system that a cell asks for."""
    return "rmpa" if cell.settings["system"] == "rmpa" else "classic"


def relays_of(cell: Cell) -> int:
    """How many relays its messages pass."""
    relays = cell.settings.get("relays", 0)
    return relays if isinstance(relays, int) else 0


def nodelay_of(cell: Cell) -> bool:
    """Whether its subscribers ask for tcp_nodelay: the same nodes as classic's best, with RMPA."""
    return cell.settings.get("nodelay", True) is True
