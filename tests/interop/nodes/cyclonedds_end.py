"""A program of plain Cyclone DDS, without ROS 2: ``cyclonedds_end.py``. Reads lines of JSON as ``rclpy_end.py`` does.

``publish`` and ``subscribe`` of std_msgs/msg/String, by the names of ROS 2's topics. Events as there.
"""

import json
import sys
import threading
import time
from dataclasses import dataclass
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from node import say

RELIABLE = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(100))


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):  # type: ignore[call-arg, misc]
    data: str


class End:
    """The participant, and what was made of it."""

    def __init__(self) -> None:
        self.participant = DomainParticipant(0)
        self.writers: dict[str, Any] = {}
        self.readers: dict[str, Any] = {}

    def publish(self, topic: str, text: str, count: int = 1, rate: float = 1000) -> None:
        if topic not in self.writers:
            self.writers[topic] = DataWriter(
                self.participant, Topic(self.participant, "rt" + topic, String), qos=RELIABLE
            )
        for number in range(1, count + 1):
            self.writers[topic].write(String(data=f"{text} {number}"))
            time.sleep(1 / rate)

    def subscribe(self, topic: str) -> None:
        self.readers[topic] = DataReader(
            self.participant, Topic(self.participant, "rt" + topic, String), qos=RELIABLE
        )

    def read(self) -> None:
        while True:
            for topic, reader in tuple(self.readers.items()):
                for message in reader.take(100):
                    say("heard", topic=topic, data=message.data)
            time.sleep(0.01)


def main() -> None:
    end = End()
    threading.Thread(target=end.read, daemon=True).start()
    say("up")
    for line in sys.stdin:
        told = json.loads(line)
        do = told.pop("do")
        getattr(end, do)(**told)
        say("done", do=do)


if __name__ == "__main__":
    main()
