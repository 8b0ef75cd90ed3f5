"""Files that programs keep: replaced as a whole, and set aside where this release cannot read them."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from pathlib import Path

_KEPT: Final = 9


def replace_file(path: Path, content: bytes) -> None:
    """Replace a file, so that a crash at any moment leaves the old one or the new one; readable by its owner alone.

    Raises:
        OSError: It cannot be written.
    """
    new = path.with_name(f"{path.name}.new")
    with open(new, "wb", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)


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
