"""Runs a function of somebody else's in a thread of its own, which may hang for ever without harm to anybody."""

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
    """Call it, and wait for what it returns; who is cancelled meanwhile leaves it behind.

    Unlike ``asyncio.to_thread`` it takes no place in a pool: let a few hang there, and nothing runs in threads any
    more. And being a daemon, it does not keep the process from its end.

    Args:
        function: What it raises is raised here; ``SystemExit`` and its like as a ``RuntimeError``.
        name: Of the thread.
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
        def told() -> None:
            if not result.done():
                if error is not None:
                    result.set_exception(error)
                else:
                    result.set_result(value)  # type: ignore[arg-type] # a value, for there is no error

        with contextlib.suppress(RuntimeError):  # the loop has ended before us
            loop.call_soon_threadsafe(told)

    context = contextvars.copy_context()
    threading.Thread(target=context.run, args=(run,), name=name, daemon=True).start()
    return await result
