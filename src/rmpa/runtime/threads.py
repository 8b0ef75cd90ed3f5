"""Runs a user's function in a thread of its own, where it may hang forever without blocking anything else."""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import threading
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

_T = TypeVar("_T")


async def in_thread(function: Callable[[], _T], name: str) -> _T:
    """Call ``function`` in a new daemon thread, and return its result. Cancellation does not stop the thread.

    ``asyncio.to_thread`` uses a pool, which a few hanging functions would exhaust. A daemon thread does not keep the
    process from ending.

    Args:
        function: Its exceptions are raised here; ``SystemExit`` and the like as ``RuntimeError``.
        name: The thread's name.
    """
    loop = asyncio.get_running_loop()
    result: asyncio.Future[_T] = loop.create_future()

    def run() -> None:
        try:
            value = function()
        except Exception as error:  # noqa: BLE001 - handed on
            end(None, error if not isinstance(error, StopIteration) else RuntimeError(f"StopIteration: {error}"))
        except BaseException as error:  # noqa: BLE001 - it ends this function, not the process
            end(None, RuntimeError(f"{type(error).__name__}: {error}"))
        else:
            end(value, None)

    def end(value: _T | None, error: Exception | None) -> None:
        def settle() -> None:
            if not result.done():
                if error is not None:
                    result.set_exception(error)
                else:
                    result.set_result(value)  # type: ignore[arg-type] # a value, for there is no error

        with contextlib.suppress(RuntimeError):  # the loop ended before this thread
            loop.call_soon_threadsafe(settle)

    context = contextvars.copy_context()
    threading.Thread(target=context.run, args=(run,), name=name, daemon=True).start()
    return await result
