"""Takes out of texts what no other person is to see: keys, tokens, passwords, users and their homes.

Hosts, modules and addresses can be replaced too, each by the same word wherever it stands.
"""

from __future__ import annotations

import re
from collections import Counter
from ipaddress import ip_address
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

_GONE: Final = "[redacted]"
# Every pattern takes a time linear in the text: it starts where no word goes on, or its repeats are bounded.
_LINE: Final = 4096
_LONG: Final = re.compile(rf"(?m)^(?=.{{{_LINE + 1}}})(.{{0,{_LINE - 1}}}\s|)(.*)$")  # cut between words
_TO_THE_END: Final = r"passw|passphrase|pwd|psk|authorization|cookie"  # their values may have blanks
_OTHERS: Final = (
    r"secret|token|credential|(?:api|private|access|shared)key|[-_]key(?![a-z])|auth(?![a-z])"
    r"|(?<!com)(?<!by)pass(?![a-z])|(?<![a-z])pw(?![a-z])"
)
_WORDS: Final = f"{_TO_THE_END}|{_OTHERS}"
_IS_SECRET: Final = re.compile(_WORDS, re.IGNORECASE)
# Names of files and the like: that they hold a secret does not make them one.
_IS_PLACE: Final = re.compile(r"(file|path|dir|folder)s?$", re.IGNORECASE)
# All up to the last @ of a word, as passwords may have any character; units of systemd have one too.
_USER_INFO: Final = re.compile(
    r"(?<!\S)((?:[\w.-]+=)?[\"'(<\[]{0,4}(?:[a-zA-Z][\w+.-]*://|(?:tcp|udp|tls|quic|wss?)/)?)"
    r"\S+@(?![\w.-]*\.(?:service|socket|target)\b)"
)
# By what is counted: the pattern, and what takes its place.
_RULES: Final[tuple[tuple[str, re.Pattern[str], str | Callable[[re.Match[str]], str]], ...]] = (
    ("private keys", re.compile(r"(?s)-----BEGIN ([A-Z0-9 ]{1,40})-----.*?(?:-----END \1-----|\Z)"), _GONE),
    ("ends of long lines", _LONG, lambda m: f"{m[1]}[{len(m[2])} characters cut]"),
    ("users and passwords of addresses", _USER_INFO, rf"\1{_GONE}@"),
    ("tokens", re.compile(r"(?i)\brmpa1-[a-z2-7]{8,}|(?<=bearer )[\w.~+/=-]{6,}|(?<=basic )[\w.~+/=-]{6,}"), _GONE),
    # As base64 has it, and the hexadecimal digits of a key. Those of md5 (a type's) and of a commit stay.
    ("random texts", re.compile(r"(?<![\w+-])(?=[\w+-]*\d)(?=[\w+-]*[a-z])(?=[\w+-]*[A-Z])[\w+-]{40,}={0,2}"), _GONE),
    ("random texts", re.compile(r"(?<![0-9a-fA-F])(?!(?:\w{32}|\w{40})\b)[0-9a-fA-F]{32,}"), _GONE),
)
_QUOTED: Final = r"\\?\"(?:[^\"\\\n]|\\.){0,200}\"|'[^'\n]{0,200}'"
_NAME: Final = r"[\w.-]{0,60}(?<!file)(?<!path)(?<!dir)(?<!folder)"
_IS: Final = r"\\?[\"']?[ \t]{0,9}[:=][ \t]{0,9}"
_NAMED: Final = tuple(
    re.compile(rf"(?i)({begin}(?:{words}){_NAME})({between})({_QUOTED}|{value})")
    for begin, words, between, value in (
        ("", _TO_THE_END, _IS, ".+"),
        ("", _OTHERS, _IS, r"\S+"),
        (r"(?<![\w-])--[\w-]{0,60}", _WORDS, r"\s{1,9}", r"\S+"),  # --token …
        (r"\b", "password|passphrase", r"[ \t]{1,9}(?:(?:is|was)[ \t]{1,9})?", r"\S+"),  # the password …
    )
)
_HOME: Final = re.compile(r"/(?:home|Users)/[^/\s\"':;,\])}]+|/root(?![\w-])")
_HOST: Final = re.compile(r"(?<=://)[A-Za-z][\w.-]*")
_ADDRESS: Final = re.compile(
    r"(?<![\w.])(?:\d{1,3}\.){3}\d{1,3}(?![\w.])|(?<![\w:])[0-9a-fA-F]{0,4}(?::[0-9a-fA-F]{0,4}){2,7}(?![\w:])"
)
_MAC: Final = re.compile(r"(?<![\w:])(?:[0-9a-fA-F]{2}:){5}[0-9a-fA-F]{2}(?![\w:])")
# Users' names that name no person: that of a service, or of many images.
_NO_PERSON: Final = frozenset({"root", "rmpa", "nobody", "user", "admin", "pi", "ubuntu", "ros", "robot"})


def without_passwords(text: str) -> str:
    """A text whose addresses have no user names and passwords."""
    return _USER_INFO.sub(rf"\1{_GONE}@", text)


class Redactor:
    """Redacts texts, and counts what it has taken out.

    Args:
        secrets: Texts that are secrets, wherever they stand.
        homes: Home directories.
        users: Names of users.

    Attributes:
        counts: How many were taken out, by what they are.
        aliases: The word for each host, module and address; empty: they stay.
    """

    def __init__(self, secrets: Iterable[str] = (), homes: Iterable[str] = (), users: Iterable[str] = ()) -> None:
        self._secrets = _any_of(secret for secret in secrets if len(secret) > 5)
        self._homes = _any_of(home for home in homes if home not in ("", "/"))
        self._users = _words(user for user in users if user not in _NO_PERSON)
        self.counts: Counter[str] = Counter()
        self.aliases: dict[str, str] = {}
        self._named: re.Pattern[str] | None = None

    def anonymise(self, texts: Iterable[str], hosts: Iterable[str], modules: Iterable[str]) -> None:
        """Give hosts, modules and addresses of these texts other names from now on."""
        texts = list(texts)
        found = [match for text in texts for match in _HOST.findall(text)]
        for kind, names in (("host", [*hosts, *found]), ("module", modules)):
            for number, name in enumerate(sorted({*names} - {"", "localhost", *self.aliases}), 1):
                self.aliases[name] = f"{kind}-{number}"
        self._named = _words(self.aliases)
        addresses = {each for text in texts for pattern in (_MAC, _ADDRESS) for each in pattern.findall(text)}
        self.aliases |= {each: f"address-{n}" for n, each in enumerate(filter(_is_telling, sorted(addresses)), 1)}

    def text(self, text: str) -> str:
        """A text without what is not to be seen."""
        text = self._swap("secrets of this machine", self._secrets, _GONE, text)
        for what, pattern, by in _RULES:
            text = self._swap(what, pattern, by, text)
        for pattern in _NAMED:
            text = self._swap("values of secret names", pattern, _value_of, text)
        for home in (self._homes, _HOME):
            text = self._swap("home directories", home, "~", text)
        text = self._swap("user names", self._users, "[user]", text)
        if self.aliases:
            for alias in (_MAC, _ADDRESS, self._named):
                text = self._swap("hosts and addresses", alias, lambda m: self.aliases.get(m[0], m[0]), text)
        return text

    def value(self, value: object, key: str = "") -> object:
        """A value as JSON has it, likewise; ``key`` is its name."""
        if isinstance(value, dict):
            return {self.text(str(name)): self.value(each, str(name)) for name, each in value.items()}
        if isinstance(value, list | tuple):
            return [self.value(each, key) for each in value]
        if not isinstance(value, str):
            return value
        if value and is_secret(key):
            self.counts["values of secret names"] += 1
            return _GONE
        return self.text(value)

    def _swap(
        self, what: str, pattern: re.Pattern[str] | None, by: str | Callable[[re.Match[str]], str], text: str
    ) -> str:
        if pattern is None:
            return text
        count = 0

        def swapped(match: re.Match[str]) -> str:
            nonlocal count
            new = by(match) if callable(by) else match.expand(by)
            count += new != match[0]
            return new

        text = pattern.sub(swapped, text)
        self.counts[what] += count
        return text


def _value_of(match: re.Match[str]) -> str:
    key, between, _ = match.groups()
    return f"{key}{between}{_GONE}" if is_secret(key) else match[0]


def is_secret(key: str) -> bool:
    """Whether the value of a variable or key is likely to be a secret."""
    return bool(_IS_SECRET.search(key)) and not _IS_PLACE.search(key)


def _is_telling(text: str) -> bool:
    """Whether an address tells anything of a network."""
    try:
        address = ip_address(text)
    except ValueError:
        return bool(_MAC.fullmatch(text))
    return not (address.is_loopback or address.is_unspecified or address.is_multicast or text.startswith("255."))


def _any_of(texts: Iterable[str]) -> re.Pattern[str] | None:
    found = sorted({*texts}, key=len, reverse=True)
    return re.compile("|".join(map(re.escape, found))) if found else None


def _words(texts: Iterable[str]) -> re.Pattern[str] | None:
    pattern = _any_of(text for text in texts if text)
    return re.compile(rf"(?<![A-Za-z0-9_])(?:{pattern.pattern})(?![A-Za-z0-9_])") if pattern else None
