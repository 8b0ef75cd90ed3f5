"""Stands for the requests to peers: each is answered as the test says."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rmpa.bridge.rpc import PeerRpc
from rmpa.core.statistics import Counters


class AskedPeers(PeerRpc):
    """The requests to peers; an answer that is an exception is raised.

    Args:
        answer: ``(session, what, args) -> answer``.
    """

    def __init__(self, answer: Callable[[Any, str, dict[str, Any]], Any]) -> None:
        super().__init__(Counters())
        self._answer = answer

    async def request(self, session: Any, what: str, args: dict[str, Any], timeout: float = 0.0) -> Any:
        answer = self._answer(session, what, args)
        if isinstance(answer, Exception):
            raise answer
        return answer
