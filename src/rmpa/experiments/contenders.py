"""Who is measured beside whom, and in which order: classic ROS at its best, as it comes, and RMPA."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.experiments.bed.system import Kind
    from rmpa.experiments.model import Cell, Value


@dataclass(frozen=True, slots=True)
class Contender:
    """One way to run the same nodes.

    Args:
        label: Its name in tables and legends.
        system: Which system.
        nodelay: Whether subscribers ask for tcp_nodelay.
    """

    label: str
    system: Kind
    nodelay: bool = True

    @property
    def settings(self) -> dict[str, Value]:
        """Those that tell it from the others in a cell.

        ``nodelay`` is one of classic ROS: an agent sends at once whatever its subscribers ask for.
        """
        if self.system == "rmpa":
            return {"system": self.system}
        return {"system": self.system, "nodelay": self.nodelay}


CLASSIC: Final = Contender("classic", "classic")
"""With tcp_nodelay: its best setting, and what RMPA is held against."""
DEFAULTS: Final = Contender("classic, nodelay off", "classic", nodelay=False)
"""As it comes."""
RMPA: Final = Contender("RMPA", "rmpa")


def turn(order: Sequence[Contender], number: int) -> list[Contender]:
    """The order of one round: another one begins each, so that nobody is always behind the same neighbour."""
    first = number % len(order)
    return [*order[first:], *order[:first]]


def system_of(cell: Cell) -> Kind:
    """The kind of system that a cell asks for."""
    return "rmpa" if cell.settings["system"] == "rmpa" else "classic"


def nodelay_of(cell: Cell) -> bool:
    """Whether its subscribers ask for tcp_nodelay: the same nodes as classic's best, with RMPA."""
    return cell.settings.get("nodelay", True) is True
