"""What every agent needs of trust, without its library: permissions, refusals, status, hosts of a page.

Decides what another module may do here, by the rules of ``[[permission]]``, and names the rule that decided.

A rule fits if it is about the module (by a glob over its name, or a group) and one of its globs fits the name. A deny
that fits wins over an allow, whatever the order of the rules; if none fits, ``trust.default`` holds.
"""

from __future__ import annotations

import ipaddress
import re
from enum import IntEnum, StrEnum
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import msgspec

from rmpa.config.peer_rules import ACTION_CLIENT, ACTION_SERVER, Access, Effect, PermissionRule
from rmpa.config.values import PEER
from rmpa.core import codes
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import matches
from rmpa.core.limits import UINT32_MAX
from rmpa.trust import limits

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.config.settings import TrustSettings

# An action's topics that its client publishes (wiki.ros.org/actionlib/DetailedDescription).
_CLIENT_SENDS: Final = ("goal", "cancel")
# An action's topics that its server publishes.
_SERVER_SENDS: Final = ("status", "feedback", "result")
_ACTION_TOPICS: Final = {
    (ACTION_CLIENT, Access.PUBLISH): _CLIENT_SENDS,
    (ACTION_CLIENT, Access.SUBSCRIBE): _SERVER_SENDS,
    (ACTION_SERVER, Access.PUBLISH): _SERVER_SENDS,
    (ACTION_SERVER, Access.SUBSCRIBE): _CLIENT_SENDS,
}


class PermissionDecision(NamedTuple):
    """Whether a module may do something here, and the rule that decided.

    Attributes:
        allowed: Whether it may.
        rule: The rule as text: ``[[permission]] 2 denies call of '/motors/**' to '*'``.
        number: The number of the rule in the file, from 1; ``None``: ``trust.default`` decided.
    """

    allowed: bool
    rule: str
    number: int | None = None


class Permissions:
    """The permissions of other modules in this one.

    Args:
        settings: The rules, the groups and the default.
    """

    def __init__(self, settings: TrustSettings) -> None:
        self._known: dict[str, dict[Access, list[tuple[str, PermissionDecision]]]] = {}
        self.reload(settings)

    def reload(self, settings: TrustSettings) -> None:
        """Judge by other rules from now on."""
        self._settings = settings
        self._groups = {group.name: group.modules for group in settings.groups}
        self._known.clear()

    @property
    def direct(self) -> bool:
        """Whether nodes may connect to those of other machines directly, in plain text (``trust.direct``)."""
        return self._settings.direct

    def judge(self, access: Access, module: str, name: str) -> PermissionDecision:
        """Decide whether a module may do something.

        Args:
            access: What it would do.
            module: Its name, as its certificate proves it.
            name: The topic, service, parameter or node, by its name here.
        """
        for glob, decision in self._decisions(module)[access]:
            if matches(glob, name):
                return decision
        if self._settings.default == Effect.ALLOW and access is not Access.LAUNCH:
            return PermissionDecision(True, 'no [[permission]] fits, and trust.default = "allow"')
        return PermissionDecision(False, f"no [[permission]] lets {asker_name(module)} {access.verb} {name}")

    def judge_all(self, access: Access, askers: str, name: str) -> PermissionDecision | None:
        """The decision about a name that holds for all modules alike, however they are called; ``None``: it differs.

        Args:
            access: What they would do.
            askers: What the text calls them, which is no name of a module: ``any other site``.
            name: As for ``judge``.
        """
        common = self.judge(access, askers, name)
        if not common.allowed and common.number is not None:
            return common  # a denial to all
        other = Effect.DENY if common.allowed else Effect.ALLOW
        globs = ((key, glob) for rule in self._settings.rules if rule.effect is other for key, glob in _globs(rule))
        asked = (each for key, glob in globs for each in _accesses(key, glob.replace(PEER, "*")))
        return None if any(what is access and matches(glob, name) for what, glob in asked) else common

    def may_relay(self, module: str) -> PermissionDecision:
        """Decide whether a module may pass on what others offer: the origin that it names cannot be proved."""
        for glob in self._settings.relays:
            if matches(glob, module):
                return PermissionDecision(True, f"trust.relays has {glob!r}")
        return PermissionDecision(False, f"trust.relays does not have {module}")

    def knows(self, module: str) -> bool:
        """Whether a module may do anything, as far as rules say."""
        found = self._decisions(module).values()
        return self._settings.default == Effect.ALLOW or any(each.allowed for rules in found for _, each in rules)

    def groups_of(self, module: str) -> tuple[str, ...]:
        """The groups that a module is in, in the order of the file."""
        return tuple(name for name, globs in self._groups.items() if _first(globs, module) is not None)

    def _decisions(self, module: str) -> dict[Access, list[tuple[str, PermissionDecision]]]:
        """By access: the globs of the rules about a module, each with its decision; those that deny first."""
        known = self._known.get(module)
        if known is None:
            if len(self._known) >= limits.MODULES_REMEMBERED:
                self._known.clear()
            known = self._known[module] = {access: [] for access in Access}
            for number, rule in enumerate(self._settings.rules, 1):
                askers, allowed = self._fit(rule, module), rule.effect is Effect.ALLOW
                verb = f"{number} {'allows' if allowed else 'denies'}"
                for key, written in _globs(rule) if askers is not None else ():
                    text = f"[[permission]] {verb} {key} of {written!r} to {askers}"
                    for access, glob in _accesses(key, written.replace(PEER, module)):
                        known[access].append((glob, PermissionDecision(allowed, text, number)))
            for found in known.values():
                found.sort(key=lambda each: each[1].allowed)  # stable: among equals the order of the file stays
        return known

    def _fit(self, rule: PermissionRule, module: str) -> str | None:
        """Why a rule is about a module, as text; ``None``: it is not."""
        glob = _first(rule.modules, module)
        if glob is not None:
            return repr(glob)
        for name in rule.groups:
            if _first(self._groups.get(name, ()), module) is not None:
                return f"group {name!r}"
        return None


def asker_name(asker: str) -> str:
    """How a module or site is named in texts; an empty one is a program at a router that names none."""
    return asker or "a program without a site"


def refusal(access: Access, module: str, name: str, where: str = "there") -> str:
    """What a refused module is told: that it may not, and nothing of the rules."""
    return f"the permissions {where} do not let {asker_name(module)} {access.verb} {name}"


def prohibition(access: Access, module: str, name: str) -> str:
    """That a module may not do something: ``arm2 may not publish /cmd_vel``."""
    return f"{asker_name(module)} may not {access.verb} {name}"


def action_topics(key: str, name: str) -> Iterator[tuple[Access, str]]:
    """The five topics of an action, each with what the other module does with it.

    Args:
        key: ``ACTION_CLIENT`` if the other module is the client, ``ACTION_SERVER`` if it is the server.
        name: The action's name, or a glob.
    """
    for access in (Access.PUBLISH, Access.SUBSCRIBE):
        for topic in _ACTION_TOPICS[key, access]:
            yield access, f"{name.rstrip('/')}/{topic}"


def _globs(rule: PermissionRule) -> Iterator[tuple[str, str]]:
    """Each glob of a rule, with the key that it stands behind."""
    return ((key, glob) for key, globs in rule.names.items() for glob in globs)


def _accesses(key: str, glob: str) -> Iterable[tuple[Access, str]]:
    """What a glob behind a key of a rule is about: an action's topics, or the glob itself."""
    return action_topics(key, glob) if key in (ACTION_CLIENT, ACTION_SERVER) else ((Access[key.upper()], glob),)


def _first(globs: tuple[str, ...], name: str) -> str | None:
    """The first glob that fits."""
    return next((glob for glob in globs if matches(glob, name)), None)


# How signed documents reach every module: each peer is sent those that it lacks.


class Document(StrEnum):
    """The signed documents, in the order in which they are sent: a module that was revoked gets no new key."""

    # The deny list.
    DENY = "deny"
    # The list of group keys.
    KEYS = "keys"

    @property
    def notice(self) -> str:
        """The notification that brings it: ``{"document": TEXT}``."""
        return f"trust.{self}"


# The notification of what a module has, as ``Have``.
HAVE: Final = "trust.have"


class Have(msgspec.Struct, frozen=True, omit_defaults=True):
    """The numbers of the documents that the sender has, and whether it is the authority."""

    deny: Annotated[int, msgspec.Meta(ge=0, le=UINT32_MAX)]
    keys: Annotated[int, msgspec.Meta(ge=0, le=UINT32_MAX)]
    authority: bool = False

    @property
    def numbers(self) -> dict[Document, int]:
        """The numbers by document."""
        return {Document.DENY: self.deny, Document.KEYS: self.keys}


# The reasons for which a secured mesh refuses a connection. One word each, for wire, counters, commands and logs.


class TrustReason(IntEnum):
    """Why a connection is refused; the numbers continue those of ``mesh.frames.Refusal`` on the wire."""

    # The dialler does not use TLS, and this mesh does.
    PLAIN = 11
    # The acceptor has not joined a secured mesh, and the dialler has.
    UNSECURED = 12
    # The group key of its packets is unknown.
    KEY = 13
    # A certificate begins in the future.
    CLOCK = 14
    # The certificate is of another CA.
    FOREIGN = 15
    # The certificate's time is over.
    EXPIRED = 16
    # The certificate is on the deny list.
    REVOKED = 17
    # The certificate is of another module than the hello says.
    NAME = 18
    # The connection does not use TLS 1.3 with this protocol.
    DOWNGRADE = 19

    @property
    def label(self) -> str:
        """The word for people and counters: ``expired``."""
        return self.name.lower()

    @property
    def remedy(self) -> str:
        """What to do, as a sentence part."""
        return _REMEDIES[self]


_REMEDIES: Final = {
    TrustReason.PLAIN: "it joins by rmpa trust join TOKEN, with a token of rmpa trust invite at the authority",
    TrustReason.UNSECURED: "it joins by rmpa trust join TOKEN, with a token of rmpa trust invite at the authority",
    TrustReason.KEY: "are both of one mesh? the one that was away for long: rmpa trust renew there",
    TrustReason.CLOCK: "set both clocks: date, timedatectl",
    TrustReason.FOREIGN: "they have joined different meshes: rmpa trust join on one, with a token of the other's",
    TrustReason.EXPIRED: "rmpa trust renew on the module whose certificate it is, while the authority is reachable",
    TrustReason.REVOKED: "it can come back by rmpa trust invite at the authority, and rmpa trust join there",
    TrustReason.NAME: "start the module with the name that it joined with, or let it join again",
    TrustReason.DOWNGRADE: "install the same release of rmpa on both",
}


# Why a module is not of this mesh, and what to do; behind a semicolon, as for ``Check.from_message``.
NOT_OF_THIS_MESH: Final = {
    TrustReason.PLAIN: "it has joined a secured mesh and this module has not; join it by rmpa trust join TOKEN here, "
    "with a token of rmpa trust invite at the authority of that mesh",
    TrustReason.UNSECURED: "it has not joined this secured mesh; let it join by rmpa trust invite at the authority "
    "and rmpa trust join TOKEN there",
    TrustReason.FOREIGN: "it has joined another secured mesh; to have both in one, rmpa trust leave and rmpa trust "
    "join TOKEN there, with a token of the authority here",
    TrustReason.KEY: "its group key is unknown here; if it has joined another mesh, rmpa trust leave and rmpa trust "
    "join TOKEN there; if it is of this one, rmpa trust renew here",
}


def not_of_this_mesh(reason: TrustReason) -> str:
    """``not of this mesh: it has not joined this secured mesh; let it join by …``."""
    return f"not of this mesh: {NOT_OF_THIS_MESH[reason]}"


class TrustError(RemoteProtocolError):
    """A secured mesh refuses a connection, a certificate or a request.

    Args:
        reason: The word for it.
        text: What is wrong.
    """

    def __init__(self, reason: TrustReason, text: str) -> None:
        super().__init__(text, code=codes.of_counter(f"link.refused.{reason.label}"))
        self.reason = reason


# What ``rmpa trust status`` and the other commands show. No part is a secret.


class MemberInfo(msgspec.Struct, kw_only=True, frozen=True):
    """A module that the authority has given a certificate.

    Attributes:
        name: The module's.
        issued: When its last certificate was issued, seconds since 1970.
        expires: When that ends.
        linked: Whether it is linked with the authority now; ``None``: its agent does not run.
    """

    name: str
    issued: int
    expires: int
    linked: bool | None = None


class TokenInfo(msgspec.Struct, kw_only=True, frozen=True):
    """A token of the authority.

    Attributes:
        id: 16 hexadecimal digits; not the token.
        state: ``open``, ``used`` or ``ended``.
        expires: Seconds since 1970.
        name: The module that it is for; empty for any.
        used_by: The module that joined with it.
    """

    id: str
    state: str
    expires: int
    name: str = ""
    used_by: str = ""


class TrustStatus(msgspec.Struct, kw_only=True, frozen=True):
    """The state of one module.

    Attributes:
        on: Whether this module is a member of a secured mesh.
        module: Its name.
        folder: Where its files are; empty if there is no state directory.
        agent: ``secured``, ``plain`` (it must be started again), or ``off`` if none runs.
        is_authority: Whether it is the authority.
        authority: The authority's name, as far as it is known.
        fingerprint: Of the CA, 32 hexadecimal digits.
        issued: When its certificate was issued, seconds since 1970.
        expires: When that ends.
        renew_at: When it is renewed.
        clock_set: Whether this machine's clock is set.
        key: The number of the newest group key.
        deny_number: The number of the deny list; 0: nothing was ever revoked.
        revoked: The names on it.
        members: At the authority: the modules with certificates.
        tokens: At the authority: its tokens.
        problems: What the user should do something about, each ready to read.
    """

    on: bool
    module: str
    folder: str = ""
    agent: str = "off"
    is_authority: bool = False
    authority: str = ""
    fingerprint: str = ""
    issued: int = 0
    expires: int = 0
    renew_at: int = 0
    clock_set: bool = True
    key: int = 0
    deny_number: int = 0
    revoked: tuple[str, ...] = ()
    members: tuple[MemberInfo, ...] = ()
    tokens: tuple[TokenInfo, ...] = ()
    problems: tuple[str, ...] = ()


class InviteReply(msgspec.Struct, kw_only=True, frozen=True):
    """A new invitation. It is the one reply with a secret, and only goes over the control socket.

    Attributes:
        token: Its text.
        id: 16 hexadecimal digits.
        expires: Seconds since 1970.
    """

    token: str
    id: str
    expires: int

    def __repr__(self) -> str:
        """Without the token."""
        return f"InviteReply(id={self.id!r}, expires={self.expires})"


class JoinStep(msgspec.Struct, kw_only=True, frozen=True):
    """What came of a token at the authority.

    Attributes:
        step: Counts the changes.
        state: ``waiting``, ``joined`` or ``refused``; a token that was refused may still be used.
        module: The module that joins.
        reason: Why it was refused, one word.
        text: What happened.
    """

    step: int
    state: str
    module: str = ""
    reason: str = ""
    text: str = ""


class TrustReply(msgspec.Struct, kw_only=True, frozen=True):
    """What a command has done.

    Attributes:
        module: The module that it concerns.
        done: Whether anything has changed.
        text: What has happened, ready to read.
        expires: The end of the new certificate, seconds since 1970; 0 if there is none.
        number: The number of the new deny list or group key; 0 if there is none.
    """

    module: str
    done: bool
    text: str = ""
    expires: int = 0
    number: int = 0


# The names and addresses by which a module's page is opened. Which of them its certificate may have (RFC 9525).
#
# Those that follow from the module's name are never another module's. Further ones are asked for. A browser that
# trusts the mesh's CA is to believe it about no host of the Internet, so these are private addresses, and names of
# the local network.


_LABEL: Final = r"[a-z0-9](?:[a-z0-9-]{0,61}[a-z0-9])?"
# A name without a dot, or below a domain that is no one's in the Internet (RFC 6762, RFC 8375, ICANN's internal).
_LOCAL: Final = re.compile(rf"{_LABEL}|(?:{_LABEL}\.)+(?:local|lan|internal|home\.arpa)")
# Of carriers, and of VPNs such as Tailscale's (RFC 6598).
_SHARED: Final = ipaddress.IPv4Network("100.64.0.0/10")


def server_names(name: str) -> tuple[str, ...]:
    """The names that every module's certificate has, besides 127.0.0.1.

    They follow from the module's name and are not asked for, so that no module gets those of another. A host's name
    has ``-`` where the module's name, which is made of it, has ``_``.
    """
    host = name.replace("_", "-").lower()
    return (host, f"{host}.local", "localhost")


def page_hosts(wanted: Iterable[str]) -> tuple[str, ...]:
    """Of names and addresses those that a certificate may have, in their normal form, at most so many."""
    found = dict.fromkeys(host for text in wanted if (host := _page_host(text)))
    return tuple(found)[: limits.PAGE_HOSTS_MAX]


def host_names(host_name: str) -> tuple[str, ...]:
    """The names of a machine in its network: its host's name, whole and short, and that of mDNS."""
    name = host_name.lower().removesuffix(".")
    short = name.partition(".")[0]
    return (name, short, f"{short}.local")


def _page_host(text: str) -> str:
    """The normal form; empty: a certificate may not have it, or has it anyway."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        name = text.lower().removesuffix(".")
        return name if name != "localhost" and _LOCAL.fullmatch(name) else ""
    special = address.is_loopback or address.is_unspecified or address.is_multicast
    shared = isinstance(address, ipaddress.IPv4Address) and address in _SHARED
    return str(address) if (address.is_private or shared) and not special else ""
