"""A timer as a file descriptor (timerfd_create(2)): due at an absolute time, to the microsecond.

The event loop's own timers are rounded to milliseconds, and a sleeping thread wakes up late by the timer slack of
50 µs. A timerfd has neither fault. Python supports it since 3.13; with older versions the C library is called.
"""

from __future__ import annotations

import functools
import os
import struct
import sys
from typing import TYPE_CHECKING, Final, Self

if TYPE_CHECKING:
    import ctypes
    from types import TracebackType

_CLOCK_MONOTONIC: Final = 1
_CLOEXEC: Final = 0o2000000
_NONBLOCK: Final = 0o4000
_ABSTIME: Final = 1
_ITIMERSPEC: Final = struct.Struct("@qqqq")
_NANO: Final = 1_000_000_000


class TimerFd:
    """One timer.

    Args:
        blocking: Whether ``wait`` sleeps until the timer is due, for a thread; else ``fileno`` is for a loop.

    Raises:
        OSError: No file descriptor is left.
    """

    def __init__(self, *, blocking: bool) -> None:
        flags = _CLOEXEC | (0 if blocking else _NONBLOCK)
        if sys.version_info >= (3, 13):
            self._fd = os.timerfd_create(_CLOCK_MONOTONIC, flags=flags)
        else:
            self._fd = _check(_libc().timerfd_create(_CLOCK_MONOTONIC, flags))

    def fileno(self) -> int:
        """The descriptor, which is readable from the due time until ``wait`` or ``set``; -1 once closed."""
        return self._fd

    def set(self, due: float) -> None:
        """Set the due time, in seconds of the monotonic clock; a time in the past is due at once.

        Raises:
            OSError: The timer is closed.
        """
        nanoseconds = max(1, round(due * _NANO))
        if sys.version_info >= (3, 13):
            os.timerfd_settime_ns(self._fd, flags=os.TFD_TIMER_ABSTIME, initial=nanoseconds)
        else:
            spec = _ITIMERSPEC.pack(0, 0, *divmod(nanoseconds, _NANO))
            _check(_libc().timerfd_settime(self._fd, _ABSTIME, spec, None))

    def wait(self) -> bool:
        """Reset a timer that is due; a blocking timer first sleeps until its due time.

        Returns:
            Whether the timer was due; always true for a blocking one.
        """
        try:
            os.read(self._fd, 8)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Close the descriptor; may be called twice. No thread may be in ``wait`` at that time."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@functools.cache
def _libc() -> ctypes.CDLL:
    import ctypes  # noqa: PLC0415 - only programs with timers load it

    return ctypes.CDLL(None, use_errno=True)


def _check(result: int) -> int:
    if result < 0:
        import ctypes  # noqa: PLC0415 - likewise

        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result
