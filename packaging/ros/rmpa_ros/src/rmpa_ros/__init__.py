"""Smart Resources from a rospy node: ask for a quality, hear what comes of it, say an attribute. Needs rospy alone.

::

    import rospy, rmpa_ros

    rospy.init_node("viewer")
    camera = rmpa_ros.Resource("camera")
    camera.on_response(lambda answer: rospy.loginfo("%s", answer))
    camera.on_alarm(lambda alarm: rospy.logwarn("%s", alarm.message))
    camera.on_profile(lambda name: rospy.loginfo("the camera runs %s", name))
    camera.ask(rate=">= 20 Hz hard", latency="<= 50 ms")
    rospy.Subscriber("/usb_cam/image_raw", Image, lambda image: camera.arrived(image.header))
    rospy.spin()

Requests, responses and alarms are topics below the resource's node (docs/guides/smart-resources.md of RMPA), which
cross the mesh like any other: the resource may be in any module. One file for Python 3.6 to 3.13.
"""

import math
import threading
import uuid
from collections import OrderedDict
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Union

import rospy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import String

__all__ = ["ERROR", "OK", "STALE", "WARN", "Resource", "Status"]
OK, WARN, ERROR, STALE = range(4)
# Seconds between two reports of what has arrived; a report counts for three windows of the resource.
REPORT_PERIOD = 1.0
# Qualities that ``arrived`` measures.
MEASURED = ("rate", "period_sd", "latency", "loss")
_LEVELS = ("OK", "WARN", "ERROR", "STALE")


class Status(NamedTuple):
    """A response or an alarm.

    ``level``: OK, WARN, ERROR or STALE; ``message``: a text; ``values``: by attribute what was wanted and given.
    """

    level: int
    message: str
    values: Dict[str, str]

    def __str__(self) -> str:
        """``OK: profile full; rate: wanted at least 20 Hz, given 30 Hz``."""
        pairs = "".join(f"; {key}: {text}" for key, text in self.values.items())
        return f"{_LEVELS[self.level]}: {self.message}{pairs}"


class Resource:
    """A Smart Resource in this module's graph, as its clients and the nodes that it is made of see it.

    ``name``: of the resource's node: ``camera``, ``/robot1/camera``. Call ``rospy.init_node`` before. Callbacks are
    called in rospy's threads.
    """

    def __init__(self, name: str) -> None:
        self.name = name if name.startswith("/") else "/" + name
        # The last response to this node's request, the last profile and the standing requests; ``None``: none yet.
        self.answer: Optional[Status] = None
        self.profile: Optional[str] = None
        self.requests: Dict[str, str] = OrderedDict()
        self._mark = ""
        self._lock = threading.Lock()
        self._arrivals = _Arrivals()
        self._callbacks: Dict[str, List[Callable[[Any], None]]] = {"response": [], "alarm": [], "profile": []}
        self._publishers: Dict[str, rospy.Publisher] = {}
        self._subscribers: Dict[str, rospy.Subscriber] = {}
        self._timer: Optional[rospy.Timer] = None

    def ask(self, priority: int = 0, expires: str = "", **requests: str) -> None:
        """Ask for a quality: ``ask(rate=">= 20 Hz hard", image__latency="<= 50 ms weight=2")``.

        A request replaces the last one; without attributes it releases it. The resource drops it when this node ends.
        ``priority``: the higher one wins where clients contradict each other; ``expires``: dropped after ``30 s``.
        ``image__rate`` is the attribute ``image.rate``.
        """
        values = OrderedDict((key.replace("__", "."), str(text)) for key, text in requests.items())
        self.requests = OrderedDict(values)
        if priority:
            values["priority"] = str(priority)
        if expires:
            values["expires"] = expires
        with self._lock:
            self._mark, self.answer = uuid.uuid4().hex, None
        self._listen("responses", DiagnosticArray, self._responded)
        self._publish("requirements", values, self._mark, latch=True)

    def release(self) -> None:
        """Ask for nothing any more."""
        self.ask()

    def on_response(self, callback: Callable[[Status], None]) -> None:
        """Call with each response to this node's request that differs from the one before."""
        self._callbacks["response"].append(callback)
        self._listen("responses", DiagnosticArray, self._responded)

    def on_alarm(self, callback: Callable[[Status], None]) -> None:
        """Call with each alarm, and with level OK when one is over."""
        self._callbacks["alarm"].append(callback)
        self._listen("alarms", DiagnosticArray, self._alarmed)

    def on_profile(self, callback: Callable[[str], None]) -> None:
        """Call with the name of the profile that runs, now and after each change; empty: none runs."""
        self._callbacks["profile"].append(callback)
        self._listen("profile", String, self._profiled)

    def arrived(self, header: Any = None) -> None:
        """Count a message of the resource that has arrived here; call it in the callback of your subscriber.

        ``header``: its ``std_msgs/Header``, without which there is no latency and no loss. Once a second the resource
        is told ``rate``, ``period_sd``, ``latency`` and ``loss`` as they are here, those that this node asks for.
        """
        now = rospy.get_time()
        with self._lock:
            self._arrivals.add(now, header)
            if self._timer is None:
                self._timer = rospy.Timer(rospy.Duration(REPORT_PERIOD), self._report)

    def observe(self, **values: Union[float, str]) -> None:
        """Tell the resource a quality as this client sees it: ``observe(rate="12 Hz")``; repeat it each second."""
        self._publish("observed", OrderedDict((k.replace("__", "."), _text(v)) for k, v in values.items()))

    def say(self, **values: Union[float, str]) -> None:
        """Say attributes of the resource that this node is a part of: ``say(temperature=54.2)``, in their units.

        The node is one of the resource's file, ``[node.NAME]``, and the attribute one of ``[attribute.NAME]`` without
        ``value``. Others are refused, and the resource's log says so.
        """
        self._publish("attributes", OrderedDict((k, _text(v)) for k, v in values.items()))

    def close(self) -> None:
        """End all connections to the resource, with what was asked."""
        if self._timer is not None:
            self._timer.shutdown()
        for end in list(self._subscribers.values()) + list(self._publishers.values()):
            end.unregister()

    def _listen(self, topic: str, kind: Any, callback: Callable[[Any], None]) -> None:
        if topic not in self._subscribers:
            self._subscribers[topic] = rospy.Subscriber(f"{self.name}/{topic}", kind, callback)

    def _publish(self, topic: str, values: Dict[str, str], mark: str = "", latch: bool = False) -> None:
        if topic not in self._publishers:
            # A queue of its own: publishing never waits for a connection.
            name = f"{self.name}/{topic}"
            self._publishers[topic] = rospy.Publisher(name, DiagnosticArray, queue_size=10, latch=latch)
        message = DiagnosticArray()
        message.header.stamp = rospy.Time.now()
        pairs = [KeyValue(key, text) for key, text in values.items()]
        message.status = [DiagnosticStatus(name=rospy.get_name(), hardware_id=mark, values=pairs)]
        self._publishers[topic].publish(message)

    def _responded(self, message: DiagnosticArray) -> None:
        for status in message.status:
            # In the resource's graph this node may have its proxy's name, so the unique mark identifies it.
            if status.hardware_id == self._mark and self._mark:
                answer = _status(status)
                with self._lock:
                    changed, self.answer = answer != self.answer, answer
                self._call("response", answer, changed)

    def _alarmed(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._call("alarm", _status(status))

    def _profiled(self, message: String) -> None:
        changed, self.profile = message.data != self.profile, message.data
        self._call("profile", message.data, changed)

    def _call(self, kind: str, value: Any, changed: bool = True) -> None:
        for callback in list(self._callbacks[kind]) if changed else ():
            callback(value)

    def _report(self, _event: Any) -> None:
        with self._lock:
            measured = self._arrivals.window(rospy.get_time())
        found = {name: measured.get(name.rpartition(".")[2]) for name in self.requests}
        known = OrderedDict((name, _text(value)) for name, value in found.items() if value is not None)
        if known:
            self._publish("observed", known)


class _Arrivals:
    """Measures the messages of one topic by windows."""

    def __init__(self) -> None:
        self._last: Optional[float] = None
        self._sequence: Optional[int] = None
        self._clear()

    def _clear(self) -> None:
        self._periods: List[float] = []
        self._ages: List[float] = []
        self._count = self._lost = 0

    def add(self, now: float, header: Any) -> None:
        if self._last is not None:
            self._periods.append(now - self._last)
        self._last, self._count = now, self._count + 1
        if header is None:
            return
        if not header.stamp.is_zero():
            self._ages.append(now - header.stamp.to_sec())
        if self._sequence is not None and self._sequence < header.seq < self._sequence + 2**31:
            self._lost += header.seq - self._sequence - 1
        self._sequence = header.seq

    def window(self, now: float) -> Dict[str, float]:
        found: Dict[str, float] = {}
        if self._last is None:
            return found
        mean = sum(self._periods) / len(self._periods) if self._periods else 0.0
        # The present period is at least as long as the silence, so the rate falls as soon as the source stops.
        longest = max(mean, now - self._last)
        if longest > 0:
            found["rate"] = 1 / longest
        if len(self._periods) > 1:
            found["period_sd"] = math.sqrt(sum((one - mean) ** 2 for one in self._periods) / len(self._periods))
        if self._ages:
            found["latency"] = max(0.0, sum(self._ages) / len(self._ages))
        if self._count and self._sequence is not None:
            found["loss"] = float(self._lost) / (self._lost + self._count)
        self._clear()
        return found


def _status(status: DiagnosticStatus) -> Status:
    level = status.level if isinstance(status.level, int) else ord(status.level)  # genpy gives a byte as bytes
    return Status(level, status.message, OrderedDict((pair.key, pair.value) for pair in status.values))


def _text(value: Union[float, str]) -> str:
    return value if isinstance(value, str) else repr(float(value))
