"""Finds the programs of this machine's ROS packages, sourced or not."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from rmpa.core.errors import PeerRefused
from rmpa.ros.types.installed import SearchPath, package_folders

if TYPE_CHECKING:
    from collections.abc import Mapping


def find_executable(package: str, name: str, environ: Mapping[str, str]) -> list[str]:
    """The begin of the command line of a package's executable, which is found as ``rosrun`` finds it.

    It is searched in ``lib/PACKAGE`` of each prefix of CMAKE_PREFIX_PATH, in the package's folder below
    ROS_PACKAGE_PATH, then in ``lib/PACKAGE`` of the installations, sourced or not.

    Raises:
        PeerRefused: There is none.
    """
    path = SearchPath.read(environ)
    for prefix in path.prefixes:
        if _is_executable(found := Path(prefix, "lib", package, name)):
            return [str(found)]
    for root in path.packages:
        for folder in package_folders(package, root):
            for found in sorted(folder.rglob(name)):
                if _is_executable(found):
                    return [str(found)]
    for prefix in path.system:
        if _is_executable(found := Path(prefix, "lib", package, name)):
            return _sourced(prefix, [str(found)])
    raise PeerRefused(
        f"{package} {name}", "there is no such executable", f"it was searched in {path}", code="unknown-name"
    )


def find_program(name: str, environ: Mapping[str, str]) -> list[str]:
    """The begin of the command line of a program of ROS.

    Raises:
        PeerRefused: It is not installed.
    """
    if found := shutil.which(name, path=environ.get("PATH")):
        return [found]
    for prefix in SearchPath.read(environ).system:
        if _is_executable(found_at := Path(prefix, "bin", name)):
            return _sourced(prefix, [str(found_at)])
    raise PeerRefused(name, "it is not installed here", "install ROS's package of that name", code="unknown-name")


def _sourced(prefix: str, command: list[str]) -> list[str]:
    """A command with the environment of an installation that is not sourced, as a service at boot has it."""
    script = Path(prefix, "env.sh")
    return [str(script), *command] if _is_executable(script) else command


def _is_executable(path: Path) -> bool:
    return path.is_file() and os.access(path, os.X_OK)
