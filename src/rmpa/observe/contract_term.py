"""The terms of a topic's contract by the settings of a module, which the topic has before any route is open."""

from __future__ import annotations

import msgspec


class ContractTerm(msgspec.Struct, kw_only=True, frozen=True):
    """One term of a topic's contract by this module's settings; values of the operation ``contract``, by key.

    Attributes:
        value: Its value; seconds, messages a second, or a word of docs/contracts.md.
        rule: What sets it: ``rule 2: topics /cmd/**`` (the second ``[[contract]]``), ``[bridge] transport``, or
            ``default``.
    """

    value: str | float | None
    rule: str
