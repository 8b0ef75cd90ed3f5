"""The recordings of all modules: kept at one time at all of them, listed, read and removed from any.

The recorder is a process of its own; here are only its files (``bridge.kept``).
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import os
import time
import zlib
from collections import deque
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.kept import KEPT, Kept, check_id, find_kept, read_kept, recording_id, remove_kept, request_keep
from rmpa.bridge.policy import Needs
from rmpa.bridge.rpc import EARLIER, gate_for, meant
from rmpa.bridge.sessions import Part, PeerSession
from rmpa.config.module_name import module_dir, state_dir
from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.core.facts import ModuleAnswer
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.bridge.bridge import Bridge

_log = logging.getLogger(__name__)
# Requests to another module: keep what its ring has of a time; list what it has; read a part of a file; remove one.
KEEP: Final = "record.keep"
LIST: Final = "record.list"
READ: Final = "record.read"
REMOVE: Final = "record.remove"
_SECOND: Final = 1_000_000_000
# For permissions: stands for all recordings, where a peer asks what the recorder does.
_ANY: Final = "/*"


class ModuleRecordings(ModuleAnswer, frozen=True, kw_only=True):
    """The recordings of one module.

    Attributes:
        kept: What it has kept, oldest first.
        status: What its recorder does (``record.recorder.RecorderStatus``); empty: none runs.
    """

    kept: tuple[Kept, ...] = ()
    status: dict[str, Any] = msgspec.field(default_factory=dict)


class FilePart(msgspec.Struct, frozen=True):
    """A part of a file of a recording.

    Attributes:
        size: Of the whole file, bytes.
        data: The part, in base 64.
        before: The CRC-32 of all bytes before the part, if it was asked for.
    """

    size: int
    data: str
    before: int | None = None


def _checksum(file: IO[bytes], count: int) -> int:
    """The CRC-32 of the first ``count`` bytes of a file; of all, if it has fewer."""
    found = 0
    while count > 0 and (block := file.read(min(count, limits.RECORDING_PART))):
        found, count = zlib.crc32(block, found), count - len(block)
    return found


class Recordings(Part):
    """The part of the bridge that keeps, lists and reads recordings here and at peers.

    Args:
        bridge: The peers and the rules.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._tasks = OwnedTasks()
        # What was to be kept at all modules, with the wall clock of then less the monotonic one, ns, and the names of
        # those that have answered.
        self._wanted: deque[tuple[Kept, int, set[str]]] = deque(maxlen=limits.KEEPS_WAITING)
        needs = Needs((Access.RECORD,), "the recording's name")
        bridge.rpc.on_request(KEEP, self._keep, needs)
        bridge.rpc.on_request(READ, self._read, needs)
        bridge.rpc.on_request(REMOVE, self._remove, needs)
        bridge.rpc.on_request(LIST, self._list, Needs((Access.RECORD,), "each recording; others are left out"))

    @property
    def folder(self) -> Path | None:
        """The recorder's folder of this module; ``None``: there is no state directory."""
        settings = self._bridge.context.settings
        place = state_dir(os.environ, settings.state_dir or None)
        return module_dir(place, settings.name) / "record" if place is not None else None

    async def close(self) -> None:
        """Ask no more."""
        await self._tasks.close()

    def link_up(self, session: PeerSession) -> None:
        """Ask a peer that is back for what the others have kept meanwhile."""
        for kept, epoch, done in self._wanted:
            if session.link.name not in done:
                self._tasks.start(
                    self._ask_keep(session, kept, epoch, done), f"keep {kept.id} at {session.link.name}"
                )

    async def keep(self, kept: Kept, only: Sequence[str] = ()) -> dict[str, str]:
        """Keep what the rings of this module and of all linked peers have of a time; the others when they are back.

        Args:
            kept: What to keep; its times are of this module's clock.
            only: The names of the modules that keep it, and no others later; empty: all.

        Returns:
            By module: empty where it is being kept, or why not.
        """
        done: set[str] = set()
        own = self._bridge.context.settings.name
        epoch = time.time_ns() - time.monotonic_ns()
        if not only:
            self._wanted.append((kept, epoch, done))
        found = {own: await self._keep_here(kept)} if not only or own in only else {}
        peers = [each for each in self._bridge.sessions.linked() if not only or each.link.name in only]
        answers = await asyncio.gather(*(self._ask_keep(session, kept, epoch, done) for session in peers))
        return found | {session.link.name: why for session, why in zip(peers, answers, strict=True)}

    async def _keep_here(self, kept: Kept) -> str:
        folder = self.folder
        try:
            if folder is None:
                return "there is no state directory; set RMPA_STATE_DIR"
            await asyncio.to_thread(request_keep, folder, kept)
        except (RmpaError, OSError) as error:
            return str(error)
        return ""

    async def _ask_keep(self, session: PeerSession, kept: Kept, epoch: int, done: set[str]) -> str:
        now = epoch + time.monotonic_ns()  # by the clock that the times of what to keep are of
        try:
            why = await self._bridge.rpc.request(session, KEEP, {"kept": msgspec.to_builtins(kept), "now": now})
        except PeerRefused as error:
            done.add(session.link.name)
            return EARLIER if error.unknown else error.reason
        except RmpaError as error:
            return str(error)
        done.add(session.link.name)
        return str(why)

    async def _keep(self, asker: PeerSession, args: dict[str, Any]) -> str:
        kept = msgspec.convert(args.get("kept"), Kept)
        self._check(asker, kept.id)
        # How long ago counts: each clock may have been set meanwhile, and the offset between both be an old one.
        now = args.get("now")
        ahead = now - time.time_ns() if isinstance(now, int) else asker.time.ahead_ns
        moved = msgspec.structs.replace(
            kept, since=kept.since - ahead, until=kept.until - ahead, asked_by=kept.asked_by or asker.link.name
        )
        return await self._keep_here(moved)

    def _check(self, asker: PeerSession | None, name: object) -> str:
        kept, (gate, peer) = check_id(str(name)), gate_for(self._bridge, asker)
        if why := gate.why_not(Access.RECORD, peer, f"/{kept}"):
            raise RmpaError(why, code="not-permitted")
        return kept

    async def _list(self, asker: PeerSession | None, _args: Mapping[str, Any]) -> ModuleRecordings:
        gate, peer = gate_for(self._bridge, asker)
        found = await asyncio.to_thread(self._here)
        kept = tuple(one for one in found.kept if not gate.why_not(Access.RECORD, peer, f"/{one.id}"))
        why = gate.why_not(Access.RECORD, peer, _ANY)  # it names the topics
        if why and not kept:
            raise RmpaError(why, code="not-permitted")
        if why:
            return ModuleRecordings(module=found.module, kept=kept)
        return msgspec.structs.replace(found, kept=kept)

    def _here(self) -> ModuleRecordings:
        folder = self.folder
        name = self._bridge.context.settings.name
        if folder is None or not folder.is_dir():
            return ModuleRecordings(module=name)
        status: dict[str, Any] = {}
        with contextlib.suppress(OSError, msgspec.DecodeError):  # no recorder has run
            status = msgspec.json.decode((folder / "status.json").read_bytes(), type=dict[str, Any])
        problem = ""
        if abs(silent := time.time() - float(status.get("at", 0.0))) > limits.RECORDER_SILENT:
            if status and Path(f"/proc/{status.get('pid')}/status").exists():
                problem = f"its recorder wrote its status {silent:.0f} s ago: the disk may be full or read-only"
            status = {}
        return ModuleRecordings(module=name, kept=tuple(read_kept(folder / KEPT)), status=status, problem=problem)

    async def list(self) -> list[ModuleRecordings]:
        """The recordings of this module and of its peers."""
        rpc, peers = self._bridge.rpc, [*self._bridge.sessions.linked()]
        own = await self._list(None, {})
        return [own, *await asyncio.gather(*(rpc.ask(peer, LIST, {}, ModuleRecordings) for peer in peers))]

    async def _read(self, asker: PeerSession | None, args: Mapping[str, Any]) -> FilePart:
        return await asyncio.to_thread(self._part, self._check(asker, args.get("id", "")), args)

    def _part(self, name: str, args: Mapping[str, Any]) -> FilePart:
        """A part of a file of a recording of this module.

        Raises:
            RmpaError: There is none, or it cannot be read.
        """
        file, offset, size = str(args.get("file", "")), args.get("offset", 0), args.get("size", limits.RECORDING_PART)
        kept = find_kept(self._kept(), name)
        if (
            file not in kept.files
            or not isinstance(offset, int)
            or not isinstance(size, int)
            or min(offset, size) < 0
        ):
            raise RmpaError(f"{name} has no file {file[:80]!r}", code="unknown-name")
        try:
            with (self._kept() / name / file).open("rb") as opened:
                before = _checksum(opened, offset) if args.get("check") else None
                opened.seek(offset)
                data = opened.read(min(size, limits.RECORDING_PART))
                return FilePart(os.fstat(opened.fileno()).st_size, base64.b64encode(data).decode(), before)
        except OSError as error:
            raise RmpaError(f"{name}/{file}: {error.strerror}", code="recording-damaged") from None

    def _kept(self) -> Path:
        folder = self.folder
        if folder is None:
            raise RmpaError("there is no state directory; set RMPA_STATE_DIR", code="no-state-directory")
        return folder / KEPT

    async def _remove(self, asker: PeerSession | None, args: Mapping[str, Any]) -> Kept:
        return await asyncio.to_thread(remove_kept, self._kept(), self._check(asker, args.get("id", "")))

    async def answer(self, args: Mapping[str, Any]) -> Any:
        """What a command asks: ``what`` is keep, list, read or remove, of the ``module`` (without one: this one).

        Raises:
            RmpaError: It cannot be done.
        """
        what, module = str(args.get("what", "list")), str(args.get("module", ""))
        if what == "list":
            return await self.list()
        if what == "keep":
            only = args.get("modules", ())
            return await self.keep(self._made(args), [str(each) for each in only] if isinstance(only, list) else ())
        if what not in ("read", "remove"):
            raise RmpaError(f"{what!r} is no question about recordings", code="unknown-name")
        if module in ("", self._bridge.context.settings.name):
            return await (self._read if what == "read" else self._remove)(None, args)
        if not (sessions := meant(self._bridge.sessions.linked(), module)):
            raise RmpaError(f"{module} is not linked; `rmpa peer list` shows why", code="peer-unlinked")
        request = READ if what == "read" else REMOVE
        inner = {key: args[key] for key in ("id", "file", "offset", "size", "check") if key in args}
        return await self._bridge.rpc.request(sessions[0], request, inner, limits.RECORDING_TIMEOUT)

    def _made(self, args: Mapping[str, Any]) -> Kept:
        """What to keep, by a recorder's own request or a person's words: ``id``, ``why``, ``seconds`` of the past."""
        if isinstance(given := args.get("kept"), dict):
            return msgspec.convert(given, Kept)
        now, why = time.time_ns(), str(args.get("why", "")) or "by hand"
        seconds, own = args.get("seconds"), self._bridge.context.settings
        past = float(seconds) if isinstance(seconds, int | float) else own.record.seconds or 86_400.0
        name = check_id(str(args.get("id", ""))) if args.get("id") else recording_id(why, own.name, now)
        since = now - round(past * _SECOND)
        return Kept(id=name, why=why, since=since, until=now, asked_by=own.name, by_hand=True)
