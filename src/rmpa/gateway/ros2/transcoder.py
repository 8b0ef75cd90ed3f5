"""Converts serialized messages between ROS 1 and CDR without making objects, where the fields have one order.

ROS 1 packs its fields without gaps. CDR (XCDR1, little-endian) aligns each number to its own size, counted from
behind its head of 4 bytes, and ends each string with a null byte that its length includes. For each pair of types a
function for each direction is written and compiled: it copies neighbouring numbers as one slice, has no calls for
nested messages, and skips fields that only one side has, or makes them zero.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Any, Final

from rmpa.gateway import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from rmpa.ros.wire.tcpros import Buffer

HEAD: Final = b"\x00\x01\x00\x00"
"""The head of CDR: little-endian, no options."""
_VIEWED: Final = 1 << 15
"""Bytes above which slices of a memoryview are quicker than those of bytes, for they are not copied twice."""


class Side(Enum):
    """Which of the two types has a field."""

    BOTH = "both"
    ROS1 = "ros1"
    ROS2 = "ros2"


@dataclass(frozen=True, slots=True)
class Number:
    """Numbers of one size, one after another.

    Args:
        size: Bytes of one, which is its alignment too.
        count: How many.
        side: Who has them.
    """

    size: int
    count: int = 1
    side: Side = Side.BOTH


@dataclass(frozen=True, slots=True)
class Text:
    """A string.

    Args:
        side: Who has it.
        bound: Its largest number of bytes in ROS 2; 0 for any.
        name: The field, for errors.
    """

    side: Side = Side.BOTH
    bound: int = 0
    name: str = ""


@dataclass(frozen=True, slots=True)
class Items:
    """An array.

    Args:
        parts: What one element is made of.
        count: The number of elements; ``None`` if each message says it.
        side: Who has it.
        bound: The largest number of elements in ROS 2; 0 for any.
        name: The field, for errors.
    """

    parts: tuple[Part, ...]
    count: int | None = None
    side: Side = Side.BOTH
    bound: int = 0
    name: str = ""


Part = Number | Text | Items


def on_side(parts: Iterable[Part], side: Side) -> tuple[Part, ...]:
    """The same parts, which only one side has."""
    return tuple(
        replace(part, parts=on_side(part.parts, side), side=side)
        if isinstance(part, Items)
        else replace(part, side=side)
        for part in parts
    )


class Transcoder:
    """The two functions for one pair of types.

    Args:
        parts: What a message is made of, in order.

    Raises:
        ValueError: Arrays of a fixed length make each message too much work.
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        if max(_work(parts, Side.ROS1), _work(parts, Side.ROS2)) > limits.ROS2_WORK_MAX:
            raise ValueError("its arrays of a fixed length are too large")
        self._to_cdr = _compile(_ToCdr(), parts)
        self._to_ros1 = _compile(_ToRos1(), parts)

    def to_cdr(self, raw: Buffer) -> bytes:
        """Convert a message of ROS 1, without a length in front, to CDR with its head.

        Raises:
            ValueError: The bytes are not such a message, or an array is longer than ROS 2 allows.
            struct.error: The bytes are too short.
        """
        return self._to_cdr(memoryview(raw) if len(raw) > _VIEWED else bytes(raw), len(raw))

    def to_ros1(self, raw: Buffer) -> bytes:
        """Convert CDR, with its head of little-endian, to a message of ROS 1.

        Raises:
            ValueError: The bytes are not such a message.
            struct.error: The bytes are too short.
        """
        body = memoryview(raw)[4:]
        return self._to_ros1(body if len(body) > _VIEWED else bytes(body), len(body))


class _Writer:
    """Writes one function: what both directions have in common.

    ``i`` is the place in the source. What is known of the place in CDR, ``c``, before the program runs, is its rest
    ``_rest`` by ``_known``: after a string nothing (1), after an alignment the alignment.
    """

    made = Side.ROS1
    """The side that the function makes a message of."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._indent = 1
        self._known = 8
        self._rest = 0
        self._run = 0
        self._names = 0
        self.texts: list[str] = []
        """The names of fields, for errors: ``TEXTS`` of the function, whose code has none."""

    def add(self, *lines: str) -> None:
        self._lines += [" " * self._indent + line for line in lines]

    def name(self) -> str:
        self._names += 1
        return f"n{self._names}"

    def forget(self, known: int = 1) -> None:
        self._known, self._rest = known, 0

    def moved(self, size: int) -> None:
        self._rest = (self._rest + size) % self._known

    def padding(self, size: int) -> int | None:
        """The padding before a number of this size, if it is known by now."""
        return -self._rest % size if self._known >= size else None

    def parts(self, parts: Iterable[Part]) -> None:
        for part in parts:
            if isinstance(part, Number):
                self.number(part)
                continue
            self.flush()
            if isinstance(part, Text):
                self.text(part)
            elif part.count is not None:
                self.loop(part, str(part.count))
            else:
                self.sequence(part)

    def loop(self, part: Items, count: str) -> None:
        self.add(f"for _ in range({count}):")
        self._indent += 1
        self.forget()
        before = len(self._lines)
        self.parts(part.parts)
        self.flush()
        if len(self._lines) == before:
            self.add("pass")
        self._indent -= 1
        self.forget()

    def check(self, part: Text | Items, name: str, what: str) -> None:
        """Check a length against the bound of ROS 2."""
        if part.bound:
            self.texts.append(part.name)
            field = f"{{TEXTS[{len(self.texts) - 1}]}}"
            text = f"{field} has {{{name}}} {what}; ROS 2 allows {part.bound}"
            self.add(f"if {name} > {part.bound}: raise ValueError(f'{text}')")

    def check_work(self, part: Items, name: str) -> None:
        """Count what a loop does: few bytes may claim many elements, each of which the other side fills up."""
        self.add(
            f"t += {name} * {1 + _work(part.parts, self.made)}",
            f"if t > {limits.ROS2_WORK_MAX}: raise ValueError('its arrays have too many elements')",
        )

    def write(self, parts: Iterable[Part]) -> list[str]:
        raise NotImplementedError

    def number(self, part: Number) -> None:
        raise NotImplementedError

    def text(self, part: Text) -> None:
        raise NotImplementedError

    def sequence(self, part: Items) -> None:
        raise NotImplementedError

    def flush(self) -> None:
        raise NotImplementedError


class _ToCdr(_Writer):
    """ROS 1 to CDR: ``i`` is the place in ROS 1's bytes, ``c`` that in CDR."""

    made = Side.ROS2

    def write(self, parts: Iterable[Part]) -> list[str]:
        self.add("i = c = t = 0", "out = [HEAD]", "add = out.append")
        self.parts(parts)
        self.flush()
        self.add("if i != end: raise ValueError(f'a message of {end} bytes has {i}')", "return b''.join(out)")
        return self._lines

    def flush(self) -> None:
        if self._run:
            self.add(f"add(s[i:i + {self._run}])", f"i += {self._run}", f"c += {self._run}")
            self._run = 0

    def align(self, size: int) -> None:
        padding = self.padding(size)
        if padding is None:
            self.flush()
            self.add(f"p = -c & {size - 1}", "if p:", " add(ZEROS[p])", " c += p")
            self.forget(size)
        elif padding:
            self.flush()
            self.add(f"add(ZEROS[{padding}])", f"c += {padding}")
            self.moved(padding)

    def zeros(self, size: int) -> None:
        self.flush()
        self.add(f"add(bytes({size}))", f"c += {size}")
        self.moved(size)

    def number(self, part: Number) -> None:
        size = part.size * part.count
        if part.side is Side.ROS1:
            self.flush()
            self.add(f"i += {size}")
        elif size:
            self.align(part.size)
            if part.side is Side.ROS2:
                self.zeros(size)
            else:
                self._run += size
                self.moved(size)

    def text(self, part: Text) -> None:
        if part.side is Side.ROS1:
            self.add("i += 4 + U(s, i)[0]")
            return
        self.align(4)
        if part.side is Side.ROS2:
            self.add("add(EMPTY)", "c += 5")
        else:
            name = self.name()
            self.add(f"{name} = U(s, i)[0]")
            self.check(part, name, "bytes")
            self.add(
                f"add(P({name} + 1))",
                f"add(s[i + 4:i + 4 + {name}])",
                "add(NULL)",
                f"i += 4 + {name}",
                f"c += 5 + {name}",
            )
        self.forget()

    def sequence(self, part: Items) -> None:
        if part.side is Side.ROS2:
            self.align(4)
            self.zeros(4)
            return
        name = self.name()
        if part.side is Side.BOTH:
            self.align(4)
        self.add(f"{name} = U(s, i)[0]")
        if part.side is Side.BOTH:
            self.add("add(s[i:i + 4])", "c += 4")
            self.moved(4)
        self.add("i += 4")
        self.check(part, name, "elements")
        stride = _stride(part)
        if stride is None:
            self.add(
                f"if {name} * {_least(part.parts, Side.ROS1)} > end - i: raise ValueError('an array is too long')"
            )
            self.check_work(part, name)
            self.loop(part, name)
            return
        size, alignment = stride
        if part.side is Side.ROS1:
            self.add(f"i += {name} * {size}")
            return
        if self.padding(alignment) != 0:
            self.add(f"p = -c & {alignment - 1}", f"if p and {name}:", " add(ZEROS[p])", " c += p")
        self.add(f"{name} *= {size}", f"add(s[i:i + {name}])", f"i += {name}", f"c += {name}")
        self.forget(min(4, size & -size))


class _ToRos1(_Writer):
    """CDR to ROS 1: ``i`` is the place in CDR, behind its head."""

    def write(self, parts: Iterable[Part]) -> list[str]:
        self.add("i = t = 0", "out = []", "add = out.append")
        self.parts(parts)
        self.flush()
        # Some serializers fill the end up to 4 bytes.
        self.add("if not i <= end <= i + 3:", " raise ValueError(f'a message of {end} bytes has {i}')")
        self.add("return b''.join(out)")
        return self._lines

    def flush(self) -> None:
        if self._run:
            self.add(f"add(s[i:i + {self._run}])", f"i += {self._run}")
            self._run = 0

    def align(self, size: int) -> None:
        padding = self.padding(size)
        if padding is None:
            self.flush()
            self.add(f"i += -i & {size - 1}")
            self.forget(size)
        elif padding:
            self.flush()
            self.add(f"i += {padding}")
            self.moved(padding)

    def number(self, part: Number) -> None:
        size = part.size * part.count
        if part.side is Side.ROS1:
            self.flush()
            self.add(f"add(bytes({size}))")
        elif size:
            self.align(part.size)
            if part.side is Side.ROS2:
                self.flush()
                self.add(f"i += {size}")
            else:
                self._run += size
            self.moved(size)

    def text(self, part: Text) -> None:
        if part.side is Side.ROS1:
            self.add("add(bytes(4))")
            return
        self.align(4)
        name = self.name()
        self.add(f"{name} = U(s, i)[0]")
        if part.side is Side.BOTH:
            self.add(
                f"if not {name}:",  # some serializers leave the null byte of an empty string out
                " add(ZEROS[4])",
                " i += 4",
                "else:",
                f" if s[i + 3 + {name}]: raise ValueError('a string has no end')",
                f" add(P({name} - 1))",
                f" add(s[i + 4:i + 3 + {name}])",
                f" i += 4 + {name}",
            )
        else:
            self.add(f"i += 4 + {name}")
        self.forget()

    def sequence(self, part: Items) -> None:
        if part.side is Side.ROS1:
            self.add("add(bytes(4))")
            return
        self.align(4)
        name = self.name()
        self.add(f"{name} = U(s, i)[0]")
        if part.side is Side.BOTH:
            self.add("add(s[i:i + 4])")
        self.add("i += 4")
        self.moved(4)
        stride = _stride(part)
        if stride is None:
            self.add(
                f"if {name} * {_least(part.parts, Side.ROS2)} > end - i: raise ValueError('an array is too long')"
            )
            self.check_work(part, name)
            self.loop(part, name)
            return
        size, alignment = stride
        if self.padding(alignment) != 0:
            self.add(f"if {name}: i += -i & {alignment - 1}")
        self.add(f"{name} *= {size}")
        if part.side is Side.BOTH:
            self.add(f"add(s[i:i + {name}])")
        self.add(f"i += {name}")
        self.forget(min(4, size & -size))


def _stride(array: Items) -> tuple[int, int] | None:
    """Size and alignment of an element that is the same bytes in ROS 1 and in CDR; ``None`` if it is not."""
    numbers = [part for part in array.parts if isinstance(part, Number) and part.side is array.side]
    if not numbers or len(numbers) < len(array.parts):
        return None
    alignment, place = numbers[0].size, 0
    for part in numbers:
        if part.size > alignment or place % part.size:
            return None
        place += part.size * part.count
    return (place, alignment) if place % alignment == 0 else None


def _least(parts: Sequence[Part], side: Side) -> int:
    """The fewest bytes of an element at one side, but at least 1: none may be claimed without end."""
    total = 0
    for part in parts:
        if part.side in (Side.BOTH, side):
            if isinstance(part, Number):
                total += part.size * part.count
            elif isinstance(part, Text) or part.count is None:
                total += 4
            else:
                total += part.count * _least(part.parts, side)
    return max(total, 1)


def _work(parts: Iterable[Part], made: Side) -> int:
    """What a message, or an element, costs beyond its own bytes: turns of loops, and 64 bytes that are filled up.

    Arrays whose length each message says count by themselves.
    """
    total = 0
    for part in parts:
        if isinstance(part, Number):
            total += part.size * part.count // 64 if part.side is made else 0
        elif isinstance(part, Items) and part.count is not None:
            total += part.count * (1 + _work(part.parts, made))
    return total


_U32: Final = struct.Struct("<I")


def _compile(writer: _Writer, parts: Sequence[Part]) -> Callable[[Buffer, int], bytes]:
    """Make a function of its lines, which have nothing of the types but numbers."""
    lines = writer.write(parts)
    names: dict[str, Any] = {
        "HEAD": HEAD,
        "NULL": b"\0",
        "EMPTY": b"\1\0\0\0\0",
        "ZEROS": [bytes(count) for count in range(8)],
        "U": _U32.unpack_from,
        "P": _U32.pack,
        "TEXTS": writer.texts,
    }
    exec("\n".join(("def convert(s, end):", *lines)), names)  # noqa: S102 - see above
    made: Callable[[Buffer, int], bytes] = names["convert"]
    return made
