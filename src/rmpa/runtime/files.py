"""Files that this release cannot read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from pathlib import Path

_KEPT: Final = 9


def set_aside(path: Path, what: str) -> Path:
    """Rename a file to NAME.WHAT, or to the first free one of NAME.WHAT-2 to -9; only the last is ever replaced.

    The first one may be the only copy of parameters set by hand.

    Args:
        path: The file.
        what: The ending.

    Returns:
        The new path.

    Raises:
        OSError: It cannot be renamed.
    """
    names = [f"{path.name}.{what}", *(f"{path.name}.{what}-{number}" for number in range(2, _KEPT + 1))]
    free = [aside for name in names if not (aside := path.with_name(name)).exists()]
    return path.replace(free[0] if free else path.with_name(names[-1]))
