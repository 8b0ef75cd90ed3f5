"""Answers ``rmpa trust …`` on the control socket of a secured agent."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import inspect
import logging
from ipaddress import IPv4Address
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.agent.trust import NOT_AUTHORITY, trust_store
from rmpa.core.errors import ConfigError, PeerRefused, UnreachableError
from rmpa.trust import limits
from rmpa.trust.joining import InviteReply, JoinStep, TrustReply, TrustStatus

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.agent.trust import AgentTrust
    from rmpa.bridge.bridge import Bridge
    from rmpa.config.settings import Settings
    from rmpa.core.identity import Identity
    from rmpa.trust.authority import MeshAuthority

_log = logging.getLogger(__name__)
_STEP_WAIT: Final = 5.0
"""Seconds for which ``rmpa trust invite`` is kept waiting for the next step of a join; then it asks again."""
Args = dict[str, object]


class PlainOperations:
    """The commands that an agent without trust answers: its state, and that it must be started again.

    Args:
        settings: The agent's settings.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    async def answer_command(self, args: Args) -> TrustStatus:
        """``what``: only ``status``.

        Raises:
            PeerRefused: It is another one.
        """
        name, store = self._settings.name, trust_store(self._settings)
        joined = store is not None and store.exists
        restart = "it has joined since it started: start it again"
        if args.get("what") != "status":
            remedy = restart if joined else "rmpa trust init, or rmpa trust join TOKEN; then start it again"
            raise PeerRefused(f"agent {name}", "it runs without trust", remedy)
        problems = (f"the agent {name} still runs without trust: {restart}",) if joined else ()
        folder = str(store.folder) if store is not None else ""
        return TrustStatus(on=False, module=name, folder=folder, agent="plain", problems=problems)


class TrustOperations:
    """The commands that a secured agent answers.

    Args:
        trust: Its part in the mesh.
        bridge: Its sessions.
        identity: Its place in the network; ``None`` while it has none.
    """

    def __init__(self, trust: AgentTrust, bridge: Bridge, identity: Callable[[], Identity | None]) -> None:
        self._trust = trust
        self._bridge = bridge
        self._identity = identity
        self._handlers: dict[str, Callable[[Args], object]] = {
            "status": self.status,
            "invite": self.invite,
            "step": self.step,
            "withdraw": self.withdraw,
            "renew": self.renew,
            "rotate": self.rotate,
            "revoke": self.revoke,
            "sign": self.sign,
        }

    async def answer_command(self, args: Args) -> object:
        """``what``: the name of one of the methods below; the other arguments are its own.

        Raises:
            RmpaError: It is refused; the text is for the user.
        """
        what = str(args.get("what", ""))
        handler = self._handlers.get(what)
        if handler is None:
            raise ConfigError("what", f"{what!r} is no command of trust")
        reply = handler(args)
        return await reply if inspect.isawaitable(reply) else reply

    def status(self, _args: Args) -> TrustStatus:
        """The state, as ``rmpa trust status`` shows it."""
        return self._trust.status()

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
        identity, address, port = self._identity(), args.get("address"), args.get("port")
        if identity is None:
            raise UnreachableError("network", "this agent", "it has no address at this moment; try again")
        return str(address or identity.guid.address), port if isinstance(port, int) else identity.guid.port

    async def step(self, args: Args) -> JoinStep:
        """What came of a token: ``id``; ``after``: the last step that is known, the next one is awaited."""
        self._authority()
        joins, token_id, after = self._trust.joins, _token_id(args), args.get("after")
        assert joins is not None  # noqa: S101 - the authority has one
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_STEP_WAIT):
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
        linked = {session.link.name for session in self._bridge.sessions.linked()}
        try:
            deny = self._authority().revoke_known(name, linked, force=args.get("force") is True)
        finally:
            self._trust.spread()  # what was made holds here, so it must hold everywhere
        _log.warning("= %s is revoked (deny list %d); there is a new group key", name, deny.number)
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
        asked, answer = self._authority().join_file(request, again, self._trust.is_linked)
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
            raise PeerRefused(f"agent {trust.membership.name}", NOT_AUTHORITY, remedy)
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
