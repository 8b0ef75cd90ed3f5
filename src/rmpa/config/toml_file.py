"""A TOML file: parsed, and its keys and types checked against a JSON Schema; each mistake has its line and key.

A file of settings that another user may write is not obeyed, as ssh's StrictModes judges its own (sshd_config(5)).
The file counts, each folder above it, and each link on the way. This user and root may write there, and under
``sudo`` the user who called it.
"""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
import re
import stat
import tomllib
from bisect import bisect_left
from typing import TYPE_CHECKING, Any, Final

from rmpa.config import limits
from rmpa.config.settings import SETTINGS
from rmpa.config.values import JsonSchema, Place, did_you_mean, shown
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping
    from pathlib import Path

    from rmpa.config.schema import Key


def value_at(table: object, place: Place) -> object:
    """The value at a place of a parsed file; ``None`` if there is none."""
    for part in place:
        in_table = isinstance(table, dict) and part in table
        in_list = isinstance(table, list) and isinstance(part, int) and part < len(table)
        if not in_table and not in_list:
            return None
        table = table[part]  # type: ignore[index] # one of the two, as just seen
    return table


# What counts in a valid TOML text: strings, comments, brackets and the ends of lines.
_PIECE: Final = re.compile(
    r"""\"{3}(?:\\.|[^\\])*?\"{3,5}|'{3}.*?'{3,5}|"(?:\\.|[^"\\\n])*"|'[^'\n]*'|\#[^\n]*|[\[{\]}]|\n""", re.DOTALL
)
_CLOSES: Final = {"[": "]", "{": "}"}


def _line_ends(text: str) -> Iterator[tuple[int, str]]:
    """Each end of a line outside strings in a valid TOML text: the line's number, and what closes what is open."""
    line, closing = 0, ""
    for match in _PIECE.finditer(text):
        piece = match[0]
        if piece in _CLOSES:
            closing = _CLOSES[piece] + closing
        elif piece in _CLOSES.values():
            closing = closing[1:]
        line += piece.count("\n")
        if piece == "\n":
            yield line, closing


def line_of(text: str, place: Place) -> int | None:
    """The line, from 1, on which the key or element at a place begins in a valid TOML text; ``None`` if it has none.

    What stands before the end of a line, its brackets closed, is valid TOML. The first of these texts that contains
    the place has it behind the one before.
    """
    lines = text.split("\n")
    ends = [(0, ""), *_line_ends(text), (len(lines), "")]

    def has_place(end: tuple[int, str]) -> bool:
        return value_at(tomllib.loads("\n".join((*lines[: end[0]], end[1]))), place) is not None

    if not has_place(ends[-1]):
        return None
    return ends[bisect_left(ends, True, key=has_place) - 1][0] + 1


_AT_LINE: Final = re.compile(r" \(at line (\d+), column \d+\)$")
# By the name of a type in JSON Schema: the type of TOML values, and its name in errors.
_TYPES: Final[dict[str, tuple[type, str]]] = {
    "string": (str, "a text in quotes"),
    "integer": (int, "a whole number"),
    "number": (float, "a number"),
    "boolean": (bool, "true or false"),
    "array": (list, "a list"),
    "object": (dict, "a table"),
}


def read_toml(
    data: bytes, path: Path | None, schema: JsonSchema, found: list[ConfigError] | None = None
) -> tuple[str, dict[str, Any]]:
    """Read the bytes of a TOML file, and check its keys and types by a schema.

    Args:
        data: UTF-8 text in TOML.
        path: For the text of errors.
        schema: The keys and types that it may have, as JSON Schema.
        found: Gets all unknown keys and wrong types; without it the first is raised.

    Returns:
        The text, and what it says.

    Raises:
        ConfigError: With line and key, if the text is not TOML, has an unknown key or a value of a wrong type.
    """
    if len(data) > limits.CONFIG_FILE_MAX:
        raise ConfigError(
            "the file",
            f"{len(data)} bytes, more than {limits.CONFIG_FILE_MAX}",
            "is it the right file?",
            path,
            code="unreadable-settings",
        )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(
            "the file", "not UTF-8 text", "save it as UTF-8", path, line, code="unreadable-settings"
        ) from None
    table = _parse_toml(text, path)
    for place, problem, remedy in _mistakes((), table, schema, schema):
        wrong = ConfigError(dotted(place), problem, remedy, path, line_of(text, place))
        if found is None:
            raise wrong
        found.append(wrong)
    return text, table


def _mistakes(place: Place, value: object, schema: JsonSchema, root: JsonSchema) -> Iterator[tuple[Place, str, str]]:
    """Each unknown key and wrong type in a value: place, problem and remedy. All else is checked by the readers."""
    expected = schema.get("type", [])
    types = [expected] if isinstance(expected, str) else expected
    if types and type(value) not in [_TYPES[name][0] for name in types]:
        if isinstance(value, dict) and "properties" in schema.get("items", {}):
            remedy = f"write [[{dotted(place)}]], in two brackets"
            yield place, "one table, where a list of them is expected", remedy
            return
        remedy = f'did you mean ["{value}"]?' if types == ["array"] and isinstance(value, str) else ""
        yield place, f"{shown(value)} is not {' or '.join(_TYPES[name][1] for name in types)}", remedy
    elif isinstance(value, list):
        for index, element in enumerate(value):
            yield from _mistakes((*place, index), element, schema.get("items", {}), root)
    elif isinstance(value, dict):
        known, other = schema.get("properties", {}), schema.get("additionalProperties") or {}
        for key, inner in value.items():
            if known and key not in known and not other:
                what = "an unknown table" if isinstance(inner, dict) else "an unknown key"
                yield (*place, key), what, _suggestion(place, key, list(known), root)
            yield from _mistakes((*place, key), inner, known.get(key, other), root)


# Lists, tables or parts of a key within each other: nothing has so many, and tomllib takes minutes for very many.
_NESTED: Final = re.compile(r"""(?<![\w"'-])(?:[\w"'-]+\s*\.\s*){64}|(?:[\[{][^\[\]{}]*){64}""")


def _parse_toml(text: str, path: Path | None) -> dict[str, Any]:
    nested = _NESTED.search(text)
    try:
        table = tomllib.loads(text) if nested is None else None
    except RecursionError:
        table = None
    except ValueError as error:  # TOMLDecodeError, and int() on thousands of digits
        message = str(error)
        match = _AT_LINE.search(message)
        line = int(match[1]) if match else text.rstrip().count("\n") + 1
        problem = f"not TOML: {_AT_LINE.sub('', message).removesuffix(' (at end of document)')}"
        raise ConfigError(
            "the file", problem, _toml_remedy(text, line), path, line, code="unreadable-settings"
        ) from None
    if table is None:
        line = text.count("\n", 0, nested.start()) + 1 if nested is not None else 1
        raise ConfigError("the file", "lists or tables nested too deeply", "", path, line, code="unreadable-settings")
    return table


def _toml_remedy(text: str, line: int) -> str:
    lines = text.split("\n")
    written = lines[line - 1] if line <= len(lines) else ""
    match = re.match(r"\s*[\w.-]+\s*=\s*([^\s\"'\[{#][^#]*?)\s*(?:#.*)?$", written)
    if match and not re.match(r"(true|false|[-+0-9])", match[1]):
        return f'texts need quotes: "{match[1]}"'
    if re.match(r"\s*[\w.-]+\s*:", written):
        return "TOML writes key = value, not key: value"
    return ""


def dotted(place: Place) -> str:
    """A place as a user reads it, without the indices: the line says which one."""
    return ".".join(part for part in place if isinstance(part, str))


def _suggestion(place: Place, word: str, here: list[str], root: JsonSchema) -> str:
    """What to do about an unknown key: the key that was probably meant, or the table that it belongs in."""
    everywhere = list(_keys(root))
    homes = [key for key in everywhere if key[-1] == word]
    near = did_you_mean(word, here)
    if near is not None and (place or not homes):
        return f"did you mean {dotted((*place, near))}?"
    if homes:
        table = homes[0][:-1]
        titles = [setting.title for setting in SETTINGS if setting.key == table != ()]  # a table that is a list
        where = f"in a {titles[0]}" if titles else f"in [{dotted(table)}]" if table else "above the first table"
        return f"{word} belongs {where}"
    near = did_you_mean(word, [key[-1] for key in everywhere])
    if near is not None:
        return f"did you mean {next(dotted(key) for key in everywhere if key[-1] == near)}?"
    return f"known here: {', '.join(here)}"


def _keys(schema: JsonSchema, table: Key = ()) -> Iterator[Key]:
    """Every key of a table and of those in it."""
    for name, inner in schema["properties"].items():
        inside = inner.get("items", inner)
        named = inside.get("additionalProperties") or {}  # of tables that the user names
        if "properties" in inside:
            yield from _keys(inside, (*table, name))
        elif "properties" in named:
            yield from _keys(named, (*table, name, "NAME"))
        else:
            yield (*table, name)


def check_writers(path: Path, environ: Mapping[str, str], key: str) -> None:
    """Refuse a file of settings that another user may write; arguments as for ``other_writer``, and what names it.

    Raises:
        ConfigError: One may.
        OSError: A part of the path is gone.
    """
    if (found := other_writer(path, environ)) is not None:
        raise ConfigError(key, f"is not obeyed: {found[0]}", found[1], path, code="settings-exposed")


def other_writer(path: Path, environ: Mapping[str, str]) -> tuple[str, str] | None:
    """What of a file's path another user may write, and what to do; ``None``: nothing.

    Args:
        path: Of a file that is there.
        environ: Has SUDO_UID under ``sudo``.

    Raises:
        OSError: A part of the path is gone.
    """
    own = {0, os.geteuid()}
    caller = environ.get("SUDO_UID", "")
    if os.geteuid() == 0 and caller.isdecimal():
        own.add(int(caller))
    for part in _way(path.absolute()):
        if found := _problem(part, own):
            return found
    return None


def _way(path: Path) -> Iterator[Path]:
    """A path, the folders above it, and the same of what a link on the way leads to."""
    waiting, seen = [path], set()
    while waiting:
        at = waiting.pop()
        for part in (at, *at.parents):
            if part not in seen:
                seen.add(part)
                yield part
                if part.is_symlink():
                    waiting.append(part.parent / part.readlink())


def _problem(part: Path, own: Collection[int]) -> tuple[str, str] | None:
    info = part.lstat()
    part = part if stat.S_ISLNK(info.st_mode) else part.resolve()  # it is shown without dots
    if os.statvfs(part).f_flag & os.ST_RDONLY:
        return None  # a container's settings, mounted so
    if info.st_uid not in own:
        return f"{part} belongs to user {info.st_uid}", f"chown {os.geteuid()} {part}; in a container mount it :ro"
    folder, mode = stat.S_ISDIR(info.st_mode), stat.S_IMODE(info.st_mode)
    # In a folder such as /tmp each user writes what is its own alone.
    if stat.S_ISLNK(info.st_mode) or (folder and mode & stat.S_ISVTX):
        return None
    if mode & stat.S_IWOTH:
        return f"every user may write {part} (mode {mode:o})", f"chmod o-w {part}"
    if mode & stat.S_IWGRP and not _is_private(part, info.st_gid, own):
        return f"users of group {info.st_gid} may write {part} (mode {mode:o})", f"chmod g-w {part}"
    return None


def _is_private(part: Path, group: int, own: Collection[int]) -> bool:
    """Whether a group that may write has no other user, as the one that Debian makes for each user."""
    with contextlib.suppress(OSError):
        if "system.posix_acl_access" in os.listxattr(part):
            return False  # the group's rights are then the bound of all that the list names
    try:
        members = grp.getgrgid(group).gr_mem
        users = [pwd.getpwnam(name).pw_uid for name in members]
    except KeyError:
        return False
    return {*users, *(each.pw_uid for each in pwd.getpwall() if each.pw_gid == group)} <= {*own}
