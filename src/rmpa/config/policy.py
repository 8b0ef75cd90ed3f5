"""``[bridge]``: which topics may cross; a ``[[peer]]`` has the same four keys for its peers."""

from __future__ import annotations

from dataclasses import dataclass

from rmpa.config.schema import setting
from rmpa.config.values import TOPIC_GLOB, TYPE_GLOB, list_of


@dataclass(frozen=True, slots=True)
class PolicySettings:
    """The topics and types that may cross the mesh, by globs (``core.names.matches``).

    A topic crosses if one of ``allow`` matches it and none of ``deny``, its type likewise; of several policies each
    must let it cross.
    """

    allow: tuple[str, ...] = setting(
        ("/**",), list_of(TOPIC_GLOB), "Topics that may cross; `[]` lets none cross.", env="RMPA_ALLOW"
    )
    deny: tuple[str, ...] = setting(
        (), list_of(TOPIC_GLOB), "Topics that stay home, besides the built-in ones.", env="RMPA_DENY"
    )
    allow_types: tuple[str, ...] = setting(
        ("**",), list_of(TYPE_GLOB), "Message types that may cross.", env="RMPA_ALLOW_TYPES"
    )
    deny_types: tuple[str, ...] = setting(
        (), list_of(TYPE_GLOB), "Message types that stay home.", env="RMPA_DENY_TYPES"
    )
