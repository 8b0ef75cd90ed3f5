"""CycloneDDS: ``ping_dds.py serve DOMAIN SIZE... | ping DOMAIN SIZE...``; lines of ``roundtrips``, of those sizes.

Its best settings: reliable and keep-last; loopback named as the only interface, no multicast; the largest datagrams
and fragments; a type for each size, as byte arrays of fixed length are the only bytes that its Python does not make
into a list of numbers; a wait set, which was as fast as listeners or faster.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from node import say
from roundtrips import TIMEOUT, measure

os.environ["CYCLONEDDS_URI"] = """
<CycloneDDS><Domain>
  <General>
    <Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
    <AllowMulticast>false</AllowMulticast>
    <MaxMessageSize>65500B</MaxMessageSize>
    <FragmentSize>65000B</FragmentSize>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex>
    <Peers><Peer address="127.0.0.1"/></Peers>
  </Discovery>
  <Internal><SocketReceiveBufferSize min="default" max="4MB"/></Internal>
</Domain></CycloneDDS>
"""  # read when the library makes its first participant

from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import array, uint8
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

if TYPE_CHECKING:
    from collections.abc import Callable

_QOS = Qos(
    Policy.Reliability.Reliable(duration(seconds=TIMEOUT)), Policy.History.KeepLast(10), Policy.Durability.Volatile
)


class Ends:
    """Reader and writer of one size.

    Args:
        participant: Ours.
        size: Bytes.
        heard: The topic that we read.
        said: The one that we write.
    """

    def __init__(self, participant: DomainParticipant, size: int, heard: str, said: str) -> None:
        self.type = make_idl_struct(f"Bytes{size}", f"Bytes{size}", {"data": array[uint8, size]}, bases=())
        final(self.type)
        self.writer = DataWriter(participant, Topic(participant, f"{said}{size}", self.type, qos=_QOS), qos=_QOS)
        self.reader = DataReader(participant, Topic(participant, f"{heard}{size}", self.type, qos=_QOS), qos=_QOS)

    def attach(self, waiting: WaitSet) -> None:
        """Let ``waiting`` end when something came."""
        fresh = ViewState.Any | InstanceState.Alive | SampleState.NotRead
        waiting.attach(ReadCondition(self.reader, fresh))


def serve(domain: int, sizes: list[int]) -> None:
    participant = DomainParticipant(domain)
    waiting = WaitSet(participant)
    ends = [Ends(participant, size, "ping", "pong") for size in sizes]
    for end in ends:
        end.attach(waiting)
    say("up")
    while True:
        waiting.wait(duration(seconds=10))
        for end in ends:
            for message in end.reader.take(10):
                end.writer.write(message)


def ping(domain: int, sizes: list[int]) -> None:
    participant = DomainParticipant(domain)
    ends = {size: Ends(participant, size, "pong", "ping") for size in sizes}
    timeout = duration(seconds=TIMEOUT)

    def trips_of(size: int) -> Callable[[], bool]:
        end = ends[size]
        waiting = WaitSet(participant)
        end.attach(waiting)
        message = end.type(data=bytes(size))

        def trip() -> bool:
            end.writer.write(message)
            while waiting.wait(timeout):
                if end.reader.take(10):
                    return True
            return False

        return trip

    for size in sizes:  # each pair finds its other end by itself
        trip = trips_of(size)
        while not trip():
            pass
    measure(trips_of, first=sizes[0])


if __name__ == "__main__":
    role, *numbers = sys.argv[1:]
    domain, *sizes = map(int, numbers)
    (serve if role == "serve" else ping)(domain, sizes)
