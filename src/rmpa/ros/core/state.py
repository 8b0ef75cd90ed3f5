"""Keeps a core's registrations and parameters over a restart: one file, written whole and renamed.

Restored is what was lost under running nodes: each node of the file is asked before the core listens. After the end
of all nodes the core begins empty, as a roscore does: what a launch file of yesterday set would act for ever.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import math
import time
from collections import defaultdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.core.errors import RemoteProtocolError, RmpaError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.http.rpc import call_api
from rmpa.ros.master.parameters import RegistrationKind
from rmpa.ros.master.registrations import Name, NodeRecord
from rmpa.ros.node.ask import IDENTIFY_ID, name_at
from rmpa.ros.wire.xmlrpc import RosFault, serialize_response
from rmpa.runtime.accept import in_thread
from rmpa.runtime.loop import yielding_to_data
from rmpa.runtime.programs import replace_file, set_aside
from rmpa.runtime.tasks import end_tasks, keep_task, start_task

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.ros.master.api import MasterApi

_log = logging.getLogger(__name__)

# Changes are gathered this long before they are written: a starting node registers a dozen things.
CORE_STATE_GATHER: Final = 0.3
# After a write, a pause of this many times its processor time: a large state is written less often.
CORE_STATE_SHARE: Final = 20
# Pause before a failed write is tried again: the disk is full, or not mounted yet.
CORE_STATE_RETRY: Final = 5.0

# The longest pause after a write, in seconds.
_CORE_STATE_REST: Final = 10.0
_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")
_SIMULATED: Final = "use_sim_time"
# A MessagePack extension: XML-RPC's dates have no time zone, and MessagePack's have one.
_DATE: Final = 1
_OF_A_CORE: Final = frozenset({"/run_id", "/rosdistro", "/rosversion"})
# Names of nodes or parameters in a text for people.
_SHOWN: Final = 3


# The file's form. A release that changes it reads the earlier ones, from 0.2.0 on (docs/reference/compatibility.md).
FORMAT: Final = "rmpa core 2"


class StoredFormat(msgspec.Struct):
    """The part of the file that all formats have."""

    format: str


class StoredState(msgspec.Struct):
    """The content of the file.

    Attributes:
        format: Tells other programs' files and other formats from this one.
        boot: In which boot of the machine the core runs; empty once it has ended in order.
        nodes: Records by the node's name.
        params: The parameter tree.
    """

    format: str
    boot: str = ""
    nodes: dict[Name, NodeRecord] = {}
    params: dict[str, Any] = {}


def _unpacked_ext(code: int, data: memoryview) -> datetime:
    if code != _DATE:
        raise ValueError(f"extension {code}")
    return datetime.fromisoformat(bytes(data).decode())


def serialize(state: StoredState) -> bytes:
    """Return the content of the file.

    Raises:
        ValueError, TypeError, OverflowError, RecursionError: MessagePack cannot express a parameter.
    """
    return msgspec.msgpack.encode(StoredState(state.format, state.boot, state.nodes, _packable(state.params)))


def _packable(value: Any) -> Any:
    """A copy of the value, with each date as an extension."""
    match value:
        case dict():
            return {name: _packable(part) for name, part in value.items()}
        case list() | tuple():
            return [_packable(part) for part in value]
        case datetime():
            return msgspec.msgpack.Ext(_DATE, value.isoformat().encode())
    return value


def parse(data: bytes) -> StoredState:
    """Read the content of a file.

    Raises:
        ValueError: It is damaged, of another format, or holds what no call of a node could have caused.
    """
    try:
        found = msgspec.msgpack.decode(data, type=StoredFormat).format
        if found != FORMAT:
            raise ValueError(f"another release of rmpa wrote it: it is of format {found[:40]!r}, not {FORMAT!r}")
        state = msgspec.msgpack.decode(data, type=StoredState, ext_hook=_unpacked_ext)
        serialize_response([msgspec.to_builtins(state.nodes), state.params])
    except (msgspec.MsgspecError, TypeError, RecursionError, RmpaError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from None
    if _depth(state.params) > limits.CORE_STATE_DEPTH_MAX:
        raise ValueError("its parameters are nested deeper than a parameter can be")
    return state


def _depth(value: Any) -> int:
    match value:
        case dict():
            return 1 + max(map(_depth, value.values()), default=0)
        case list():
            return 1 + max(map(_depth, value), default=0)
    return 0


class CoreState:
    """The stored state of one core.

    Args:
        path: The file; created with its folders, for this user alone.
        api: The core's master.
        keep: When to restore it: ``auto``, if a node of it still runs or the core died within this boot of the
            machine; ``always``; ``never``.
        temporary: Whether a node of this name is not stored, because its owner registers it anew.
        carry_out: Called after each change of the registrations.
    """

    def __init__(
        self,
        path: Path,
        api: MasterApi,
        *,
        keep: str,
        temporary: Callable[[str], bool],
        carry_out: Callable[[], None],
    ) -> None:
        self.path = path
        self._api = api
        self._keep = keep
        self._temporary = temporary
        self._carry_out = carry_out
        self._boot = ""
        # The nodes of the file and their slave APIs, until their addresses have answered.
        self._asked: dict[str, str] = {}
        self._up = self._gone = self._params = 0
        self._dropped = ""
        self._asking: set[asyncio.Task[None]] = set()
        # Whether there is a file that could not be read: it is set aside before another one is written.
        self._unread = False
        self._problem = ""
        self._written: tuple[int, object] = (-1, None)
        self._digest = 0
        self._began, self._took = math.inf, 0.0
        self._writer: asyncio.Task[None] | None = None
        self._news, self._ending = asyncio.Event(), asyncio.Event()

    async def restore(self) -> None:
        """Read the file, ask its nodes, and restore what shall be; to be called before the core listens."""
        try:
            async with asyncio.timeout(limits.CORE_STATE_OPEN):
                state = await in_thread(self._read, "core state")
        except (FileNotFoundError, NotADirectoryError):
            return
        except (OSError, ValueError) as error:
            self._unread = True
            why = self._reason(error)
            self._problem = why if isinstance(error, OSError) else ""
            _log.warning("! the core starts empty: %s; the old file is kept under another name [state-lost]", why)
            return
        if self._keep == "never":
            self._drop(state, "core.keep is never")
            return
        await self._ask_all({name: node for name, node in state.nodes.items() if not self._temporary(name)})
        left, died = bool(self._up or self._asked), bool(self._boot) and state.boot == self._boot
        if self._keep == "auto" and not left and not died:
            self._drop(state, "no node of the run before is left")
            return
        if not left and state.params.pop(_SIMULATED, None) is not None:
            # With that parameter and no clock, a node that starts would wait for ever.
            _log.warning(
                "= /use_sim_time of the run before is not restored: no node of that run is left [state-lost]"
            )
        self._api.parameters.set("/", state.params)
        self._params = sum(1 for name in self._api.parameters.names() if name not in _OF_A_CORE)

    def start(self) -> None:
        """Begin to write changes; to be called once the core listens."""
        if text := self.restored():
            _log.info("= %s: %s", self.path, text)
        self._writer = keep_task(self._write_changes, "keep the core's state")
        self.note_change()

    def _read(self) -> StoredState:
        with contextlib.suppress(OSError):
            self._boot = _BOOT_ID.read_text().strip()
        if self.path.stat().st_size > limits.CORE_STATE_BYTES:
            raise ValueError("it is larger than a core's file can be")
        return parse(self.path.read_bytes())

    def _drop(self, state: StoredState, why: str) -> None:
        names = [f"/{name}" for name in state.params if f"/{name}" not in _OF_A_CORE]
        if names or state.nodes:
            self._dropped = f"the core starts empty: {why}"
        if names and self._keep == "auto":
            self._dropped += f'; its parameters {_first(names)} are dropped (core.keep = "always" keeps them)'

    async def _ask_all(self, nodes: dict[str, NodeRecord]) -> None:
        """Ask all nodes at once, and register those that answer within ``limits.CORE_STATE_ASK``.

        One that answers later, within the time-outs of its calls, is registered then.
        """
        self._asked = {name: node.api for name, node in nodes.items()}
        at: defaultdict[str, dict[str, NodeRecord]] = defaultdict(dict)  # nodelets share an address
        for name, node in nodes.items():
            at[node.api][name] = node
        if not at:
            return
        asking = {start_task(self._ask(api, at[api]), f"ask {api}") for api in at}
        _, self._asking = await asyncio.wait(asking, timeout=limits.CORE_STATE_ASK)
        self._carry_out()  # once for all: a list that lacks a publisher would end the connections to it
        for task in self._asking:
            task.add_done_callback(self._asking.discard)
            task.add_done_callback(lambda _: self._carry_out())

    async def _ask(self, api: str, nodes: dict[str, NodeRecord]) -> None:
        """Ask what is at an address, and register its nodes if they are."""
        there = await _is_there(api, nodes)
        if there is None:
            return
        for name in nodes:
            del self._asked[name]
        if there:
            self._register(nodes)
        else:
            self._gone += len(nodes)
            _log.info("= %s, of the run before, is not there any more", ", ".join(nodes))

    def _register(self, nodes: dict[str, NodeRecord]) -> None:
        table = self._api.registrations
        topics: set[str] = set()
        for name, node in nodes.items():
            if table.node_api(name) not in {None, node.api}:
                continue  # a new node has its name
            self._up += 1
            topics |= _keys(node, RegistrationKind.SUBSCRIBER)
            for kind, key, detail in node.entries:
                if kind is not RegistrationKind.SERVICE or table.service_uri(key) is None:
                    table.register(kind, key, name, node.api, detail)
        for topic in topics:
            table.notify_subscribers(topic)

    def restored(self) -> str:
        """What became of the file's content at the start; empty if there was none."""
        parts = [self._dropped]
        if nodes := self._up + self._gone + len(self._asked):
            parts.append(f"{self._up} of {nodes} nodes of the last run are restored")
            if self._gone:
                parts[-1] += f", {self._gone} {'is' if self._gone == 1 else 'are'} gone"
            if self._asked:
                parts[-1] += f", {_first(list(self._asked))} did not answer"
        if self._params:
            some = "1 parameter of it was" if self._params == 1 else f"{self._params} parameters of it were"
            parts.append(f"{some} restored")
        return "; ".join(filter(None, parts))

    def _problem_now(self) -> str:
        """Why nothing is stored at present, or empty."""
        late = asyncio.get_running_loop().time() - self._began > limits.CORE_STATE_WRITE
        return f"{self.path}: the disk does not answer" if late else self._problem

    def summary(self) -> str:
        """The file and what was restored from it, for people."""
        kept = "nothing is kept" if self._problem_now() else f"kept in {self.path}"
        return "; ".join(filter(None, (kept, self.restored())))

    def notes(self) -> tuple[str, ...]:
        """Problems that the user should know of."""
        problem = self._problem_now()
        notes = [f"the core keeps nothing when it restarts: {problem}"] if problem else []
        if not self._asking:
            notes += [
                f"{node} at {api}, of the run before, does not answer and is not shown: start it again"
                for node, api in list(self._asked.items())[:_SHOWN]
                if self._api.registrations.node_api(node) is None
            ]
        return tuple(notes)

    def note_change(self) -> None:
        """Write soon, if something has changed."""
        if self._changed():
            self._news.set()

    async def close(self) -> None:
        """Write what has changed, and that the core ended in order."""
        self._ending.set()
        self._news.set()
        if self._writer is not None:  # else another core may have the port, and so this file
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(asyncio.shield(self._writer), limits.CORE_STATE_CLOSE)
        await end_tasks(self._writer, *self._asking)

    def _changed(self) -> bool:
        revision, tree = self._written
        return revision != self._api.registrations.revision or tree is not self._api.parameters.tree

    async def _write_changes(self) -> None:
        while True:
            self.note_change()
            await self._news.wait()
            self._news.clear()
            await self._rest(CORE_STATE_GATHER)
            ended = self._ending.is_set()
            await self._write("" if ended else self._boot)
            if ended:
                return
            rest = CORE_STATE_RETRY if self._problem else self._took * CORE_STATE_SHARE
            await self._rest(min(rest, _CORE_STATE_REST))

    async def _rest(self, seconds: float) -> None:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._ending.wait(), seconds)

    async def _write(self, boot: str) -> None:
        table, tree = self._api.registrations, self._api.parameters.tree
        now = table.revision, tree
        self._began = asyncio.get_running_loop().time()
        nodes = {
            name: record
            for name in yielding_to_data(list(table.nodes()))
            if not self._temporary(name) and (record := table.record(name)) is not None
        }
        try:
            # Trees and records are never changed in place, so that a thread may read them.
            await in_thread(lambda: self._put(StoredState(FORMAT, boot, nodes, tree)), "core state")
        except (OSError, ValueError, TypeError, OverflowError, RecursionError) as error:
            if not self._problem:
                _log.warning("! the core keeps nothing when it restarts: %s [state-lost]", self._reason(error))
            self._problem = self._reason(error)
        else:
            if self._problem:
                _log.info("= %s: everything is kept again", self.path)
            self._problem, self._written = "", now
        finally:
            self._began = math.inf

    def _put(self, state: StoredState) -> None:
        began = time.thread_time()
        data = serialize(state)
        self._took = time.thread_time() - began
        if len(data) > limits.CORE_STATE_BYTES:
            raise ValueError(f"it would have {len(data):,} bytes, and has at most {limits.CORE_STATE_BYTES:,}")
        if hash(data) == self._digest and self.path.exists():
            return
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if self._unread:
            with contextlib.suppress(FileNotFoundError):
                _log.warning("! %s is kept as %s [state-lost]", self.path, set_aside(self.path, "before").name)
            self._unread = False
        replace_file(self.path, data)
        self._digest = hash(data)

    def _reason(self, error: Exception) -> str:
        match error:
            case TimeoutError():
                return f"{self.path}: the disk does not answer"
            case OSError(errno=errno.ENOSPC | errno.EDQUOT):
                return f"{self.path}: {error.strerror}; make room on that disk"
            case OSError():
                return f"{self.path}: {error.strerror or error}; set RMPA_STATE_DIR to another place"
        return f"{self.path}: {error}"


def _first(names: list[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


async def _is_there(api: str, nodes: dict[str, NodeRecord]) -> bool | None:
    """Whether these nodes are still at an address; ``None`` if nothing answers there, and nothing refuses.

    A rospy node gives its name in ``getName``, a roscpp node in the header of a topic that it publishes; one that
    publishes nothing is known by its own lists of topics. The records take up what these lists have.
    """
    topics = [topic for node in nodes.values() for topic in _keys(node, RegistrationKind.PUBLISHER) - {"/rosout"}]
    try:
        name = await name_at(api, topics)
        if name is not None and name not in nodes:
            return False
        lists = {
            RegistrationKind.PUBLISHER: await _listed(api, "getPublications"),
            RegistrationKind.SUBSCRIBER: await _listed(api, "getSubscriptions"),
        }
    except UnreachableError as error:
        return False if isinstance(error.__cause__, ConnectionRefusedError) else None
    except RmpaError:  # such as no file descriptor left
        return None
    if name is None:
        had = [(_keys(node, kind), now) for node in nodes.values() for kind, now in lists.items()]
        known = [keys <= now.keys() if now is not None else False for keys, now in had if keys]
        if not known or not all(known):
            return None if topics else False  # a publisher tells its name, unless it is too busy at present
    if len(nodes) == 1:  # the lists of nodelets do not say which node an entry belongs to
        [node] = nodes.values()
        for kind, now in lists.items():
            if now is not None:
                others = [entry for entry in node.entries if entry[0] is not kind]
                node.entries = [*others, *((kind, topic, topic_type) for topic, topic_type in now.items())]
    return True


def _keys(node: NodeRecord, kind: RegistrationKind) -> set[str]:
    return {key for its, key, _ in node.entries if its is kind}


async def _listed(api: str, method: str) -> dict[str, str] | None:
    """The topics and types of a node's own list; ``None`` if it does not tell."""
    try:
        reply = await call_api(api, method, IDENTIFY_ID)
    except (RosFault, RemoteProtocolError):
        return None
    try:
        return dict(msgspec.convert(reply.value, list[tuple[Name, str]])) if reply.code == 1 else None
    except msgspec.ValidationError:
        return None
