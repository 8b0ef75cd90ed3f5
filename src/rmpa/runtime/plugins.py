"""What packages of others add to rmpa: entry points of Python, as packaging.python.org specifies them.

Each use has a group of its own. The lists of all packages are read only where one is looked for. Packages in the
working directory do not count, also where ``python -m`` puts it first: root may stand in another user's folder.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from importlib.metadata import EntryPoint
    from logging import Logger

# Commands of ``rmpa`` by their names: a ``click.Command``, as ``cli.options`` makes one.
VERBS: Final = "rmpa.verbs"
# Neighbours of ``rmpa gateway``: called as ``make_site_neighbour``; ``None``: it is not wanted.
NEIGHBOURS: Final = "rmpa.neighbours"
# WebSocket protocols of ``rmpa web``: a class of ``web.clients.connection.Session``.
WEB_PROTOCOLS: Final = "rmpa.web_protocols"
# Checks of ``rmpa doctor``: called as those of ``CHECKS`` in ``observe.doctor.checks``.
DOCTOR_CHECKS: Final = "rmpa.checks"


@functools.cache
def find_plugins(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group, by their names; nothing of them is imported. It takes a millisecond or two."""
    found: dict[str, EntryPoint] = {}
    for about in _lists():
        try:
            with open(f"{about}/entry_points.txt", encoding="utf-8") as file:  # noqa: PTH123 - pathlib takes 5 ms
                if f"[{group}]" not in file.read():
                    continue
            from importlib.metadata import Distribution  # noqa: PLC0415 - it takes as long as all of this otherwise

            for entry in Distribution.at(about).entry_points.select(group=group):
                found.setdefault(entry.name, entry)
        except FileNotFoundError:
            continue  # a package without any
        except Exception as error:  # noqa: BLE001 - whatever another's file holds
            _log().warning("! %s [plugin-broken]", _told(about, error))
    return found


def _lists() -> Iterator[str]:
    """The folders of metadata of all packages, in the order of ``sys.path``."""
    try:
        here = os.path.realpath(os.getcwd())  # noqa: PTH109 - as above
    except OSError:
        here = ""
    for folder in sys.path:
        if folder[:1] == os.sep and os.path.realpath(folder) != here:
            with contextlib.suppress(OSError):  # it is none, or a zip file
                names = sorted(os.listdir(folder))  # noqa: PTH208 - as above
                yield from (f"{folder}/{name}" for name in names if name.endswith(".dist-info"))


def package_of(entry: EntryPoint) -> str:
    """The package that has an entry point: ``rmpa-hello 1.0``."""
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else entry.value


def load_plugin(entry: EntryPoint) -> Any:
    """Import what an entry point names.

    Raises:
        RmpaError: It cannot be imported; the text names the package.
    """
    try:
        return entry.load()
    except Exception as error:
        raise plugin_error(entry, error) from error


def load_plugins(group: str) -> Iterator[tuple[EntryPoint, Any]]:
    """Import all of a group; what cannot be imported is logged, and left out."""
    for entry in find_plugins(group).values():
        try:
            yield entry, load_plugin(entry)
        except RmpaError as error:
            _log().warning("! %s [%s]", error, error.code)


def plugin_error(entry: EntryPoint, error: Exception) -> RmpaError:
    """The error for a fault of another's package, in one line."""
    return RmpaError(_told(f"{entry.name} of the package {package_of(entry)}", error), code="plugin-broken")


def _told(what: str, error: Exception) -> str:
    said = " ".join(str(error).split())
    return f"{what} failed: {type(error).__name__}: {said}"


def _log() -> Logger:
    import logging  # noqa: PLC0415 - `rmpa --help` does without

    return logging.getLogger(__name__)
