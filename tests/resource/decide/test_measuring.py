from __future__ import annotations

import struct

from rmpa.resource.decide.quality import QualityMeasurement
from rmpa.resource.declare.resource import Resource


def sonar() -> Resource:
    one = Resource("sonar", role="sensing")
    one.output("ranges", "std_msgs/Header")
    one.output("words", "std_msgs/String")
    one.input("/robot/scan", "std_msgs/String")
    one.attribute("noise", better="min", unit="m")
    return one


def test_each_topic_is_measured_the_first_output_twice() -> None:
    one = QualityMeasurement(sonar(), 0.0)
    raw = struct.pack("<IIII", 1, 0, 0, 0)
    for number in range(1, 11):
        one.message("ranges", raw, number / 10, 0)
        one.message("/robot/scan", b"\0\0\0\0", number / 10, 0, "/laser")
    one.observe("noise", 0.02)
    one.observe("smell", 1.0)  # nobody declared it
    one.message("other", raw, 0.5, 0)
    found = one.window(1.0)
    assert found["rate"] == found["ranges.rate"] == 10.0
    assert found["scan.rate"] == 10.0
    assert found["words.rate"] == 0.0
    assert found["noise"] == 0.02
    shown = one.format(found)
    assert (shown["rate"], shown["scan.rate"], shown["noise"]) == ("10 Hz", "10 Hz", "0.02 m")
    assert not any(name.startswith("ranges.") for name in shown)


def test_another_profile_begins_another_window() -> None:
    one = QualityMeasurement(sonar(), 0.0)
    for number in range(1, 6):
        one.message("words", b"\0\0\0\0", number / 10, 0)
    one.observe("noise", 0.5)
    one.restart(0.5)
    assert "noise" not in one.window(1.5)


def test_a_resource_without_outputs_is_measured_by_its_inputs() -> None:
    ear = Resource("ear", role="controlling")
    ear.input("/scan", "std_msgs/String")
    one = QualityMeasurement(ear, 0.0)
    for number in range(1, 11):
        one.message("/scan", b"\0\0\0\0", number / 10, 0)
    found = one.window(1.0)
    assert "rate" not in found
    assert one.format(found)["scan.rate"] == "10 Hz"
