"""The directory of files that survive a program's end."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping


def state_dir(environ: Mapping[str, str], setting: str | None = None) -> Path | None:
    """The directory of all files that survive a run; it need not exist yet.

    The first of: the setting, RMPA_STATE_DIR, STATE_DIRECTORY (systemd's, for a unit with ``StateDirectory=``),
    ``rmpa`` below XDG_STATE_HOME, ``~/.local/state/rmpa``.

    Returns:
        ``None`` if none of these is set and the user has no home directory.
    """
    if setting or environ.get("RMPA_STATE_DIR"):
        return Path(setting or environ["RMPA_STATE_DIR"])
    if environ.get("STATE_DIRECTORY"):
        return Path(environ["STATE_DIRECTORY"].partition(":")[0])
    if environ.get("XDG_STATE_HOME"):
        return Path(environ["XDG_STATE_HOME"]) / "rmpa"
    if environ.get("HOME"):
        return Path(environ["HOME"]) / ".local" / "state" / "rmpa"
    return None


def module_dir(directory: Path, module: str) -> Path:
    """The folder of one module's files within the state directory."""
    return directory / (re.sub(r"[^\w.-]", "_", module).lstrip(".") or "_")


def core_file(environ: Mapping[str, str], port: int, module: str = "", setting: str = "") -> Path | None:
    """The file of a ROS core, named by module and port, so that two cores on one machine do not share a file.

    Args:
        environ: As for ``state_dir``.
        port: The core's port; with 0 (chosen by the system) there is no file, because the next run has another port.
        module: Empty for a core without an agent.
        setting: As for ``state_dir``.
    """
    directory = state_dir(environ, setting or None)
    if directory is None or not port:
        return None
    return (module_dir(directory, module) if module else directory) / f"core-{port}.sqlite"
