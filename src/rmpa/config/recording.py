"""The settings of the recorder: ``[record]``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from rmpa.config.schema import setting
from rmpa.config.values import (
    BOOL,
    RATE,
    TOPIC_GLOB,
    TYPE_GLOB,
    ValueType,
    duration_of,
    list_of,
    read_bytes_a_second,
    whole_number,
    word_of,
)

_MEGABYTES: Final = whole_number(1, 1_000_000, "a number of MB", "MB")
_BYTES_A_SECOND: Final = ValueType(
    read_bytes_a_second, {"anyOf": [{"type": "number"}, {"type": "string"}], "examples": ["2 MB/s", "unlimited"]}
)
# What keeps a recording by itself.
ALARM, PEER_LOST, NODE_DIED, CONTRACT = "alarm", "peer_lost", "node_died", "contract"
_REASON: Final = word_of(
    (ALARM, PEER_LOST, NODE_DIED, CONTRACT), "a reason", "it is alarm, peer_lost, node_died or contract"
)


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """What ``rmpa record`` keeps of the last minutes, and whether the agent starts it."""

    enabled: bool = setting(
        False, BOOL, "Start rmpa record with the agent, and restart it if it ends.", option="--record/--no-record"
    )
    topics: tuple[str, ...] = setting(("/**",), list_of(TOPIC_GLOB), "Topics of this module's nodes to record.")
    deny: tuple[str, ...] = setting((), list_of(TOPIC_GLOB), "Topics that are not recorded.", shown_default="none")
    seconds: float | None = setting(120.0, duration_of("a duration"), "How much of the past is there to keep.")
    megabytes: int = setting(512, _MEGABYTES, "The most that the past takes on the disk, MB.")
    kept_megabytes: int = setting(
        4096, _MEGABYTES, "The most that kept recordings take, MB; the oldest that no person asked for give way."
    )
    topic_rate: int | None = setting(
        4_000_000, _BYTES_A_SECOND, "The most that one topic may write; what is above it is left out, and counted."
    )
    total_rate: int | None = setting(
        None, _BYTES_A_SECOND, "The most that all topics together may write; likewise.", shown_default="unlimited"
    )
    thin: float | None = setting(5.0, RATE, "Messages a second of thin_types.")
    thin_types: tuple[str, ...] = setting(
        ("sensor_msgs/*Image", "sensor_msgs/PointCloud*"), list_of(TYPE_GLOB), "Types that are thinned."
    )
    keep_on: tuple[str, ...] = setting(
        (ALARM, PEER_LOST, NODE_DIED),
        list_of(_REASON),
        "What keeps a recording, at all modules that are linked: alarm, peer_lost, node_died, contract.",
    )
    stop_topics: tuple[str, ...] = setting(
        (),
        list_of(TOPIC_GLOB),
        "Topics of emergency stops: a message (of std_msgs/Bool: true) keeps a recording.",
        shown_default="none",
    )
    after: float | None = setting(5.0, duration_of("a duration"), "How long a recording goes on behind its reason.")
    fsync: float | None = setting(
        1.0, duration_of("a duration"), "How often the disk must have it: what a power cut may take; infinite: never."
    )
