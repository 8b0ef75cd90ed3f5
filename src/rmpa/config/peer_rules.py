"""Reads the rules ``[[peer]]`` of ``rmpa.toml``: names and policy for single peers, and whether they fit each other.

Refused are rules that cannot be meant: names that no topic can have or that never cross, two names that would become
one (whose service would be called?), and names that lead back to themselves.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.config import limits
from rmpa.config.contract_rules import ConfigWarning
from rmpa.config.settings import PeerRule, PolicySettings, Remap
from rmpa.config.values import BadValue, did_you_mean, read_list, read_text, read_topic_glob, read_type_glob
from rmpa.core.names import NEVER_CROSSING, is_global_name, matches

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

_T = TypeVar("_T")
_Raw = TypeVar("_Raw")
Place = tuple[str | int, ...]

PEER: Final = "{peer}"
"""Stands for the peer's name in a rule."""
_SOME_PEER: Final = "peer"
_PEER_GLOB: Final = re.compile(r"[A-Za-z0-9_*?]+")
_REMAP_KEYS: Final = ("direction", "from", "to", "types")
_DIRECTIONS: Final = ("in", "out")


def _read_own_glob(raw: object) -> str:
    """A glob over topics, with ``{peer}`` in it perhaps."""
    try:
        read_topic_glob(raw.replace(PEER, _SOME_PEER) if isinstance(raw, str) else raw)
    except BadValue as error:
        if error.better is not None and isinstance(raw, str):
            error.better = f"/{raw.strip()}"
        raise
    return read_text(raw).strip()


_POLICY: Final = {
    "allow": _read_own_glob,
    "deny": _read_own_glob,
    "allow_types": read_type_glob,
    "deny_types": read_type_glob,
}


@dataclass(frozen=True, slots=True)
class PeerRules:
    """All rules, in the order of the file, and what is doubtful about them."""

    rules: tuple[PeerRule, ...] = ()
    doubts: tuple[ConfigWarning, ...] = ()


@dataclass(frozen=True, slots=True)
class _Placed:
    """A remap and where it is written; its names with some peer's name filled in."""

    remap: Remap
    at: Place
    source: str
    target: str


def read_peers(raw: object) -> PeerRules:
    """Every ``[[peer]]`` of a file, each as a table of its keys (of known names, as ``config.file`` checks).

    Raises:
        BadValue: ``at`` says which rule, key and element.
    """
    if not isinstance(raw, list | tuple):
        raise BadValue(f"{raw!r} is not a list")
    rules: list[PeerRule] = []
    places: list[dict[str, list[_Placed]]] = []
    for index, table in enumerate(raw):
        rule, placed = _within((index,), _read_rule, table)
        rules.append(rule)
        places.append(
            {way: [replace(place, at=(index, *place.at)) for place in found] for way, found in placed.items()}
        )
    for index, rule in enumerate(rules):
        together = [i for i in range(index + 1) if i == index or _meet(rules[i].name, rule.name)]
        for direction in _DIRECTIONS:
            _check([placed for i in together for placed in places[i][direction]])
    return PeerRules(tuple(rules), tuple(_doubts(rules)))


def _meet(one: str, other: str) -> bool:
    """Whether two globs over peers' names surely fit a peer in common."""
    return one == other or matches(one, other) or matches(other, one)


def _read_rule(table: Mapping[str, object]) -> tuple[PeerRule, dict[str, list[_Placed]]]:
    if "name" not in table:
        raise BadValue("a rule without a name", 'name = "robot*" makes it one for those peers, "*" for all')
    name = _within(("name",), _read_peer_glob, table["name"])
    prefix = _within(("prefix",), _read_prefix, table["prefix"]) if "prefix" in table else ""
    placed: dict[str, list[_Placed]] = {direction: [] for direction in _DIRECTIONS}
    for index, written in enumerate(_tables(table.get("remap", ()))):
        direction, read = _within(("remap", index), _read_remap, written)
        placed[direction].append(replace(read, at=("remap", index)))
    for direction in _DIRECTIONS:
        key = f"remap_{direction}"
        renames = table.get(key, {})
        assert isinstance(renames, dict)  # noqa: S101 - core.config_file has checked the types
        for source, target in renames.items():
            read = _within((key, source), partial(_placed, source), target)
            placed[direction].append(replace(read, at=(key, source)))
        if len(placed[direction]) > limits.REMAPS_MAX:
            raise BadValue(
                f"{len(placed[direction])} rules", f"at most {limits.REMAPS_MAX}; rename namespaces", at=(key,)
            )
    policy = {
        key: _within((key,), partial(_read_globs, item), table[key]) for key, item in _POLICY.items() if key in table
    }
    incoming, outgoing = (tuple(p.remap for p in placed[direction]) for direction in _DIRECTIONS)
    return PeerRule(name, prefix, incoming, outgoing, PolicySettings(**policy)), placed


def _read_globs(item: Callable[[object], str], raw: object) -> tuple[str, ...]:
    return read_list(raw, item)


def _tables(raw: object) -> Sequence[Mapping[str, object]]:
    assert isinstance(raw, list | tuple)  # noqa: S101 - core.config_file has checked the types
    return raw


def _within(at: Place, read: Callable[[_Raw], _T], raw: _Raw) -> _T:
    """Read something; a mistake in it is at its place."""
    try:
        return read(raw)
    except BadValue as error:
        error.at = (*at, *error.at)
        raise


def _read_peer_glob(raw: object) -> str:
    glob = read_text(raw).strip()
    if not _PEER_GLOB.fullmatch(glob) or "**" in glob:
        raise BadValue(
            f"{glob!r} is not a glob over peers' names", "such as robot1, robot* or robot?; * is every peer"
        )
    return glob


def _read_prefix(raw: object) -> str:
    prefix = read_text(raw).strip()
    if prefix.strip("/") == "":
        raise BadValue(f"{prefix!r} puts nothing in front", "leave it out, or name a namespace")
    if prefix != (better := "/" + prefix.strip("/")):
        raise BadValue(f"{prefix!r} is not a namespace", better=better)
    _check_name(prefix)
    return prefix


def _read_remap(table: Mapping[str, object]) -> tuple[str, _Placed]:
    for key in table:
        if key not in _REMAP_KEYS:
            near = did_you_mean(key, _REMAP_KEYS)
            raise BadValue(
                "an unknown key",
                f"did you mean {near}?" if near else f"known here: {', '.join(_REMAP_KEYS)}",
                at=(key,),
            )
    for key in _REMAP_KEYS[:3]:
        if key not in table:
            raise BadValue(
                f"a rule without {key}", 'one has direction = "in", from = "/odom" and to = "/robot1/odom"'
            )
    direction = _within(("direction",), _read_direction, table["direction"])
    types = (
        _within(("types",), lambda raw: read_list(raw, read_type_glob), table["types"]) if "types" in table else ()
    )
    if "types" in table and not types:
        raise BadValue("an empty list fits nothing", "leave types out, or name some", at=("types",))
    source = _within(("from",), _read_end, table["from"])
    return direction, _within(("to",), lambda raw: _placed(source, raw, types), table["to"])


def _read_direction(raw: object) -> str:
    if raw not in _DIRECTIONS:
        raise BadValue(f"{raw!r} is not a direction", '"in" renames what they have, "out" what we have')
    return str(raw)


def _placed(source: object, target: object, types: tuple[str, ...] = ()) -> _Placed:
    before, after = _read_end(source), _read_end(target)
    if before.endswith("/**") is not after.endswith("/**"):
        raise BadValue(
            f"{before} and {after} do not fit each other",
            "a namespace becomes a namespace: both end with /**, or none",
        )
    remap = Remap(before, after, types)
    return _Placed(remap, (), before.replace(PEER, _SOME_PEER), after.replace(PEER, _SOME_PEER))


def _read_end(raw: object) -> str:
    """A name, or a namespace with ``/**`` behind it."""
    end = read_text(raw).strip()
    stem = end.removesuffix("/**")
    if re.search(r"[*?]", stem):
        raise BadValue(f"{end!r} is not a name", "a rule renames /one/name, or all of a /namespace/**")
    if stem and not stem.startswith("/"):
        raise BadValue(f"{end!r} is not a global name", better=f"/{end}")
    if stem or end != "/**":
        _check_name(stem)
    return end


def _check_name(name: str) -> None:
    filled = name.replace(PEER, _SOME_PEER)
    if name == "/" or not is_global_name(filled):
        raise BadValue(
            f"{name!r} is not a ROS name", "one looks like /robot1/odom; {peer} stands for the peer's name"
        )
    if len(filled) > limits.CROSSING_NAME_MAX:
        raise BadValue(f"a name of {len(filled)} characters", f"at most {limits.CROSSING_NAME_MAX} cross the mesh")
    for pattern, why in NEVER_CROSSING.items():
        if matches(pattern, filled):
            raise BadValue(f"{name} never crosses: {why}", "leave this rule out")


# --- whether the rules of one direction fit each other --------------------------------------------------------------


def _check(rules: Sequence[_Placed]) -> None:
    for rule in rules:
        _check_end(rules, rule)
    for one, other in combinations(rules, 2):
        if not (one.remap.types and other.remap.types and set(one.remap.types).isdisjoint(other.remap.types)):
            _check_pair(rules, one, other)


def _check_end(rules: Sequence[_Placed], rule: _Placed) -> None:
    """Refuse names that lead back to themselves: nobody can say which of them is meant."""
    way = [_sample(rule.source)]
    for _ in range(len(rules) + 1):
        _, name = _first_fit(rules, way[-1])
        if name in {None, way[-1]}:
            return
        assert name is not None  # noqa: S101 - as just seen
        if name in way:
            shown = ", which becomes ".join([*way[way.index(name) + 1 :], name])
            problem = f"these rules undo each other: {name} becomes {shown}"
            raise BadValue(problem, "a name is renamed once; leave one of them out", at=rule.at)
        way.append(name)


def _check_pair(rules: Sequence[_Placed], one: _Placed, other: _Placed) -> None:
    """Refuse two names that would become one."""
    longer, shorter = (one, other) if len(_stem(one.target)) >= len(_stem(other.target)) else (other, one)
    target = _sample(longer.target)
    sources = [_before(rule, target) for rule in (longer, shorter)]
    if None in sources or sources[0] == sources[1]:
        return
    if all(
        _first_fit(rules, str(name)) == (rule, target) for rule, name in zip((longer, shorter), sources, strict=True)
    ):
        ends = f"{one.remap.source} and {other.remap.source}"
        problem = f"{ends} would both become {target.removesuffix('/x') if longer.target.endswith('/**') else target}"
        raise BadValue(problem, "two topics or services of one name cannot be told apart", at=other.at)


def _stem(end: str) -> str:
    return end.removesuffix("/**")


def _sample(end: str) -> str:
    """A name that an end stands for."""
    return end[:-3] + "/x" if end.endswith("/**") else end


def _before(rule: _Placed, target: str) -> str | None:
    """The name that a rule would make this one of."""
    if not rule.target.endswith("/**"):
        return rule.source if target == rule.target else None
    stem = _stem(rule.target)
    return _stem(rule.source) + target[len(stem) :] if target == stem or target.startswith(stem + "/") else None


def _first_fit(rules: Sequence[_Placed], name: str) -> tuple[_Placed | None, str | None]:
    for rule in rules:
        if not rule.source.endswith("/**"):
            if name == rule.source:
                return rule, rule.target
        elif name == (stem := _stem(rule.source)) or name.startswith(stem + "/"):
            return rule, _stem(rule.target) + name[len(stem) :]
    return None, None


def _doubts(rules: Sequence[PeerRule]) -> Iterator[ConfigWarning]:
    for index, rule in enumerate(rules):
        if rule == PeerRule(rule.name):
            yield ConfigWarning((index,), "a rule that sets nothing")
        if rule.prefix and PEER not in rule.prefix and re.search(r"[*?]", rule.name):
            text = f"{rule.prefix} is one place for every peer that {rule.name} fits; /{PEER} would keep them apart"
            yield ConfigWarning((index, "prefix"), text)
