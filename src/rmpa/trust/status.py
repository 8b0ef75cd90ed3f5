"""What ``rmpa trust status`` and the other commands show. No part is a secret."""

from __future__ import annotations

import msgspec


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
