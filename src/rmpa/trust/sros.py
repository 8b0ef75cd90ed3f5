"""Reads the permissions of SROS 2 (``permissions.xml`` of DDS Security 1.1, section 9.4.1.3) as rules of RMPA.

A grant says what its subject may do; in RMPA each module says what others may do there. So a grant becomes rules
about the module of its subject, to be used at the other modules:

=================================  ===================================
topic of DDS (design.ros2.org)     key of the rule
=================================  ===================================
``rt/NAME``                        ``publish``, ``subscribe``
``rq/NAMERequest``, published      ``call``
``rr/NAMEReply``, published        ``serve``
``rq/NAME/_action/send_goal…``     ``action``
``rr/NAME/_action/send_goal…``     ``action_serve``
``*``                              all of these
=================================  ===================================

What has no counterpart is left out and reported as a note. ``*`` of DDS crosses slashes, so it becomes ``**``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from xml.etree.ElementTree import Element, ParseError, TreeBuilder

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from rmpa.config.permission_rules import ACTION_CLIENT, ACTION_SERVER, NAME_KEYS, Access, Effect, PermissionRule
from rmpa.config.values import BadValue, read_topic_glob
from rmpa.core.errors import ConfigError
from rmpa.core.identity import peer_name_from
from rmpa.core.names import NEVER_CROSSING, matches
from rmpa.trust import limits
from rmpa.trust.sros_policy import policy_rules

if TYPE_CHECKING:
    from collections.abc import Iterator

_REMEDY: Final = "name the permissions.xml of an enclave, as `ros2 security` made it, or a policy.xml"
_COMMON_NAME: Final = re.compile(r"(?:^|[,/])\s*CN\s*=\s*(/?[^,]+)")
_PARAMETER_SERVICES: Final = re.compile(
    r"/(?:get_parameters|get_parameter_types|list_parameters|describe_parameters|set_parameters"
    r"(?:_atomically)?)$"
)
_ACTION: Final = "/_action/"
_PUBLISHED: Final = Access.PUBLISH.value
_SUBSCRIBED: Final = Access.SUBSCRIBE.value
_DIRECTIONS: Final = (_PUBLISHED, _SUBSCRIBED)


@dataclass(frozen=True, slots=True)
class SrosImport:
    """The rules that a file makes.

    Args:
        rules: In the order of the file.
        notes: What was left out or changed, for the user.
    """

    rules: tuple[PermissionRule, ...]
    notes: tuple[str, ...]


class _BoundedBuilder(TreeBuilder):
    """Builds the tree of a document that is not nested too deeply."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0

    def start(self, tag: str, attrs: dict[str, str], /) -> Element:
        """An element begins."""
        self._depth += 1
        if self._depth > limits.SROS_DEPTH_MAX:
            raise _bad(f"more than {limits.SROS_DEPTH_MAX} nested elements")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> Element:
        """An element ends."""
        self._depth -= 1
        return super().end(tag)


def read_sros(data: bytes) -> SrosImport:
    """Read a ``permissions.xml``, or the ``policy.xml`` that one is made of.

    Args:
        data: The file. The signed form (``permissions.p7s``) has the same text within; it is not checked here.

    Raises:
        ConfigError: The file is too large, not XML, declares entities or a document type, or has no permissions.
    """
    if len(data) > limits.SROS_FILE_MAX:
        raise _bad(f"{len(data)} bytes, more than {limits.SROS_FILE_MAX}")
    parser = DefusedXMLParser(target=_BoundedBuilder(), forbid_dtd=True)
    try:
        parser.feed(data)
        root = parser.close()
    except (ParseError, DefusedXmlException, ValueError, LookupError) as error:
        raise _bad(f"not XML that can be read: {error!s:.200}") from None
    notes: dict[str, None] = {}
    if root.tag == "policy" and root.find("enclaves") is not None:
        found = policy_rules(root, notes)
    elif root.tag == "dds" and root.find("permissions") is not None:
        found = (rule for grant in root.iterfind("permissions/grant") for rule in _grant(grant, notes))
    else:
        raise _bad("no permissions of DDS Security, and no policy of SROS 2")
    rules: list[PermissionRule] = []
    for rule in found:
        rules.append(rule)
        if len(rules) > limits.SROS_RULES_MAX:
            raise _bad(f"more than {limits.SROS_RULES_MAX} rules")
    return SrosImport(tuple(rules), tuple(notes))


def _bad(problem: str) -> ConfigError:
    return ConfigError("the file", problem, _REMEDY)


def _grant(grant: Element, notes: dict[str, None]) -> Iterator[PermissionRule]:
    """The rules of one grant."""
    label = repr(grant.get("name", "")[:100])
    module = _module(grant.findtext("subject_name", ""))
    if module is None:
        notes[f"grant {label} has no common name (CN) in its subject_name, and is left out"] = None
        return
    if grant.find("validity") is not None:
        notes["validity is ignored: certificates end by themselves"] = None
    allowed: dict[str, list[str]] = {}
    for rule in grant:
        if rule.tag not in ("allow_rule", "deny_rule"):
            continue
        effect = Effect.ALLOW if rule.tag == "allow_rule" else Effect.DENY
        names = _names(rule, effect, notes)
        if effect is Effect.DENY:
            _note_order(names, allowed, module, notes)
        else:
            for key, globs in names.items():
                allowed.setdefault(key, []).extend(globs)
        if names:
            yield PermissionRule((module,), (), effect, names)
    if (grant.findtext("default") or "DENY").strip().upper() == "ALLOW":
        # A deny wins over an allow here, so this holds for what nothing denies, as in DDS.
        keys = (Access.PUBLISH, Access.SUBSCRIBE, Access.CALL, Access.SERVE)
        yield PermissionRule((module,), (), Effect.ALLOW, {key.value: ("/**",) for key in keys})


def _module(subject: str) -> str | None:
    """The module of a subject: the last part of the common name, which is the path of an enclave."""
    match = _COMMON_NAME.search(subject)
    last = match[1].strip().rstrip("/").rpartition("/")[2] if match else ""
    return peer_name_from(last) if last else None


def _note_order(
    names: dict[str, tuple[str, ...]], allowed: dict[str, list[str]], module: str, notes: dict[str, None]
) -> None:
    """Report denials behind an allowance of the same names: DDS takes the first rule that fits."""
    for key, globs in names.items():
        for glob in globs:
            if any(matches(earlier, glob) or matches(glob, earlier) for earlier in allowed.get(key, ())):
                text = f"{module}: DDS never comes to the denial of {key} {glob}, behind an allow_rule that fits; "
                notes[text + "here a denial wins"] = None


def _names(rule: Element, effect: Effect, notes: dict[str, None]) -> dict[str, tuple[str, ...]]:
    """The names of one rule, by key."""
    for tag, what in (("relay", "relay"), ("domains", "domains")):
        if rule.find(tag) is not None:
            notes[f"{what} of rules are ignored"] = None
    found: dict[str, dict[str, None]] = {}
    for direction in _DIRECTIONS:
        for criteria in rule.iterfind(direction):
            for tag in ("partitions", "data_tags"):
                if criteria.find(tag) is not None:
                    notes[f"{tag} of rules are ignored"] = None
            for topic in criteria.iterfind("topics/topic"):
                for key, name in _translate((topic.text or "").strip(), direction, effect, notes):
                    found.setdefault(key, {})[name] = None
    return {key: tuple(found[key]) for key in NAME_KEYS if key in found}


def _translate(topic: str, direction: str, effect: Effect, notes: dict[str, None]) -> Iterator[tuple[str, str]]:
    """The keys and globs of one topic of DDS."""
    shown = repr(topic[:200])
    if topic == "*":
        yield direction, "/**"
        if direction == _PUBLISHED or effect is Effect.DENY:
            yield from ((key.value, "/**") for key in (Access.CALL, Access.SERVE))
        return
    kind, slash, rest = topic.partition("/")
    if not slash or kind not in ("rt", "rq", "rr"):
        if topic != "ros_discovery_info":
            notes[f"{shown} is no topic or service of ROS, and is left out"] = None
        return
    name = "/" + re.sub(r"\*+", "**", rest)
    if kind != "rt":
        name = name.removesuffix("Request" if kind == "rq" else "Reply")
    try:
        read_topic_glob(name)
    except BadValue as error:
        notes[f"{shown} is left out: {error.problem}"] = None
        return
    if why := next((why for pattern, why in NEVER_CROSSING.items() if matches(pattern, name)), ""):
        notes[f"{shown} is left out: {why}"] = None
    elif kind == "rt":
        if _ACTION not in name:
            yield direction, name
    else:
        yield from _service(kind, name, direction, effect, notes)


def _service(
    kind: str, name: str, direction: str, effect: Effect, notes: dict[str, None]
) -> Iterator[tuple[str, str]]:
    """The key of a request's or a reply's topic.

    Both topics of a service are granted together, so the published one alone decides; a denial of either prevents
    the call.
    """
    if direction == _SUBSCRIBED and effect is Effect.ALLOW:
        return
    is_client = (kind == "rq") is (direction == _PUBLISHED)
    if _ACTION in name:
        action, _, part = name.partition(_ACTION)
        if part == "send_goal" and action:
            yield (ACTION_CLIENT if is_client else ACTION_SERVER), action
    elif _PARAMETER_SERVICES.search(name):
        notes["services of ROS 2's parameters are left out: write param = [...] for parameters"] = None
    else:
        yield (Access.CALL if is_client else Access.SERVE).value, name


def to_toml(imported: SrosImport) -> str:
    """The rules as tables ``[[permission]]``, behind the notes as comments."""
    lines = [f"# {note}" for note in imported.notes]
    for rule in imported.rules:
        lines += ["", "[[permission]]", f"modules = {_toml_list(rule.modules)}"]
        if rule.effect is Effect.DENY:
            lines.append('effect = "deny"')
        lines += [f"{key} = {_toml_list(globs)}" for key, globs in rule.names.items()]
    return "\n".join(lines).lstrip("\n") + "\n"


def _toml_list(texts: tuple[str, ...]) -> str:
    return "[" + ", ".join(f'"{text}"' for text in texts) + "]"
