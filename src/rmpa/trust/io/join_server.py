"""Joins and renewals at the authority, on the sockets whose prefaces the mesh's acceptor has checked."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING

from rmpa.core.counters import Counters, RefusalLog
from rmpa.core.errors import LocalProtocolError, RmpaError
from rmpa.trust import limits
from rmpa.trust.certificates import CertificateError, verify
from rmpa.trust.io import store as files_of
from rmpa.trust.io.join_connection import JoinConnection, NotTlsError, join_server_context, renewal_context
from rmpa.trust.io.joining import one_message
from rmpa.trust.join import CodeShown, InvitingSide, Joined
from rmpa.trust.preface import Purpose
from rmpa.trust.renewal import Renew, RenewalGrant, RenewalRefused, encode_renewal

if TYPE_CHECKING:
    import socket
    import ssl
    from collections.abc import Callable

    from rmpa.core.clock import Clock
    from rmpa.trust.io.authority import MeshAuthority
    from rmpa.trust.io.membership import Membership
    from rmpa.trust.join import JoinEvent
    from rmpa.trust.preface import Preface

_log = logging.getLogger(__name__)


class JoinState(StrEnum):
    """How far a join has come at the authority."""

    WAITING = "waiting"
    CODE = "code"
    """The code is shown: the user compares it."""
    JOINED = "joined"
    REFUSED = "refused"


@dataclass(slots=True)
class JoinProgress:
    """What came of one token so far, as ``rmpa trust invite`` shows it.

    Args:
        state: How far it is.
        code: Six digits, once they are shown.
        module: The module that joins, by its own word until it has joined.
        reason: Why it was refused, one word.
        text: What happened.
        step: Counts the changes.
    """

    state: JoinState = JoinState.WAITING
    code: str = ""
    module: str = ""
    reason: str = ""
    text: str = ""
    step: int = 0
    changed: asyncio.Event = field(default_factory=asyncio.Event, repr=False)


@dataclass(slots=True, eq=False)
class _Joining:
    """One join that goes on."""

    side: InvitingSide
    answered: asyncio.Event = field(default_factory=asyncio.Event)


class JoinServer:
    """The authority's end of joins and renewals.

    Args:
        authority: Issues the certificates.
        membership: This module's.
        clock: Monotonic seconds.
        is_taken: Whether a member that is linked has a name.
        counters: Counts what is refused: ``trust.join_full``, ``trust.join_failed``, ``trust.renewal_refused``.
    """

    def __init__(
        self,
        authority: MeshAuthority,
        membership: Membership,
        clock: Clock,
        is_taken: Callable[[str], bool],
        counters: Counters | None = None,
    ) -> None:
        self._authority = authority
        self._membership = membership
        self._clock = clock
        self._refusals = RefusalLog(_log, counters if counters is not None else Counters())
        self._is_taken = is_taken
        self._tasks: dict[asyncio.Task[None], tuple[Purpose, str]] = {}
        """Each with what it is for, and the address of the other end."""
        self._joining: dict[bytes, _Joining] = {}
        self._reserved: dict[bytes, asyncio.Task[None]] = {}
        """By the ids of tokens, from the moment in which a connection is taken."""
        self._progress: dict[bytes, JoinProgress] = {}
        authority.on_revoked.append(self._revoked)

    def accept(self, sock: socket.socket, preface: Preface) -> None:
        """Take a connection whose preface asks for a join or a renewal; the socket is owned from here on.

        A connection that has not shown the token yet gives way to the next one with it: a preface of a join has no
        time, and may be one that was recorded.
        """
        purpose, host = preface.purpose, _host(sock)
        before = self._reserved.get(preface.token_id) if purpose is Purpose.JOIN else None
        joining = self._joining.get(preface.token_id)
        in_use = before is not None and joining is not None and bool(joining.side.module)
        others = (each for task, each in self._tasks.items() if task is not before)
        alike = [there for what, there in others if what is purpose]
        if in_use or len(alike) >= limits.JOINS_AT_ONCE or alike.count(host) >= limits.JOINS_PER_ADDRESS:
            text = "a join or renewal is refused: too many at once, or its token is being used just now"
            self._refuse("trust.join_full", host, text)
            sock.close()
            return
        if before is not None:
            before.cancel()
        task = asyncio.get_running_loop().create_task(self._run(sock, preface), name=str(preface))
        self._tasks[task] = (purpose, host)
        if purpose is Purpose.JOIN:
            self._reserved[preface.token_id] = task
            task.add_done_callback(partial(self._ended, preface.token_id))
        task.add_done_callback(self._tasks.pop)
        task.add_done_callback(
            lambda _: sock.close()
        )  # a task that is cancelled before it begins runs no ``finally``

    def _ended(self, token_id: bytes, task: asyncio.Task[None]) -> None:
        if self._reserved.get(token_id) is task:
            del self._reserved[token_id]

    async def close(self) -> None:
        """End all of them."""
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    # --- the user's side --------------------------------------------------------------------------------------

    def progress(self, token_id: bytes) -> JoinProgress:
        """How far the join with a token is; its event ``changed`` is set at each step."""
        found = self._progress.get(token_id)
        if found is None:
            while len(self._progress) >= limits.TOKENS_MAX:
                del self._progress[next(iter(self._progress))]
            found = self._progress[token_id] = JoinProgress()
        return found

    def answer(self, token_id: bytes, *, agree: bool) -> None:
        """The user says whether the codes are equal.

        Raises:
            LocalProtocolError: No code is shown.
            StartError: The clock is not set.
        """
        joining = self._joining.get(token_id)
        if joining is None:
            raise LocalProtocolError("no module is joining with this token now")
        if agree:
            joining.side.agree(self._authority.wall_for(self.progress(token_id).module))
        else:
            joining.side.reject()
        joining.answered.set()

    def _revoked(self, name: str) -> None:
        for joining in self._joining.values():
            if joining.side.module == name:
                joining.side.revoked()
                joining.answered.set()

    def _step(self, token_id: bytes, state: JoinState, **parts: str) -> None:
        progress = self.progress(token_id)
        progress.state = state
        progress.step += 1
        for name, value in parts.items():
            setattr(progress, name, value)
        changed, progress.changed = progress.changed, asyncio.Event()
        changed.set()

    def _refuse(self, counter: str, host: str, text: str) -> None:
        """Log what can be repeated by each connection, within limits: a module that was revoked may do it."""
        self._refusals.refuse(self._clock.now(), counter, host, text)

    # --- connections ------------------------------------------------------------------------------------------

    async def _run(self, sock: socket.socket, preface: Preface) -> None:
        where = "a module"
        try:
            where = "{}:{}".format(*sock.getpeername()[:2])
            if preface.purpose is Purpose.JOIN:
                await self._join(sock, preface.token_id, where)
            else:
                await self._renew(sock, where)
        except (OSError, NotTlsError, RmpaError) as error:
            text = f"{preface.purpose.name.lower()} by {where} failed: {error}"
            self._refuse("trust.join_failed", _host(sock), text)
        except Exception:  # noqa: BLE001 - the task's top
            _log.exception("! %s by %s failed", preface.purpose.name.lower(), where)

    async def _handshake(self, sock: socket.socket, context: ssl.SSLContext) -> JoinConnection:
        sock.setblocking(False)
        connection = JoinConnection(sock, context, server_side=True)
        async with asyncio.timeout(limits.JOIN_STEP_TIMEOUT):
            await connection.handshake()
        return connection

    async def _join(self, sock: socket.socket, token_id: bytes, where: str) -> None:
        store = self._membership.store
        context = join_server_context(store.path(files_of.CERTIFICATE), store.path(files_of.KEY))
        side = InvitingSide(
            token_id,
            self._authority.book,
            self._authority.secrets,
            store.load().certificate,  # of the file, as the context has it
            self._authority.new_serial(),
            os.urandom(limits.NONCE_BYTES),
            self._clock.now(),
            lambda name: self._taken(token_id, name),
        )
        joining = self._joining[token_id] = _Joining(side)
        try:
            connection = await self._handshake(sock, context)
            await self._converse(connection, joining, token_id, where)
        finally:
            if self._joining.get(token_id) is joining:
                del self._joining[token_id]

    def _taken(self, token_id: bytes, name: str) -> bool:
        """Whether a member, or another module that joins just now, has a name.

        An invitation for the name itself lets it join again while it is away.
        """
        invitation = self._authority.book.find(token_id)
        again = invitation.name if invitation is not None else ""
        return self.is_in_use(name, token_id) or self._authority.has_issued(name, again)

    def is_in_use(self, name: str, token_id: bytes = b"") -> bool:
        """Whether a linked member has a name, or a module that joins just now with another token."""
        others = (each.side for token, each in self._joining.items() if token != token_id)
        joining = {side.module.casefold() for side in others if not side.over}
        return self._is_taken(name) or name.casefold() in joining

    async def _converse(self, connection: JoinConnection, joining: _Joining, token_id: bytes, where: str) -> None:
        """Drive one side of a join to its end."""
        side = joining.side
        reading = asyncio.ensure_future(connection.receive())
        answer = asyncio.ensure_future(joining.answered.wait())
        try:
            while True:
                for event in side.events():  # what is written to a file comes before what is sent
                    self._happened(event, joining, token_id, where)
                await connection.send(side.take_output())
                if side.over:
                    return
                due = side.next_timer()
                timeout = None if due is None else max(0.0, due - self._clock.now())
                done, _ = await asyncio.wait({reading, answer}, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
                side.handle_timer(self._clock.now())
                if answer in done:
                    joining.answered.clear()
                    answer = asyncio.ensure_future(joining.answered.wait())
                if reading in done:
                    if data := reading.result():
                        side.receive(data, self._time_for(token_id))
                    else:
                        side.lost()
                    reading = asyncio.ensure_future(connection.receive())
        finally:
            for task in (reading, answer):
                task.cancel()
            await asyncio.gather(reading, answer, return_exceptions=True)

    def _time_for(self, token_id: bytes) -> float | None:
        if self._membership.wall() is None:
            return None
        return self._authority.wall_for(self.progress(token_id).module)

    def _happened(self, event: JoinEvent, joining: _Joining, token_id: bytes, where: str) -> None:
        if isinstance(event, CodeShown):
            self._authority.save_tokens()  # it is used from here on, also after a crash
            self._step(token_id, JoinState.CODE, code=event.code, module=event.module)
            _log.info("= %s at %s joins: the code is %s %s", event.module, where, event.code[:3], event.code[3:])
            invitation = self._authority.book.find(token_id)
            if invitation is not None and invitation.unattended:
                joining.side.agree(self._authority.wall_for(event.module))
                joining.answered.set()
        elif isinstance(event, Joined):
            self._authority.was_issued(event.module, verify(event.certificate, event.ca, None).public_key)
            self._step(token_id, JoinState.JOINED, module=event.module)
            _log.info("+ %s at %s has joined", event.module, where)
        else:
            self._step(token_id, JoinState.REFUSED, reason=event.reason, text=event.text)
            _log.warning("! the join by %s failed (%s): %s", where, event.reason, event.text)

    async def _renew(self, sock: socket.socket, where: str) -> None:
        store = self._membership.store
        context = renewal_context(
            store.path(files_of.CERTIFICATE), store.path(files_of.KEY), self._membership.files.ca, server_side=True
        )
        connection = await self._handshake(sock, context)
        async with asyncio.timeout(limits.JOIN_STEP_TIMEOUT):
            message = await one_message(connection)
            answer = self._renewed(connection.certificate(), message, where)
            await connection.send(encode_renewal(answer))
            with contextlib.suppress(OSError):
                await connection.receive()  # its end: the answer has arrived

    def _renewed(self, presented: bytes, message: object, where: str) -> RenewalGrant | RenewalRefused:
        if not isinstance(message, Renew):
            return RenewalRefused("malformed", "a renewal begins with a request")
        try:
            before = self._authority.judge_renewal(presented)
            _, certificate = self._authority.issue(message.request, before.name)
        except CertificateError as error:
            text = f"a renewal by {where} is refused ({error.reason.label}): {error}"
            self._refuse("trust.renewal_refused", where.partition(":")[0], text)
            return RenewalRefused(error.reason.label, str(error))
        except RmpaError as error:
            return RenewalRefused("clock", str(error))
        _log.info("= %s at %s has a new certificate; it was away", before.name, where)
        secrets = self._authority.secrets
        return RenewalGrant(certificate, secrets.keys, secrets.deny)


def _host(sock: socket.socket) -> str:
    """The address of the other end; empty if it is gone, or of this machine by a Unix socket."""
    try:
        peer = sock.getpeername()
    except OSError:
        return ""
    return str(peer[0]) if isinstance(peer, tuple) else ""
