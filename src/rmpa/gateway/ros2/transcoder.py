"""Converts serialized messages between ROS 1 and CDR without making objects, where the fields have one order.

ROS 1 packs its fields without gaps. CDR (XCDR1, little-endian) aligns each number to its own size, counted from
behind its head of 4 bytes, and ends each string with a null byte that its length includes. For each pair of types a
function for each direction is written and compiled: it copies neighbouring numbers as one slice, has no calls for
nested messages, and skips fields that only one side has, or makes them zero.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from rmpa.gateway import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from rmpa.ros.wire.tcpros import Buffer

# The head of CDR: little-endian, no options.
HEAD: Final = b"\x00\x01\x00\x00"
# Bytes above which slices of a memoryview are quicker than those of bytes, for they are not copied twice.
_VIEWED: Final = 1 << 15
_U32: Final = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class LayoutPart:
    """Numbers of one size, an array, or a string.

    Args:
        size: Bytes of one number, which is its alignment too; 0 for a string or an array.
        count: How many numbers, or elements of an array; ``None``: one number, or as many elements as a message says.
        items: What one element of an array is made of; ``None``: it is no array.
        in1: Whether ROS 1's type has it.
        in2: Whether ROS 2's type has it.
        bound: The largest number of elements, or bytes of a string, in ROS 2; 0 for any.
        name: The field, for errors.
    """

    size: int = 0
    count: int | None = None
    items: tuple[LayoutPart, ...] | None = None
    in1: bool = True
    in2: bool = True
    bound: int = 0
    name: str = ""

    @property
    def bytes(self) -> int:
        """The bytes of its numbers."""
        return self.size * (1 if self.count is None else self.count)


class Transcoder:
    """The two functions for one pair of types.

    Args:
        parts: What a message is made of, in order.
        padded: Whether its CDR may have anything behind it. rclpy's serializer, by which requests and responses come,
            leaves the room there that it took too much: some bytes for each empty sequence of numbers of 8 bytes.

    Raises:
        ValueError: Arrays of a fixed length make each message too much work.
    """

    def __init__(self, parts: Sequence[LayoutPart], *, padded: bool = False) -> None:
        if max(_work(parts, to_cdr=False), _work(parts, to_cdr=True)) > limits.ROS2_WORK_MAX:
            raise ValueError("its arrays of a fixed length are too large")
        self._to_cdr = _compile(parts, to_cdr=True)
        self._to_ros1 = _compile(parts, to_cdr=False, padded=padded)

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


class FunctionText:
    """Writes the text of one function, which has nothing of the types but numbers.

    ``s`` is the source, ``i`` the place in it, and ``c`` that in CDR where it is made. What is known of the place in
    CDR before the program runs is its rest ``_rest`` by ``_known``: after a string nothing (1), after an alignment
    the alignment.

    Attributes:
        texts: The names of fields, for errors: ``TEXTS`` of the function, whose code has none.
    """

    def __init__(self, *, to_cdr: bool) -> None:
        self._to_cdr = to_cdr
        self._lines: list[str] = []
        self._indent = 1
        self._known = 8
        self._rest = 0
        self._run = 0
        self._names = 0
        self.texts: list[str] = []

    def text(self, parts: Iterable[LayoutPart], *, padded: bool = False) -> str:
        """The function for a message of these parts; ``padded``: with anything behind them."""
        self.add("i = c = t = 0", f"out = [{'HEAD' if self._to_cdr else ''}]", "add = out.append")
        self._parts(parts)
        # Some serializers of CDR fill the end up to 4 bytes.
        wrong = "i != end" if self._to_cdr else "i > end" if padded else "not i <= end <= i + 3"
        self.add(f"if {wrong}: raise ValueError(f'a message of {{end}} bytes has {{i}}')", "return b''.join(out)")
        return "\n".join(("def convert(s, end):", *self._lines))

    def add(self, *lines: str) -> None:
        """Add lines at the present indentation."""
        self._lines += [" " * self._indent + line for line in lines]

    def _moved(self, size: int) -> None:
        self._rest = (self._rest + size) % self._known

    def _forget(self, known: int = 1) -> None:
        self._known, self._rest = known, 0

    def _flush(self) -> None:
        if self._run:
            run, self._run = self._run, 0
            self._pass(run)

    def _pass(self, size: int | str, sides: tuple[bool, bool] = (True, True), zeros: str = "") -> None:
        """Copy bytes, skip those that the source alone has, or make zeros for those that the target alone has."""
        made, sourced = sides
        if made:
            self.add(f"add(s[i:i + {size}])" if sourced else f"add({zeros or f'bytes({size})'})")
            if self._to_cdr:
                self.add(f"c += {size}")
        if sourced:
            self.add(f"i += {size}")

    def _align(self, size: int, when: str = "") -> None:
        """Align the place in CDR to numbers of a size; ``when``: a name that must not be 0 in the program."""
        padding = -self._rest % size if self._known >= size else None
        if padding == 0:
            return
        self._flush()
        condition = f"p and {when}" if when else "p"
        if not self._to_cdr:
            skip = padding if padding and not when else f"-i & {size - 1}"
            self.add(f"{f'if {when}: ' if when else ''}i += {skip}")
        elif padding and not when:
            self.add(f"add(ZEROS[{padding}])", f"c += {padding}")
        else:
            self.add(f"p = -c & {size - 1}", f"if {condition}:", " add(ZEROS[p])", " c += p")
        if padding is None:
            self._forget(size)
        else:
            self._moved(padding)

    def _sides(self, part: LayoutPart) -> tuple[bool, bool]:
        """Whether the target has a part, and whether the source has it."""
        return (part.in2, part.in1) if self._to_cdr else (part.in1, part.in2)

    def _parts(self, parts: Iterable[LayoutPart]) -> None:
        for part in parts:
            if part.size:
                self._number(part)
                continue
            self._flush()
            if part.items is None:
                self._text(part)
            elif part.count is not None:
                self._loop(part.items, str(part.count))
            else:
                self._sequence(part, part.items)
        self._flush()

    def _number(self, part: LayoutPart) -> None:
        if not part.bytes:
            return
        if part.in2:
            self._align(part.size)
        if part.in1 and part.in2:
            self._run += part.bytes
        else:
            self._flush()
            self._pass(part.bytes, self._sides(part))
        if part.in2:
            self._moved(part.bytes)

    def _length(self) -> str:
        """Read a length from the source, and return the name that has it."""
        self._names += 1
        self.add(f"n{self._names} = U(s, i)[0]")
        return f"n{self._names}"

    def _text(self, part: LayoutPart) -> None:
        sides = made, sourced = self._sides(part)
        if part.in2:
            self._align(4)
        if not sourced:
            self._pass(5 if self._to_cdr else 4, sides, "EMPTY" if self._to_cdr else "ZEROS[4]")
        elif not made:
            self.add("i += 4 + U(s, i)[0]")
        elif self._to_cdr:
            name = self._length()
            self._check_bound(part, name, "bytes")
            self.add(f"add(P({name} + 1))", f"add(s[i + 4:i + 4 + {name}])", "add(NULL)")
            self.add(f"i += 4 + {name}", f"c += 5 + {name}")
        else:
            name = self._length()
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
        if part.in2:
            self._forget()

    def _sequence(self, part: LayoutPart, items: tuple[LayoutPart, ...]) -> None:
        sides = self._sides(part)
        if part.in2:
            self._align(4)
        name = self._length() if sides[1] else ""
        self._pass(4, sides)
        if part.in2:
            self._moved(4)
        if not name:
            return
        self._check_bound(part, name, "elements")
        stride = _stride(part, items)
        if stride is None:
            least = _least(items, in1=self._to_cdr)
            self.add(f"if {name} * {least} > end - i: raise ValueError('an array is too long')")
            # Few bytes may claim many elements, each of which the other side fills up.
            self.add(f"t += {name} * {1 + _work(items, to_cdr=self._to_cdr)}")
            self.add(f"if t > {limits.ROS2_WORK_MAX}: raise ValueError('its arrays have too many elements')")
            self._loop(items, name)
            return
        size, alignment = stride
        if part.in2:
            self._align(alignment, when=name)
        self.add(f"{name} *= {size}")
        self._pass(name, sides)
        if part.in2:
            self._forget(min(4, size & -size))

    def _loop(self, items: tuple[LayoutPart, ...], count: str) -> None:
        self.add(f"for _ in range({count}):", " pass")
        self._indent += 1
        self._forget()
        self._parts(items)
        self._indent -= 1
        self._forget()

    def _check_bound(self, part: LayoutPart, name: str, what: str) -> None:
        if part.bound and self._to_cdr:
            self.texts.append(part.name)
            text = f"{{TEXTS[{len(self.texts) - 1}]}} has {{{name}}} {what}; ROS 2 allows {part.bound}"
            self.add(f"if {name} > {part.bound}: raise ValueError(f'{text}')")


def _stride(part: LayoutPart, items: tuple[LayoutPart, ...]) -> tuple[int, int] | None:
    """Size and alignment of an element that is the same bytes in ROS 1 and in CDR; ``None`` if it is not."""
    if not items or not all(each.size and (each.in1, each.in2) == (part.in1, part.in2) for each in items):
        return None
    alignment, place = items[0].size, 0
    for each in items:
        if each.size > alignment or place % each.size:
            return None
        place += each.bytes
    return (place, alignment) if place % alignment == 0 else None


def _least(parts: Iterable[LayoutPart], *, in1: bool) -> int:
    """The fewest bytes of an element at one side, but at least 1: none may be claimed without end."""
    total = 0
    for part in parts:
        if not (part.in1 if in1 else part.in2):
            continue
        if part.items is not None and part.count is not None:
            total += part.count * _least(part.items, in1=in1)
        else:
            total += part.bytes if part.size else 4
    return max(total, 1)


def _work(parts: Iterable[LayoutPart], *, to_cdr: bool) -> int:
    """What a message, or an element, costs beyond its own bytes: turns of loops, and 64 bytes that are filled up.

    Arrays whose length each message says count by themselves.
    """
    total = 0
    for part in parts:
        if part.items is not None:
            total += (part.count or 0) * (1 + _work(part.items, to_cdr=to_cdr))
        elif part.in1 != part.in2 and part.in2 == to_cdr:
            total += part.bytes // 64
    return total


def _compile(parts: Sequence[LayoutPart], *, to_cdr: bool, padded: bool = False) -> Callable[[Buffer, int], bytes]:
    writer = FunctionText(to_cdr=to_cdr)
    text = writer.text(parts, padded=padded)
    names: dict[str, Any] = {
        "HEAD": HEAD,
        "NULL": b"\0",
        "EMPTY": b"\1\0\0\0\0",
        "ZEROS": [bytes(count) for count in range(8)],
        "U": _U32.unpack_from,
        "P": _U32.pack,
        "TEXTS": writer.texts,
    }
    exec(text, names)  # noqa: S102 - see the class's docstring
    made: Callable[[Buffer, int], bytes] = names["convert"]
    return made
