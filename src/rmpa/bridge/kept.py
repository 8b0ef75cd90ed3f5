"""Recordings that are kept: each a folder of segments with ``recording.json``, which says when and why.

The folder of a module's recorder is ``STATE/MODULE/record``. ``rmpa record`` writes it, and the agent reads it for
other modules and asks by a file for more to be kept: neither waits for the other.
"""

from __future__ import annotations

import re
import shutil
import time
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import RmpaError
from rmpa.runtime.programs import replace_file

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

ABOUT: Final = "recording.json"
KEPT: Final = "kept"
REQUESTS: Final = "requests"
_ID: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,80}")


class Kept(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A recording that is kept.

    Attributes:
        id: Its name: the same at all modules that kept it for the same reason.
        why: The reason, a sentence.
        since: It begins before this time, Unix nanoseconds by the clock of its module.
        until: It ends behind this time.
        module: The module that recorded it.
        asked_by: The module at which the reason was; empty: this one.
        by_hand: Whether a person asked for it; then only a person removes it.
        size: Bytes of its files.
        files: Their names, in order.
    """

    id: str
    why: str = ""
    since: int = 0
    until: int = 0
    module: str = ""
    asked_by: str = ""
    by_hand: bool = False
    size: int = 0
    files: tuple[str, ...] = ()


def recording_id(why: str, module: str, at: int) -> str:
    """The name of a new recording: ``20261129-121500-arm-peer_lost``."""
    word = re.sub(r"[^a-z0-9]+", "_", why.lower()).strip("_")[:24] or "kept"
    return f"{time.strftime('%Y%m%d-%H%M%S', time.gmtime(at / 1e9))}-{module}-{word}"


def check_id(name: str) -> str:
    """The name of a recording, if it can be one: it is a folder's name, and no path.

    Raises:
        RmpaError: It cannot be one.
    """
    if not _ID.fullmatch(name):
        text = f"{name[:80]!r} is not the name of a recording; `rmpa record list` shows them"
        raise RmpaError(text, code="unknown-name")
    return name


def request_keep(folder: Path, kept: Kept) -> None:
    """Ask the recorder of a folder to keep what its ring has of a time.

    Raises:
        RmpaError: No recorder has made the folder.
        OSError: It cannot be written.
    """
    requests = folder / REQUESTS
    if not requests.is_dir():
        text = "no recorder has run here; start one: `rmpa record`, or [record] enabled = true"
        raise RmpaError(text, code="no-recorder")
    replace_file(requests / f"{check_id(kept.id)}.json", msgspec.json.encode(kept))


def read_requests(folder: Path) -> Iterator[Kept]:
    """The requests to keep that wait in a folder, until ``end_request``: what is killed meanwhile does them later."""
    for path in sorted((folder / REQUESTS).glob("*.json")):
        try:
            kept = msgspec.json.decode(path.read_bytes(), type=Kept)
        except (OSError, msgspec.DecodeError):
            kept = None
        if kept is not None and kept.id == path.name.removesuffix(".json"):
            yield kept
        else:
            path.unlink(missing_ok=True)


def end_request(folder: Path, kept: Kept) -> None:
    """A request is done, or cannot be done.

    Raises:
        OSError: It cannot be removed.
    """
    (folder / REQUESTS / f"{kept.id}.json").unlink(missing_ok=True)


def write_kept(folder: Path, kept: Kept, *, limit: int = 0) -> Kept:
    """Write what a folder's recording is; then drop the oldest that no person asked for, above so many bytes.

    Raises:
        OSError: It cannot be written.
    """
    files = sorted(path for path in folder.iterdir() if path.name != ABOUT and path.is_file())
    made = msgspec.structs.replace(
        kept, files=tuple(path.name for path in files), size=sum(path.stat().st_size for path in files)
    )
    replace_file(folder / ABOUT, msgspec.json.encode(made))
    others = [one for one in read_kept(folder.parent) if one.id != made.id]
    total = made.size + sum(one.size for one in others)
    # The oldest by the numbers of their segments: the clock may have been set since.
    for one in sorted((one for one in others if not one.by_hand), key=lambda each: each.files[-1:]):
        if not limit or total <= limit:
            break
        total -= one.size
        shutil.rmtree(folder.parent / one.id, ignore_errors=True)
    return made


def read_kept(folder: Path) -> Iterator[Kept]:
    """The recordings in a folder, in the order of their names; what is none of this release is left out."""
    for about in sorted(folder.glob(f"*/{ABOUT}")):
        try:
            kept = msgspec.json.decode(about.read_bytes(), type=Kept)
        except (OSError, msgspec.DecodeError):
            continue
        if kept.id == about.parent.name:
            yield kept


def find_kept(folder: Path, name: str) -> Kept:
    """One recording in a folder.

    Raises:
        RmpaError: There is none of this name.
    """
    check_id(name)
    for one in read_kept(folder):
        if one.id == name:
            return one
    raise RmpaError(f"there is no recording {name}; `rmpa record list` shows them", code="unknown-name")


def remove_kept(folder: Path, name: str) -> Kept:
    """Remove a recording, and return what it was.

    Raises:
        RmpaError: There is none of this name.
        OSError: It cannot be removed.
    """
    kept = find_kept(folder, name)
    shutil.rmtree(folder / kept.id)
    return kept
