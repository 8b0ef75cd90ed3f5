"""Fragments: an op in JSON, cut into pieces of so many characters, each within an op ``fragment``."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.core.errors import LimitExceeded
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.protocol import Id, OpError, RosbridgeFrame, write_op

if TYPE_CHECKING:
    from collections.abc import Iterator


def split(frame: RosbridgeFrame, size: int, mid: Id) -> list[RosbridgeFrame]:
    """Cut a frame of JSON into fragments of up to `size` characters; a frame that fits, and CBOR, stay whole.

    Args:
        frame: The op.
        size: Characters, 1 or more.
        mid: The id of all fragments.

    Raises:
        OpError: The fragments are too many.
    """
    if frame.binary or frame.size <= size:
        return [frame]
    text = bytes(frame.data).decode()
    total = -(-len(text) // size)
    if total > limits.FRAGMENTS_MAX:
        problem = f"a message of {len(text)} characters would be {total} fragments of {size}"
        raise OpError(problem, f"ask for a fragment_size of {-(-len(text) // limits.FRAGMENTS_MAX)} or more")
    if total == 1:
        return [frame]
    return [
        RosbridgeFrame(
            write_op(
                {
                    "op": "fragment",
                    "id": mid,
                    "data": text[num * size : (num + 1) * size],
                    "num": num,
                    "total": total,
                }
            ).parts,
            handle=frame.handle,
        )
        for num in range(total)
    ]


@dataclass(slots=True)
class _Incomplete:
    total: int
    deadline: float
    size: int = 0
    pieces: dict[int, str] = field(default_factory=dict)


class Assembler:
    """Puts a client's fragments together. They may come in any order; a repeated one is ignored."""

    def __init__(self) -> None:
        self._messages: OrderedDict[tuple[str, str | int], _Incomplete] = OrderedDict()
        self._bytes = 0

    def add(self, kind: str, mid: str | int, num: int, total: int, data: str, now: float) -> str | None:
        """Take one fragment.

        Args:
            kind: Its op, fragment or png.
            mid: Its id.
            num: Its place, from 0.
            total: How many there are.
            data: Its text.
            now: The present time.

        Returns:
            The whole text with the last missing fragment; else None.

        Raises:
            OpError: The numbers are impossible.
            LimitExceeded: The message has too many fragments, or is too long.
        """
        if total > limits.FRAGMENTS_MAX:
            raise LimitExceeded("total of fragments", total, limits.FRAGMENTS_MAX)
        if total < 1 or not 0 <= num < total:
            raise OpError(f"fragment {num} of {total} cannot be: they count from 0")
        key = (kind, mid)
        message = self._messages.get(key)
        if message is None:
            message = self._messages[key] = _Incomplete(total, now)
        elif message.total != total:
            self._drop(key)
            raise OpError(f"the fragments of {str(mid)[:80]!r} disagree: {message.total} or {total} in all")
        message.deadline = now + limits.FRAGMENT_TIMEOUT
        self._messages.move_to_end(key)
        if num not in message.pieces:
            self._store(key, message, num, data)
        if len(message.pieces) < total:
            return None
        self._drop(key)
        return "".join(message.pieces[index] for index in range(total))

    def _store(self, key: tuple[str, str | int], message: _Incomplete, num: int, data: str) -> None:
        # Python keeps up to four bytes a character, and some 200 bytes for each piece.
        size = len(data) * (1 if data.isascii() else 4) + 200
        if message.size + size > limits.FRAGMENTED_MAX:
            self._drop(key)
            raise LimitExceeded("message in fragments", message.size + size, limits.FRAGMENTED_MAX)
        message.pieces[num] = data
        message.size += size
        self._bytes += size
        while self._bytes > limits.FRAGMENTED_MAX or len(self._messages) > limits.FRAGMENTED_MESSAGES_MAX:
            self._drop(next(iter(self._messages)))

    def next_timer(self) -> float | None:
        """When `expire` is to be called; None for never."""
        return min((each.deadline for each in self._messages.values()), default=None)

    def expire(self, now: float) -> Iterator[str | int]:
        """Drop the messages whose next fragment is overdue; yields their ids."""
        for key, message in list(self._messages.items()):
            if message.deadline <= now:
                self._drop(key)
                yield key[1]

    def _drop(self, key: tuple[str, str | int]) -> None:
        self._bytes -= self._messages.pop(key).size
