"""An agent's part in a secured mesh: spreads documents, renews its certificate, and answers ``rmpa trust``."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import inspect
import logging
import os
import random
import socket
import time
from functools import partial
from ipaddress import IPv4Address
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge.messages import convert
from rmpa.bridge.policy import Needs
from rmpa.bridge.sessions import Part, PeerSession
from rmpa.config.module_name import state_dir
from rmpa.core.errors import (
    ConfigError,
    PeerRefused,
    RemoteProtocolError,
    RmpaError,
    StartError,
    UnreachableError,
    missing_extra,
)
from rmpa.core.log import RefusalLog
from rmpa.core.timers import Backoff, TokenBucket
from rmpa.discovery.network import list_interfaces
from rmpa.runtime.systemd import restart_text
from rmpa.runtime.tasks import end_tasks, keep_task
from rmpa.trust import limits
from rmpa.trust.permissions import (
    HAVE,
    Document,
    Have,
    InviteReply,
    JoinStep,
    TrustReply,
    TrustStatus,
    host_names,
    page_hosts,
)
from rmpa.trust.store import AuthorityPlace, TrustStore, check_open

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.bridge.bridge import Bridge
    from rmpa.config.settings import Settings
    from rmpa.core.identity import Identity
    from rmpa.runtime.loop import SystemClock
    from rmpa.trust.joining import JoinServer
    from rmpa.trust.membership import Membership, MeshAuthority

_log = logging.getLogger(__name__)

# The request for a certificate, at the authority: ``{"request": BASE64}`` to ``{"certificate": BASE64}``.
RENEW: Final = "trust.renew"
_ABOUT: Final = "a message about trust"
NOT_AUTHORITY: Final = "this module is not the authority of its mesh"


def trust_store(settings: Settings) -> TrustStore | None:
    """Where the module's files of trust are; ``None``: there is no state directory."""
    place = state_dir(os.environ, settings.state_dir)
    return TrustStore(place, settings.name) if place is not None else None


def restart_to_join(settings: Settings) -> str:
    """How to restart this agent, which runs without trust, if its module has keys; else empty."""
    with contextlib.suppress(StartError):
        if (store := trust_store(settings)) is not None and store.exists:
            return restart_text()
    return ""


def open_membership(settings: Settings, clock: SystemClock) -> Membership | None:
    """What this module has as a member of a secured mesh; ``None``: trust is off.

    Raises:
        StartError: Its files are broken, the library is missing, or trust is off and ``trust.require`` is set; or
            trust is off, other modules of this user have keys, and ``trust.insecure`` is not set.
    """
    store = trust_store(settings)
    if store is None or not store.exists:
        check_open(settings.trust, state_dir(os.environ, settings.state_dir), settings.name, os.environ)
        return None
    try:
        from rmpa.trust.membership import Membership  # noqa: PLC0415 - its library takes memory: only when needed
    except ModuleNotFoundError as error:
        missing = f"the library {error.name} is not installed, but this module has joined a secured mesh"
        raise StartError(str(store.folder), missing, missing_extra("trust"), code="extra-missing") from None
    membership = Membership.load(store, clock)
    if membership.name != settings.name:
        text = f"is of {membership.name}, but this agent is named {settings.name}"
        remedy = f"start it with --name {membership.name}, or let it join: rmpa trust leave, rmpa trust join TOKEN"
        raise StartError(str(store.path("module.crt")), text, remedy, code="certificate-trouble")
    return membership


class AgentTrust(Part):
    """The part of a bridge that keeps a membership up to date; it exists only in a secured mesh.

    Args:
        settings: The agent's.
        membership: This module's.
        bridge: Its sessions and requests; counts ``trust.document_refused``.
        clock: Monotonic seconds.

    Raises:
        StartError: A file of the authority is broken.

    Attributes:
        authority: What the authority has; ``None``: this module is not it.
        joins: The joins at the authority.
    """

    # More than 12 fields: documents, renewals of others and the renewal of its own need all of the membership.

    def __init__(self, settings: Settings, membership: Membership, bridge: Bridge, clock: SystemClock) -> None:
        from rmpa.trust.joining import JoinServer  # noqa: PLC0415
        from rmpa.trust.membership import MeshAuthority  # noqa: PLC0415 - as in ``open_membership``

        self.membership = membership
        self._settings = settings
        self._bridge = bridge
        self._clock = clock
        self._refusals = RefusalLog(_log, bridge.counters)
        self._hosts_asked: tuple[str, ...] = ()
        # The numbers of the documents that each linked peer has, as far as it has said; what was sent counts.
        self._had: dict[int, dict[Document, int]] = {}
        self._authority_peer: PeerSession | None = None
        self.authority: MeshAuthority | None = None
        self.joins: JoinServer | None = None
        if membership.store.is_authority:
            self.authority = MeshAuthority(membership, self._is_linked)
            self.joins = JoinServer(self.authority, clock, bridge.counters)
        self._backoff = Backoff(limits.RENEWAL_RETRY_FIRST, limits.RENEWAL_RETRY_CAP, random.random)
        self._retry_at = 0.0
        self._renewals: dict[str, TokenBucket] = {}
        self._wake = asyncio.Event()
        self._renewing: asyncio.Task[None] | None = None
        self._problem = ""
        bridge.rpc.on_notification(HAVE, self._have, Needs((), "numbers of the documents that each member has"))
        signed = Needs((), "a document holds by the signature of the mesh's authority")
        bridge.rpc.on_notification(Document.DENY.notice, partial(self._document, Document.DENY), signed)
        bridge.rpc.on_notification(Document.KEYS.notice, partial(self._document, Document.KEYS), signed)
        own = Needs((), "the certificate for the peer's own certified name, unless that is revoked")
        bridge.rpc.on_request(RENEW, self._renew_other, own)

    def start(self) -> None:
        """Look after the certificate from now on."""
        self._renewing = keep_task(self._look_after, "renew the certificate")

    async def close(self) -> None:
        """End the renewal of the certificate."""
        await end_tasks(self._renewing)
        self._renewing = None

    def notes(self) -> tuple[str, ...]:
        """What the user should do something about."""
        from rmpa.trust.joining import problems_of  # noqa: PLC0415

        found = problems_of(self.membership, self.authority_name())
        return (*found, self._problem) if found and self._problem else found

    def status(self) -> TrustStatus:
        """The state, as ``rmpa trust status`` and the snapshot show it."""
        from rmpa.trust.joining import status_of  # noqa: PLC0415

        linked, name = self.linked(), self.authority_name()
        return status_of(self.membership, self.authority, agent="secured", linked=linked, authority_name=name)

    def linked(self) -> set[str]:
        """The names of the linked modules."""
        return {session.link.name for session in self._bridge.sessions.linked()}

    def link_up(self, session: PeerSession) -> None:
        """Tell a new link what this module has."""
        self._had[session.peer] = {}
        member = self.membership
        have = Have(member.deny.number, member.keys.number, self.authority is not None)
        self._bridge.rpc.notify(session, HAVE, msgspec.to_builtins(have))

    def link_down(self, session: PeerSession) -> None:
        """Forget what the peer has."""
        self._had.pop(session.peer, None)
        if not session.linked:
            self.gone(session)

    def gone(self, session: PeerSession) -> None:
        """Forget that the peer was the authority's module."""
        if self._authority_peer is session:
            self._authority_peer = None

    def _have(self, session: PeerSession, args: dict[str, Any]) -> None:
        have, name = convert(_ABOUT, args, Have), session.link.name
        if have.authority and self.authority is None:
            if name == self.membership.keys.authority:
                self._authority_found(session)
            else:
                self._refuse("trust.no_authority", name, f"{name} says that it is the authority, which it is not")
        self._note(session, have.numbers)
        self.spread()

    def _document(self, kind: Document, session: PeerSession, args: dict[str, Any]) -> None:
        data, name = convert(_ABOUT, args.get("document"), str).encode(), session.link.name
        try:
            newer = self.membership.accept_document(kind, data)
        except RemoteProtocolError as error:
            self._refuse("trust.document_refused", name, f"{name} sent a document that does not hold: {error}")
            return
        if newer:
            number = self.membership.number(kind)
            self._note(session, {kind: number})
            _log.info("= %s %d by %s", kind, number, name)
            self.spread()

    def _refuse(self, counter: str, name: str, text: str) -> None:
        self._refusals.refuse(self._clock.now(), counter, name, text)

    def _note(self, session: PeerSession, numbers: Mapping[Document, int]) -> None:
        """Take in that a peer has these documents, as it says or as it sent them."""
        had = self._had.get(session.peer, {})
        had.update({kind: max(number, had.get(kind, 0)) for kind, number in numbers.items()})

    def spread(self) -> None:
        """Send newer documents to all that lack them.

        Each module tells a new link the numbers of its documents; the side with a higher number sends that document.
        A module that takes a newer one sends it on. So a document is everywhere after as many trips as the mesh is
        wide, and in a mesh that was split once it is whole again.
        """
        for session in self._bridge.sessions.linked():
            had = self._had.get(session.peer, {})
            for kind in Document:
                number = self.membership.number(kind)
                if had.get(kind, number) < number:
                    had[kind] = number
                    document = self.membership.document(kind).decode()
                    self._bridge.rpc.notify(session, kind.notice, {"document": document})

    def _authority_found(self, session: PeerSession) -> None:
        self._authority_peer = session
        place = AuthorityPlace(session.link.name, session.link.remote_endpoint[0], session.link.guid.port)
        store = self.membership.store
        if store.load_authority() != place:
            try:
                store.save_authority(place)
            except StartError as error:
                _log.warning("! %s [%s]", error, error.code)
        self.look_now()

    def look_now(self) -> None:
        """See at once whether the certificate is to be renewed: something has changed since the last attempt."""
        self._retry_at = 0.0
        self._wake.set()

    async def _look_after(self) -> None:
        while True:
            self._wake.clear()  # before the look: what changes meanwhile is looked at, too
            await self._look()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), limits.RENEWAL_LOOK)

    async def _look(self) -> None:
        wall = self.membership.wall()
        if wall is None or self._clock.now() < self._retry_at:
            return
        if wall < self.membership.certificate.renew_at and not self._lacks_hosts():
            return
        try:
            await self.renew()
        except RmpaError as error:
            delay = self._backoff.delay()
            self._retry_at = self._clock.now() + delay
            self._problem = f"the last attempt to renew it: {error}"
            _log.warning(
                "! the certificate is not renewed: %s; tried again in %.0f s [certificate-trouble]", error, delay
            )

    def _lacks_hosts(self) -> bool:
        """Whether the certificate is not for a name or address of this machine, and the authority may be asked.

        It is asked once for the same ones: it may refuse some. Only a link serves for that, so that a module which is
        away does not dial for it.
        """
        hosts = self.page_hosts()
        missing = set(hosts) - self.membership.certificate.hosts
        linked = self._authority_peer is not None and self._authority_peer.linked
        return bool(missing) and hosts != self._hosts_asked and (self.authority is not None or linked)

    async def renew(self) -> None:
        """Renew the certificate now.

        Raises:
            RmpaError: The authority cannot be reached, or refuses.
        """
        if self.authority is not None:
            self._hosts_asked = self.page_hosts()
            self.authority.renew_own(self._hosts_asked)
        elif self._authority_peer is not None and self._authority_peer.linked:
            await self._renew_by_link(self._authority_peer)
        else:
            await self._renew_by_dial()
        self._backoff.reset()
        self._problem = ""
        expires = time.localtime(self.membership.certificate.expires)
        _log.info("= the certificate is renewed until %s", time.strftime("%Y-%m-%d %H:%M", expires))

    async def _renew_by_link(self, session: PeerSession) -> None:
        hosts = self.page_hosts()
        request = {"request": base64.b64encode(self.membership.request(hosts)).decode()}
        reply = await self._bridge.rpc.request(session, RENEW, request, limits.JOIN_STEP_TIMEOUT)
        self.membership.renewed(convert(_ABOUT, reply.get("certificate") if isinstance(reply, dict) else None, bytes))
        self._hosts_asked = hosts

    async def _renew_by_dial(self) -> None:
        from rmpa.trust.joining import renew_at_authority  # noqa: PLC0415

        place = self.membership.store.load_authority()
        if place is None:
            raise UnreachableError("authority", "any link", "start its agent; rmpa peer list shows the links")
        await renew_at_authority(self.membership, place.address, place.port)
        self.spread()

    def _renew_other(self, session: PeerSession, args: dict[str, Any]) -> dict[str, str]:
        """Renew the certificate of a linked module."""
        if self.authority is None:
            raise RmpaError(NOT_AUTHORITY, code="not-authority")
        name = session.link.name
        presented = session.link.connection.certificate
        if presented is not None:
            self.membership.judge_member(presented, name)  # it may have been revoked, and its link is ending
        while len(self._renewals) >= limits.ISSUED_MAX and name not in self._renewals:
            del self._renewals[next(iter(self._renewals))]
        bucket = self._renewals.setdefault(name, TokenBucket(limits.RENEWALS_RATE, limits.RENEWALS_BURST))
        if not bucket.take(self._clock.now()):
            raise RmpaError(f"{name} asks for certificates too often: once a minute is allowed")
        _, certificate = self.authority.issue(convert(_ABOUT, args.get("request"), bytes), name)
        _log.info("= %s has a new certificate", session.link.name)
        return {"certificate": base64.b64encode(certificate).decode()}

    def page_hosts(self) -> tuple[str, ...]:
        """The names and addresses by which this module's page is opened; a gateway has none."""
        if self._settings.relay:
            return ()
        addresses = [str(address) for interface in list_interfaces() for address in interface.addresses]
        return page_hosts((*host_names(socket.gethostname()), *self._settings.web.hosts, *sorted(addresses)))

    def authority_name(self) -> str:
        """The name of the authority, as far as it is known; empty: it is not."""
        if self.authority is not None:
            return self.membership.name
        return self._authority_peer.link.name if self._authority_peer is not None else ""

    def _is_linked(self, name: str) -> bool:
        """Whether a module of a name is linked, or is this one; upper and lower case are the same."""
        return name.casefold() in {each.casefold() for each in (self.membership.name, *self.linked())}


Args = dict[str, object]


_COMMANDS: Final = ("status", "invite", "step", "withdraw", "renew", "rotate", "revoke", "sign")


class TrustCommands:
    """The commands of ``rmpa trust`` that an agent answers; without trust only ``status``.

    Args:
        settings: The agent's.
        part: Its part in a secured mesh; ``None``: trust is off.
        place: This module's place in the network; ``None`` while it has none.
    """

    def __init__(self, settings: Settings, part: AgentTrust | None, place: Callable[[], Identity | None]) -> None:
        self._settings = settings
        self._part = part
        self._own_place = place

    async def answer_command(self, args: Args) -> object:
        """``what``: the name of one of the methods below; the other arguments are its own.

        Raises:
            RmpaError: It is refused; the text is for the user.
        """
        what = str(args.get("what", ""))
        if what not in _COMMANDS:
            raise ConfigError("what", f"{what!r} is no command of trust")
        reply = getattr(self, what)(args)
        return await reply if inspect.isawaitable(reply) else reply

    @property
    def _trust(self) -> AgentTrust:
        if self._part is None:
            begin = "rmpa trust init, or rmpa trust join TOKEN; then restart it"
            restart = restart_to_join(self._settings)
            remedy = f"it has joined since it started; restart it: {restart}" if restart else begin
            raise PeerRefused(f"agent {self._settings.name}", "it runs without trust", remedy, code="not-a-member")
        return self._part

    def status(self, _args: Args) -> TrustStatus:
        """The state, as ``rmpa trust status`` shows it."""
        return self._part.status() if self._part is not None else self._plain()

    def _plain(self) -> TrustStatus:
        name, store = self._settings.name, trust_store(self._settings)
        joined, folder = store is not None and store.exists, str(store.folder) if store is not None else ""
        problems = (f"the agent {name} runs without its keys; restart it: {restart_text()}",) if joined else ()
        return TrustStatus(on=False, module=name, folder=folder, agent="plain", problems=problems)

    def invite(self, args: Args) -> InviteReply:
        """Make a token: ``name``, ``lifetime``, ``address`` and ``port``, each with a default."""
        authority = self._authority()
        lifetime = args.get("lifetime") or limits.TOKEN_LIFETIME
        if not isinstance(lifetime, int | float) or not 0 < lifetime <= limits.TOKEN_LIFETIME_MAX:
            raise ConfigError("--for", f"a token is valid for at most {limits.TOKEN_LIFETIME_MAX / 86_400:.0f} d")
        address, port = self._place(args)
        try:
            token = authority.invite(IPv4Address(address), port, float(lifetime), str(args.get("name") or ""))
        except ValueError as error:
            remedy = "give --address as the other machine reaches this one, and --name as modules have it"
            raise ConfigError("rmpa trust invite", str(error), remedy) from None
        return InviteReply(token=token.serialize(), id=token.token_id.hex(), expires=token.expires)

    def _place(self, args: Args) -> tuple[str, int]:
        """Where a joining module reaches this one: as the user says, else as beacons say."""
        identity, address, port = self._own_place(), args.get("address"), args.get("port")
        if identity is None:
            raise UnreachableError("network", "this agent", "it has no address at this moment; try again")
        return str(address or identity.guid.address), port if isinstance(port, int) else identity.guid.port

    async def step(self, args: Args) -> JoinStep:
        """What came of a token: ``id``; ``after``: the last step that is known, the next one is awaited."""
        self._authority()
        joins, token_id, after = self._trust.joins, _token_id(args), args.get("after")
        assert joins is not None  # noqa: S101 - the authority has one
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(5.0):  # then ``rmpa trust invite`` asks again
                while isinstance(after, int) and joins.step(token_id).step <= after:
                    await joins.changed.wait()
        return joins.step(token_id)

    def withdraw(self, args: Args) -> TrustReply:
        """Make a token void: ``id``."""
        return TrustReply(module="", done=self._authority().withdraw(_token_id(args)))

    async def renew(self, _args: Args) -> TrustReply:
        """Renew this module's certificate now."""
        await self._trust.renew()
        member = self._trust.membership
        return TrustReply(module=member.name, done=True, expires=int(member.certificate.expires))

    def rotate(self, _args: Args) -> TrustReply:
        """Make a new group key."""
        number = self._authority().rotate()
        self._trust.spread()
        return TrustReply(module=self._trust.membership.name, done=True, number=number)

    def revoke(self, args: Args) -> TrustReply:
        """Revoke a module: ``name``; ``force``: also if no certificate of that name is known."""
        name = str(args.get("name", ""))
        try:
            deny = self._authority().revoke_known(name, self._trust.linked(), force=args.get("force") is True)
        finally:
            self._trust.spread()  # what was made holds here, so it must hold everywhere
        _log.warning("= %s is revoked (deny list %d); there is a new group key [member-revoked]", name, deny.number)
        return TrustReply(module=name, done=True, number=deny.number)

    def sign(self, args: Args) -> dict[str, str]:
        """Answer a join by files: ``request`` in base64, ``module``: a member that may join again.

        The reply has the module's name and the file's content.
        """
        try:
            request = base64.b64decode(str(args.get("request", "")), validate=True)
        except ValueError:
            raise ConfigError("request", "is not in base64") from None
        again = str(args.get("module") or "")
        asked, answer = self._authority().join_file(request, again)
        return {
            "module": asked.name,
            "key": asked.key_hash[: limits.FINGERPRINT_BYTES].hex(),
            "answer": msgspec.json.encode(answer).decode(),
        }

    def _authority(self) -> MeshAuthority:
        trust = self._trust
        if trust.authority is None:
            name = trust.authority_name()
            remedy = f"do it at {name}" if name else "do it at the authority"
            raise PeerRefused(f"agent {trust.membership.name}", NOT_AUTHORITY, remedy, code="not-authority")
        return trust.authority


def _token_id(args: Args) -> bytes:
    """The argument ``id``.

    Raises:
        ConfigError: It is no id of a token.
    """
    try:
        return bytes.fromhex(str(args.get("id", "")))
    except ValueError:
        raise ConfigError("id", f"{args.get('id')!r} is no id of a token") from None
