"""The process of an agent: its signals, its readiness, and the limits that it sets for itself."""

from __future__ import annotations

import asyncio
import logging
import signal
import sys
from typing import TYPE_CHECKING

from rmpa.agent.reload import SighupHandler
from rmpa.core.counters import remedy
from rmpa.core.errors import StartError
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime import process as realtime
from rmpa.runtime.accept import is_shortage, raise_file_limit
from rmpa.runtime.loop import AgentLoop
from rmpa.runtime.process import notify_service_manager

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine

    from rmpa.agent.reload import Reloader
    from rmpa.config.settings import Settings

_log = logging.getLogger(__name__)


async def serve(
    start: Callable[[], Awaitable[None]],
    close: Callable[[], Awaitable[None]],
    reloader: Reloader,
    watch: Callable[[], Coroutine[None, None, None]] | None = None,
) -> None:
    """Start, run until SIGINT or SIGTERM, and close; systemd is notified.

    Args:
        start: Starts everything; after an exception nothing is left running.
        close: Closes everything.
        reloader: Reads the settings again at SIGHUP.
        watch: Runs meanwhile; its end ends everything, and an exception of it is raised.
    """
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    loop.set_default_executor(realtime.worker_pool())
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    sighup = SighupHandler(reloader, stop.set)
    await start()
    sighup.start()
    watching = asyncio.create_task(watch(), name="watch") if watch is not None else None
    if watching is not None:
        watching.add_done_callback(lambda _: stop.set())
    try:
        notify_service_manager("READY=1")
        await stop.wait()
        notify_service_manager("STOPPING=1")
        _log.info("= ending")
        if watching is not None and watching.done():
            watching.result()
    finally:
        if watching is not None:
            watching.cancel()
            await asyncio.wait([watching])
        await sighup.close()
        await close()


def run_process(
    settings: Settings,
    main: Callable[[tuple[str, ...]], Coroutine[None, None, None]],
) -> int:
    """Run the event loop of a process with an agent; return the exit code.

    Args:
        settings: The agent's settings.
        main: Gets the outcomes of ``--realtime``.

    Raises:
        StartError: The agent cannot start on this machine with these settings.
    """
    raise_file_limit()
    sys.setswitchinterval(runtime_limits.THREAD_SWITCH)
    wanted = settings.realtime
    outcomes = realtime.apply(wanted.priority, lock_memory=wanted.lock_memory) if wanted.enabled else ()
    try:
        with asyncio.Runner(loop_factory=AgentLoop) as runner:
            runner.run(main(outcomes))
    except OSError as error:
        if is_shortage(error):
            raise StartError(f"agent {settings.name}", "no file descriptors left", remedy()) from error
        raise
    return 0
