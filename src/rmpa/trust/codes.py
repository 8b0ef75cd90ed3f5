"""The six-digit code of a join: two users compare it, so that nothing between the machines takes part in it.

Two machines, one for each side. The joining side is bound to its nonce by a *commitment* before it sees the other
one, and the inviting side chooses its nonce before it sees the joining one. So neither side, nor anything between
them that has keys of its own, can try nonces until the codes agree: there is one attempt, with a chance of 1 in
1,000,000 (Vaudenay, *Secure Communications over Insecure Channels Based on Short Authenticated Strings*, 2005; as in
ZRTP, RFC 6189, section 4.4.1.1).

::

    JoiningCode                                    InvitingCode
    COMMITTED   ── commitment, context ─────────►  WAITING
                ◄───────────────────── nonce ────  CHALLENGED
    SHOWN       ── nonce ───────────────────────►  SHOWN
    AGREED, REJECTED: what the user says           AGREED, REJECTED

What the code is bound to is a ``CodeContext``; both sides must have the same one for the codes to agree.
"""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass
from enum import Enum, auto
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import LocalProtocolError, RemoteProtocolError
from rmpa.trust import limits

if TYPE_CHECKING:
    from collections.abc import Mapping

_DIGITS: Final = 6
_COMMIT: Final = b"rmpa commit 1"
_CODE: Final = b"rmpa code 1"


class CodeState(Enum):
    """The state of one side."""

    COMMITTED = auto()
    """Joining: the commitment was made; the other nonce is awaited."""
    WAITING = auto()
    """Inviting: the commitment is awaited."""
    CHALLENGED = auto()
    """Inviting: its nonce was told; the joining nonce is awaited."""
    SHOWN = auto()
    """The code is known; the user compares it."""
    AGREED = auto()
    """The user says that the codes are equal."""
    REJECTED = auto()
    """The user says that they differ, the commitment was broken, or the time is over."""


class _Step(Enum):
    COMMITMENT = auto()
    NONCE = auto()
    AGREE = auto()
    REJECT = auto()


_NEXT: Final[Mapping[tuple[CodeState, _Step], CodeState]] = MappingProxyType(
    {
        (CodeState.COMMITTED, _Step.NONCE): CodeState.SHOWN,
        (CodeState.WAITING, _Step.COMMITMENT): CodeState.CHALLENGED,
        (CodeState.CHALLENGED, _Step.NONCE): CodeState.SHOWN,
        (CodeState.SHOWN, _Step.AGREE): CodeState.AGREED,
        (CodeState.COMMITTED, _Step.REJECT): CodeState.REJECTED,
        (CodeState.WAITING, _Step.REJECT): CodeState.REJECTED,
        (CodeState.CHALLENGED, _Step.REJECT): CodeState.REJECTED,
        (CodeState.SHOWN, _Step.REJECT): CodeState.REJECTED,
    }
)
_OVER: Final = frozenset({CodeState.AGREED, CodeState.REJECTED})


@dataclass(frozen=True, slots=True)
class CodeContext:
    """What a code is bound to.

    Args:
        module: The name of the joining module.
        module_key: SHA-256 of its public key (SubjectPublicKeyInfo, DER).
        authority_key: SHA-256 of the CA's certificate (DER).
        token_id: The id of the token, 8 bytes; of an exchange by files: 8 zero bytes.

    Raises:
        ValueError: A hash or the id has a wrong length.
    """

    module: str
    module_key: bytes
    authority_key: bytes
    token_id: bytes

    def __post_init__(self) -> None:
        if (len(self.module_key), len(self.authority_key), len(self.token_id)) != (32, 32, 8):
            raise ValueError("hashes have 32 bytes, and a token's id 8")

    def packed(self) -> bytes:
        """All parts as bytes, each with its length in front, so that no two contexts have the same bytes."""
        parts = (self.module.encode(), self.module_key, self.authority_key, self.token_id)
        return b"".join(len(part).to_bytes(4, "big") + part for part in parts)


def commitment_to(nonce: bytes, module_key: bytes) -> bytes:
    """The commitment of the joining side: SHA-256 over the label, its nonce and its key's hash."""
    return hashlib.sha256(_COMMIT + nonce + module_key).digest()


def code_of(context: CodeContext, joining_nonce: bytes, inviting_nonce: bytes) -> str:
    """The code: six digits."""
    mac = hmac.digest(joining_nonce + inviting_nonce, _CODE + context.packed(), hashlib.sha256)
    return f"{int.from_bytes(mac[:8], 'big') % 10**_DIGITS:0{_DIGITS}}"


def code_text(code: str) -> str:
    """A code as users read it: ``481 902``."""
    return f"{code[:3]} {code[3:]}"


class _CodeMachine:
    """What both sides have in common.

    Args:
        nonce: ``limits.NONCE_BYTES`` random bytes, used for this join alone.
        state: Where this side begins.
        now: Monotonic seconds.

    Raises:
        ValueError: The nonce has a wrong length.
    """

    def __init__(self, nonce: bytes, state: CodeState, now: float) -> None:
        if len(nonce) != limits.NONCE_BYTES:
            raise ValueError(f"a nonce has {limits.NONCE_BYTES} bytes, not {len(nonce)}")
        self._nonce = nonce
        self._state = state
        self._deadline = now + limits.CODE_TIMEOUT
        self._code = ""

    @property
    def state(self) -> CodeState:
        """The present state."""
        return self._state

    @property
    def code(self) -> str:
        """The code to show.

        Raises:
            LocalProtocolError: It is not known yet.
        """
        if not self._code:
            raise LocalProtocolError(f"there is no code while {self._state.name}")
        return self._code

    @property
    def nonce(self) -> bytes:
        """This side's nonce, to be sent now.

        Raises:
            LocalProtocolError: It must not be known to the other side yet.
        """
        if self._state not in (CodeState.CHALLENGED, CodeState.SHOWN):
            raise LocalProtocolError(f"the nonce must not be told while {self._state.name}")
        return self._nonce

    def agree(self) -> None:
        """The user says that the codes are equal.

        Raises:
            LocalProtocolError: No code is shown.
        """
        self._step(_Step.AGREE)

    def reject(self) -> None:
        """The user says that the codes differ, or the other side has gone; without effect once it is over."""
        if self._state not in _OVER:
            self._step(_Step.REJECT)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, in monotonic seconds."""
        return None if self._state in _OVER else self._deadline

    def handle_timer(self, now: float) -> None:
        """Reject once the time is over."""
        due = self.next_timer()
        if due is not None and now >= due:
            self._step(_Step.REJECT)

    def _step(self, step: _Step) -> None:
        following = _NEXT.get((self._state, step))
        if following is None:
            raise LocalProtocolError(f"no {step.name.lower()} while {self._state.name}")
        self._state = following

    def _receive(self, step: _Step, data: bytes) -> None:
        """Check a message of the other side.

        Raises:
            RemoteProtocolError: It has a wrong length or comes out of turn; the join is rejected.
        """
        if (self._state, step) not in _NEXT:
            state = self._state
            self.reject()
            raise RemoteProtocolError(f"a {step.name.lower()} while {state.name}")
        if len(data) != limits.NONCE_BYTES:
            self.reject()
            raise RemoteProtocolError(f"a {step.name.lower()} of {len(data)} bytes")


class JoiningCode(_CodeMachine):
    """The side of the module that joins.

    Args:
        context: What the code is bound to.
        nonce: ``limits.NONCE_BYTES`` random bytes.
        now: Monotonic seconds.
    """

    def __init__(self, context: CodeContext, nonce: bytes, now: float) -> None:
        super().__init__(nonce, CodeState.COMMITTED, now)
        self._context = context

    @property
    def commitment(self) -> bytes:
        """The commitment, to be sent first."""
        return commitment_to(self._nonce, self._context.module_key)

    def receive_nonce(self, nonce: bytes) -> bytes:
        """Take the other side's nonce; return the own one, which is sent now. The code is known.

        Raises:
            RemoteProtocolError: It has a wrong length or comes out of turn; the join is rejected.
        """
        self._receive(_Step.NONCE, nonce)
        self._step(_Step.NONCE)
        self._code = code_of(self._context, self._nonce, nonce)
        return self._nonce


class InvitingCode(_CodeMachine):
    """The side of the authority.

    Args:
        nonce: ``limits.NONCE_BYTES`` random bytes.
        now: Monotonic seconds.
    """

    def __init__(self, nonce: bytes, now: float) -> None:
        super().__init__(nonce, CodeState.WAITING, now)
        self._context: CodeContext | None = None
        self._commitment = b""

    def receive_commitment(self, commitment: bytes, context: CodeContext) -> bytes:
        """Take the commitment and what came with it; return the own nonce, which is sent now.

        Args:
            commitment: 32 bytes.
            context: What the code is bound to, as this side sees it.

        Raises:
            RemoteProtocolError: It has a wrong length or comes out of turn; the join is rejected.
        """
        self._receive(_Step.COMMITMENT, commitment)
        self._step(_Step.COMMITMENT)
        self._commitment, self._context = commitment, context
        return self._nonce

    def receive_nonce(self, nonce: bytes) -> None:
        """Take the joining side's nonce. The code is known.

        Raises:
            RemoteProtocolError: It has a wrong length, comes out of turn, or is not the one of the commitment; the
                join is rejected.
        """
        self._receive(_Step.NONCE, nonce)
        context = self._context
        assert context is not None  # noqa: S101 - CHALLENGED is only reached with one
        if not hmac.compare_digest(commitment_to(nonce, context.module_key), self._commitment):
            self.reject()
            raise RemoteProtocolError("the nonce is not the one of the commitment")
        self._step(_Step.NONCE)
        self._code = code_of(context, nonce, self._nonce)
