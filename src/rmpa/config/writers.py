"""Whether another user may write a settings file, as ssh's StrictModes judges its own (sshd_config(5)).

The file counts, each folder above it, and each link on the way. This user and root may write there, and under
``sudo`` the user who called it.
"""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
import stat
from typing import TYPE_CHECKING

from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping
    from pathlib import Path


def check_writers(path: Path, environ: Mapping[str, str], key: str) -> None:
    """Refuse a file of settings that another user may write; arguments as for ``other_writer``, and what names it.

    Raises:
        ConfigError: One may.
        OSError: A part of the path is gone.
    """
    if (found := other_writer(path, environ)) is not None:
        raise ConfigError(key, f"is not obeyed: {found[0]}", found[1], path, code="settings-exposed")


def other_writer(path: Path, environ: Mapping[str, str]) -> tuple[str, str] | None:
    """What of a file's path another user may write, and what to do; ``None``: nothing.

    Args:
        path: Of a file that is there.
        environ: Has SUDO_UID under ``sudo``.

    Raises:
        OSError: A part of the path is gone.
    """
    own = {0, os.geteuid()}
    caller = environ.get("SUDO_UID", "")
    if os.geteuid() == 0 and caller.isdecimal():
        own.add(int(caller))
    for part in _way(path.absolute()):
        if found := _problem(part, own):
            return found
    return None


def _way(path: Path) -> Iterator[Path]:
    """A path, the folders above it, and the same of what a link on the way leads to."""
    waiting, seen = [path], set()
    while waiting:
        at = waiting.pop()
        for part in (at, *at.parents):
            if part not in seen:
                seen.add(part)
                yield part
                if part.is_symlink():
                    waiting.append(part.parent / part.readlink())


def _problem(part: Path, own: Collection[int]) -> tuple[str, str] | None:
    info = part.lstat()
    part = part if stat.S_ISLNK(info.st_mode) else part.resolve()  # it is shown without dots
    if os.statvfs(part).f_flag & os.ST_RDONLY:
        return None  # a container's settings, mounted so
    if info.st_uid not in own:
        return f"{part} belongs to user {info.st_uid}", f"chown {os.geteuid()} {part}; in a container mount it :ro"
    folder, mode = stat.S_ISDIR(info.st_mode), stat.S_IMODE(info.st_mode)
    # In a folder such as /tmp each user writes what is its own alone.
    if stat.S_ISLNK(info.st_mode) or (folder and mode & stat.S_ISVTX):
        return None
    if mode & stat.S_IWOTH:
        return f"every user may write {part} (mode {mode:o})", f"chmod o-w {part}"
    if mode & stat.S_IWGRP and not _is_private(part, info.st_gid, own):
        return f"users of group {info.st_gid} may write {part} (mode {mode:o})", f"chmod g-w {part}"
    return None


def _is_private(part: Path, group: int, own: Collection[int]) -> bool:
    """Whether a group that may write has no other user, as the one that Debian makes for each user."""
    with contextlib.suppress(OSError):
        if "system.posix_acl_access" in os.listxattr(part):
            return False  # the group's rights are then the bound of all that the list names
    try:
        members = grp.getgrgid(group).gr_mem
        users = [pwd.getpwnam(name).pw_uid for name in members]
    except KeyError:
        return False
    return {*users, *(each.pw_uid for each in pwd.getpwall() if each.pw_gid == group)} <= {*own}
