#!/usr/bin/env python3
"""What the ELF files below a folder ask of the machine: packaging/bundle/elf.py FOLDER [2.27].

Prints the newest glibc that is needed, and the files that need it. Fails where one needs a newer glibc than given, a
shared library that is neither glibc's nor in FOLDER, or has a RUNPATH, which LD_LIBRARY_PATH precedes.
"""

import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

# Shared libraries that are glibc's own.
GLIBC = {"libc.so.6", "libm.so.6", "libpthread.so.0", "libdl.so.2", "librt.so.1", "libutil.so.1"}
GLIBC |= {"ld-linux-x86-64.so.2", "ld-linux-aarch64.so.1"}
# What python3 itself has, for glibc that does not (old-glibc.c).
OURS = {"fcntl64"}
_LOAD, _DYNAMIC, _DYNSYM, _VERSYM_SECTION = 1, 2, 11, 0x6FFFFFFF
_NEEDED, _STRTAB, _RUNPATH, _VERNEED = 1, 5, 29, 0x6FFFFFFE
_WEAK = 2

Version = tuple[int, ...]


class Need(NamedTuple):
    """A version of a library's symbols: the place of its flags in the file, whether it is weak, its symbols."""

    library: str
    name: str
    place: int
    weak: bool
    symbols: dict[str, bool]

    @property
    def glibc(self) -> Version:
        """The release of glibc that has it."""
        number = self.name.removeprefix("GLIBC_")
        return tuple(map(int, number.split("."))) if number != self.name and number[0].isdigit() else ()


class File:
    """The dynamic section of an ELF file of a machine with 64 bits; ``needs`` is what it asks for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._data = data = path.read_bytes()
        self.loaded = data[:6] == b"\x7fELF\x02\x01"
        self.libraries: set[str] = set()
        self.runpath = False
        self.needs: list[Need] = []
        if self.loaded:
            self._read()

    def _read(self) -> None:
        data = self._data
        size, count = struct.unpack_from("<HH", data, 54)
        start = struct.unpack_from("<Q", data, 32)[0]
        heads = [struct.unpack_from("<IIQQQQQQ", data, start + size * n) for n in range(count)]
        spans = [(address, offset, length) for kind, _, offset, address, _, length, _, _ in heads if kind == _LOAD]

        def at(address: int) -> int:
            return next(
                int(address - first + place) for first, place, size in spans if first <= address < first + size
            )

        dynamic = [(place, length) for kind, _, place, _, _, length, _, _ in heads if kind == _DYNAMIC]
        entries = [pair for place, length in dynamic for pair in self._pairs(place, length)]
        values = dict(entries)
        self.loaded = _STRTAB in values
        if not self.loaded:
            return
        self._strings = at(values[_STRTAB])
        self.libraries = {self._text(value) for tag, value in entries if tag == _NEEDED}
        self.runpath = _RUNPATH in values
        if _VERNEED in values:
            self.needs = [*self._versions(at(values[_VERNEED]), self._symbols())]

    def _text(self, offset: int) -> str:
        begin = self._strings + offset
        return self._data[begin : self._data.index(0, begin)].decode()

    def _pairs(self, offset: int, length: int) -> Iterator[tuple[int, int]]:
        for place in range(offset, offset + length, 16):
            tag, value = struct.unpack_from("<QQ", self._data, place)
            if tag == 0:
                return
            yield tag, value

    def _symbols(self) -> dict[int, dict[str, bool]]:
        """Undefined symbols by the index of their version, each with whether it is weak."""
        data = self._data
        start = struct.unpack_from("<Q", data, 40)[0]
        size, count = struct.unpack_from("<HH", data, 58)
        heads = [struct.unpack_from("<IIQQQQIIQQ", data, start + size * n) for n in range(count)]
        sections = {head[1]: head for head in heads}
        found: dict[int, dict[str, bool]] = {}
        _, _, _, _, table, length, *_ = sections[_DYNSYM]
        versions = sections[_VERSYM_SECTION][4]
        for n in range(length // 24):
            name, info, _, section = struct.unpack_from("<IBBH", data, table + 24 * n)
            if section == 0 and name:
                version = struct.unpack_from("<H", data, versions + 2 * n)[0] & 0x7FFF
                found.setdefault(version, {})[self._text(name)] = info >> 4 == _WEAK
        return found

    def _versions(self, need: int, symbols: dict[int, dict[str, bool]]) -> Iterator[Need]:
        while True:
            _, count, library, first, following = struct.unpack_from("<HHIII", self._data, need)
            entry = need + first
            for _ in range(count):
                _, flags, index, name, step = struct.unpack_from("<IHHII", self._data, entry)
                weak = bool(flags & _WEAK)
                yield Need(self._text(library), self._text(name), entry + 4, weak, symbols.get(index & 0x7FFF, {}))
                entry += step
            if not following:
                return
            need += following

    def loosen(self, bound: Version) -> None:
        """Let an older glibc load the file where each symbol of a newer one is weak, or python3 has it itself.

        The version then is weak too: the loader goes on without it.
        """
        data = bytearray(self._data)
        for need in self.needs:
            if need.glibc > bound and all(weak or name in OURS for name, weak in need.symbols.items()):
                struct.pack_into("<H", data, need.place, _WEAK)
        if data != self._data:
            self.path.write_bytes(data)


def files_of(folder: Path) -> Iterator[File]:
    """The files below a folder that the loader loads."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.is_symlink():
            file = File(path)
            if file.loaded:
                yield file


def problems(folder: Path, bound: Version) -> Iterator[str]:
    """What breaks the rules below a folder."""
    inside = {path.name for path in folder.rglob("*.so*")}
    for file in files_of(folder):
        name = file.path.relative_to(folder)
        for need in file.needs:
            if need.glibc > bound and not need.weak:
                yield f"{name} needs {need.name}: {', '.join(sorted(need.symbols))}"
        if missing := file.libraries - GLIBC - inside:
            yield f"{name} needs {', '.join(sorted(missing))} of the host"
        if file.runpath:
            yield f"{name} has RUNPATH: a library of LD_LIBRARY_PATH would come first"


def main() -> int:
    """Check a folder."""
    if not 2 <= len(sys.argv) <= 3:
        print(__doc__.splitlines()[0], file=sys.stderr)
        return 2
    folder = Path(sys.argv[1])
    needs = [(need.glibc, file) for file in files_of(folder) for need in file.needs if not need.weak]
    newest = max((version for version, _ in needs), default=())
    print(
        f"glibc {'.'.join(map(str, newest))} for", ", ".join(sorted({f.path.name for v, f in needs if v == newest}))
    )
    found = [*problems(folder, tuple(map(int, sys.argv[2].split("."))) if len(sys.argv) > 2 else newest)]
    print(*found, sep="\n", end="\n" if found else "")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
