"""Runs ``rmpa web`` as a child process of the agent, which does not depend on it.

The child's standard input is a pipe from the agent: its end tells the child that the agent has ended, however it did.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import subprocess
import sys
from typing import TYPE_CHECKING, Final

from rmpa.agent import limits
from rmpa.core.counters import Backoff

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rmpa.config.settings import Settings

_log = logging.getLogger(__name__)
_USAGE: Final = 2
"""The exit code of a command that cannot run as it is written: another start would end alike."""


def web_command(settings: Settings) -> list[str]:
    """The command line of the child: all that the agent's own options may have changed is given."""
    web = settings.web
    command = [sys.executable, "-m", "rmpa.cli.main", "web", "--with-agent", "--agent", settings.name]
    command += ["--port", str(web.port), "--listen", web.listen]
    if web.token_file:
        command += ["--token-file", web.token_file]
    if settings.config_file is not None:
        command += ["--config", str(settings.config_file)]
    return command


def web_environment(settings: Settings, environ: Mapping[str, str]) -> dict[str, str]:
    """The environment of the child: the agent's, with its log's level and format."""
    log = {"RMPA_LOG_LEVEL": settings.log_level, "RMPA_LOG_JSON": str(settings.log_json).lower()}
    return {**environ, **log}


class WebProcess:
    """The child, started again with a growing delay whenever it ends.

    Args:
        command: Its command line.
        rng: Uniform numbers in [0, 1), for the delays.
        environ: Its environment; ``None``: the agent's.
    """

    def __init__(
        self,
        command: Sequence[str],
        rng: Callable[[], float],
        *,
        environ: Mapping[str, str] | None = None,
    ) -> None:
        self._command = command
        self._environ = environ
        self._backoff = Backoff(limits.WEB_RESTART_FIRST, limits.WEB_RESTART_CAP, rng)
        self._task: asyncio.Task[None] | None = None
        self.pid: int | None = None
        """The child's process id, while it runs."""

    def start(self) -> None:
        """Start the child, and look after it until ``close()``."""
        self._task = asyncio.create_task(self._supervise(), name="rmpa web")

    def reload(self) -> None:
        """Have the child read its settings again; one that is not there reads them when it starts."""
        if self.pid is not None:
            with contextlib.suppress(OSError):
                os.kill(self.pid, signal.SIGHUP)

    async def close(self) -> None:
        """End the child, and wait until it has ended."""
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
            self._task = None

    async def _supervise(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            began = loop.time()
            try:
                code = await self._run()
            except OSError as error:
                _log.warning("! rmpa web cannot be started: %s", error)
                code = 1
            if code == _USAGE:
                _log.warning("! rmpa web cannot run with these settings (see above); it is not started again")
                return
            if loop.time() - began >= limits.WEB_STEADY:
                self._backoff.reset()
            delay = self._backoff.delay()
            _log.warning("! rmpa web ended with code %d; it is started again in %.1f s", code, delay)
            await asyncio.sleep(delay)

    async def _run(self) -> int:
        process = await asyncio.to_thread(self._spawn)
        try:
            self.pid = process.pid
            await _ended(process.pid)
        except asyncio.CancelledError:
            await self._end(process)
            raise
        finally:
            self.pid = None
            if process.stdin is not None:
                process.stdin.close()
        return process.wait()

    def _spawn(self) -> subprocess.Popen[bytes]:
        # In a session of its own Ctrl-C does not reach it: it ends with the agent, and not before.
        return subprocess.Popen(  # noqa: S603 - our own program
            self._command, stdin=subprocess.PIPE, start_new_session=True, env=self._environ
        )

    async def _end(self, process: subprocess.Popen[bytes]) -> None:
        if process.stdin is not None:
            process.stdin.close()
        try:
            async with asyncio.timeout(limits.WEB_END_TIMEOUT):
                await _ended(process.pid)
        except TimeoutError:
            process.kill()
        process.wait()


async def _ended(pid: int) -> None:
    """Wait until a child process has ended, without a thread; it remains to be waited for."""
    descriptor = os.pidfd_open(pid)
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()
    try:
        loop.add_reader(descriptor, ended.set)
        await ended.wait()
    finally:
        loop.remove_reader(descriptor)
        os.close(descriptor)
