"""A thread that does what may block: Zenoh's declarations, queries and replies wait for a full transport."""

from __future__ import annotations

import logging
import queue
import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

_log = logging.getLogger(__name__)


class SerialWorker:
    """Runs functions one after the other in a daemon thread, in the order in which they were given.

    Args:
        name: The thread's name.
    """

    def __init__(self, name: str) -> None:
        self._jobs: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._discard = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, job: Callable[[], object]) -> None:
        """Run ``job`` after all that was given before; its errors are logged."""
        self._jobs.put(job)

    def stop(self, *, discard: bool = False) -> None:
        """End the thread once all that was given has run.

        Args:
            discard: What has not begun is not run.
        """
        self._discard = discard
        self._jobs.put(None)

    def join(self, timeout: float) -> bool:
        """Wait for the thread's end, which ``stop`` asks for.

        Args:
            timeout: Seconds.

        Returns:
            Whether it has ended.
        """
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                if not self._discard:
                    job()
            except Exception as error:  # noqa: BLE001 - one declaration that fails must not stop the others
                if not self._discard:
                    _log.warning("zenoh: %s", error)
            del job
