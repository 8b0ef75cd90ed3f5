from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from rmpa.ros.node.service_client import ServiceConnection
from tests.agent.test_agent import running

if TYPE_CHECKING:
    from collections.abc import Callable

    import pytest

    from rmpa.config.settings import Settings


def strings(*texts: str) -> bytes:
    return b"".join(len(text).to_bytes(4, "little") + text.encode() for text in texts)


async def test_the_agents_log_is_turned_up_while_it_runs(
    settings: Callable[..., Settings],
    caplog: pytest.LogCaptureFixture,
) -> None:
    mesh, bridge = logging.getLogger("rmpa.mesh"), logging.getLogger("rmpa.bridge")
    caplog.set_level(logging.WARNING)
    async with running(settings("a")) as (agent,):
        uri = str(agent.core.call("lookupService", "/x", "/rmpa/set_logger_level").value)
        assert uri == agent.core.call("lookupService", "/x", "/rmpa/get_loggers").value
        turn = await ServiceConnection.open(uri, "/rmpa/set_logger_level", "/rqt")
        look = await ServiceConnection.open(uri, "/rmpa/get_loggers", "/rqt")
        try:
            assert await turn.call(strings("rmpa.mesh", "debug")) == (True, b"")
            assert (mesh.isEnabledFor(logging.DEBUG), bridge.isEnabledFor(logging.DEBUG)) == (True, False)
            ok, answer = await look.call(b"")
            assert ok
            assert strings("rmpa.mesh", "debug") in answer
            assert strings("rmpa.bridge", "warn") in answer
        finally:
            mesh.setLevel(logging.NOTSET)
        turn.close()
        look.close()
    assert "/rmpa/get_loggers" not in agent.core.state().services
