"""Joins and renewals at the authority, on connections of the mesh's port with the ALPN ``rmpa-join/1``."""

from __future__ import annotations

import asyncio
import hmac
import logging
import ssl
from typing import TYPE_CHECKING

from rmpa.core.counters import RefusalLog
from rmpa.core.errors import RemoteProtocolError, StartError
from rmpa.trust import certificates, limits
from rmpa.trust.certificates import CertificateError
from rmpa.trust.join import (
    LENGTH,
    CertificateGrant,
    Join,
    JoinRefused,
    Renew,
    decode_message,
    encode_message,
    message_length,
    proof_of,
)
from rmpa.trust.status import JoinStep
from rmpa.trust.tokens import TokenProblem

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from rmpa.core.counters import Clock, Counters
    from rmpa.runtime.tls import TlsHandshake
    from rmpa.trust.io.authority import MeshAuthority
    from rmpa.trust.io.membership import Membership
    from rmpa.trust.join import JoinMessage

_log = logging.getLogger(__name__)
_READ = 16 * 1024
_PROBLEMS = {
    TokenProblem.TOKEN: "is unknown here",
    TokenProblem.USED: "was used",
    TokenProblem.LATE: "has ended",
    TokenProblem.NAME: "is for another module",
}


class JoinServer:
    """The authority's end of joins and renewals.

    Args:
        authority: Issues the certificates.
        membership: This module's.
        clock: Monotonic seconds.
        is_linked: Whether a member that is linked has a name.
        counters: Counts what is refused: ``trust.join_refused``, ``trust.renewal_refused``.
    """

    def __init__(
        self,
        authority: MeshAuthority,
        membership: Membership,
        clock: Clock,
        is_linked: Callable[[str], bool],
        counters: Counters,
    ) -> None:
        self._authority = authority
        self._membership = membership
        self._clock = clock
        self._refusals = RefusalLog(_log, counters)
        self._is_linked = is_linked
        self._steps: dict[bytes, JoinStep] = {}
        """What came of each token, by its id."""
        self.changed = asyncio.Event()
        """Set, and replaced, at each step."""

    async def serve(self, sock: socket.socket, handshake: TlsHandshake, host: str) -> None:
        """Read one question behind the TLS handshake, and answer it; the caller closes the socket.

        Raises:
            OSError: The connection ended, or the question did not come within ``limits.JOIN_STEP_TIMEOUT``.
            RemoteProtocolError: The question is malformed.
        """
        loop, tls, data = asyncio.get_running_loop(), handshake.tls, b""
        async with asyncio.timeout(limits.JOIN_STEP_TIMEOUT):
            size = LENGTH.size
            while len(data) < size:
                try:
                    data += tls.read(_READ)
                except ssl.SSLWantReadError:
                    raw = await loop.sock_recv(sock, _READ)
                    if not raw:
                        raise ConnectionError("closed the connection before its question was whole") from None
                    handshake.receive(raw)
                if len(data) >= LENGTH.size:
                    size = LENGTH.size + message_length(data, limits.JOIN_REQUEST_MAX)
            answer = self.answer(decode_message(data[LENGTH.size : size]), tls.getpeercert(binary_form=True), host)
            tls.write(encode_message(answer))
            await loop.sock_sendall(sock, handshake.take_output())

    def answer(self, asked: JoinMessage, presented: bytes | None, host: str) -> CertificateGrant | JoinRefused:
        """Answer a question; what it changes is written to files before.

        Args:
            asked: The question.
            presented: The certificate (DER) of the other end, of this mesh's CA; ``None``: it has none.
            host: The address of the other end.

        Raises:
            RemoteProtocolError: It is no question.
        """
        what = "renewal" if isinstance(asked, Renew) else "join"
        try:
            if isinstance(asked, Join):
                return self._join(asked, host)
            if not isinstance(asked, Renew) or presented is None:
                raise RemoteProtocolError("a join or renewal that begins with something else than its question")
            before = self._authority.judge_renewal(presented)
            grant = self._authority.grant(asked.request, before.name)
            _log.info("= %s at %s has a new certificate; it was away", before.name, host)
        except CertificateError as error:
            refused = JoinRefused(error.reason.label, str(error))
        except StartError as error:
            refused = JoinRefused("clock" if self._membership.wall() is None else "authority", str(error))
        else:
            return grant
        return self._refuse(what, host, refused)

    def _refuse(self, what: str, host: str, refused: JoinRefused) -> JoinRefused:
        """Log what each connection can repeat, within limits."""
        text = f"refused a {what} by {host} ({refused.reason}): {refused.text}"
        self._refusals.refuse(self._clock.now(), f"trust.{what}_refused", host, text)
        return refused

    def _join(self, asked: Join, host: str) -> CertificateGrant | JoinRefused:
        """Let a module join: its token is used, also after a crash, before a certificate is issued."""
        book, authority = self._authority.book, self._authority
        name = certificates.read_request(asked.request).name
        invitation = book.find(asked.token)
        problem = book.judge(asked.token, name, authority.wall())
        # The refusal of a token that is used or has ended is no secret: its id is known to its holder alone.
        proof = proof_of(invitation.key if invitation is not None else b"", asked.request, self._server())
        if problem is not None:
            refused = JoinRefused(problem.value, f"{name} cannot join: the token {_PROBLEMS[problem]}")
        elif not hmac.compare_digest(proof, asked.proof):
            refused = JoinRefused("token", "the request is not signed with the token's key")
        elif self._is_linked(name) or authority.has_issued(name, invitation.name if invitation is not None else ""):
            refused = JoinRefused("taken", f"a module named {name} is a member: choose another --name, or revoke it")
        else:
            book.use(asked.token, name, authority.wall())
            authority.save_tokens()
            grant = authority.grant(asked.request)
            self._step(asked.token, "joined", name)
            _log.info("+ %s at %s has joined", name, host)
            return grant
        if invitation is not None:
            self._step(asked.token, "refused", name, refused)
        return self._refuse("join", host, refused)

    def _server(self) -> bytes:
        return self._membership.files.certificate

    # --- the user who invites ---------------------------------------------------------------------------------

    def step(self, token_id: bytes) -> JoinStep:
        """What came of a token so far, as ``rmpa trust invite`` shows it."""
        return self._steps.get(token_id, JoinStep(step=0, state="waiting"))

    def _step(self, token_id: bytes, state: str, module: str, refused: JoinRefused | None = None) -> None:
        while len(self._steps) >= limits.TOKENS_MAX:
            del self._steps[next(iter(self._steps))]
        reason, text = (refused.reason, refused.text) if refused is not None else ("", "")
        number = self.step(token_id).step + 1
        self._steps[token_id] = JoinStep(step=number, state=state, module=module, reason=reason, text=text)
        changed, self.changed = self.changed, asyncio.Event()
        changed.set()
