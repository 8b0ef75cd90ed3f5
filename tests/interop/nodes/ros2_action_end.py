"""An action server or client of ROS 2 in rmw_zenoh's format, for actions of one int32 in each part. No code of RMPA.

Runs with RMPA's interpreter: ``ros2_action_end.py ENDPOINT ACTION TYPE HASHES``; ``HASHES`` is JSON: the hash of each
of ``SendGoal``, ``GetResult``, ``FeedbackMessage``, ``CancelGoal`` and ``GoalStatusArray``. Reads lines of JSON:

* ``{"do": "serve"}``: a server that counts to the goal, one feedback a step, and rejects goals below 0;
* ``{"do": "client"}``: show a client in ROS 2's graph;
* ``{"do": "send", "goal"}``: then ``accepted`` with ``ok``, ``feedback`` with ``value``, ``ended`` with ``status``
  and ``result``;
* ``{"do": "cancel"}``: the goal that was sent last; then ``cancelling`` with ``code``.

Events beside: ``up``; ``goal`` and ``cancel`` of the server; ``done`` after each line.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import threading
import time
from typing import Any

import zenoh

from node import say

HEAD = b"\x00\x01\x00\x00"
STEP = 0.05


class ActionEnd:
    """Both ends of one action."""

    def __init__(self, endpoint: str, action: str, kind: str, hashes: dict[str, str]) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        self.session = zenoh.open(config)
        package, _, name = kind.partition("/")
        self.types = {
            "send_goal": (f"{package}::action::dds_::{name}_SendGoal_", hashes["SendGoal"]),
            "get_result": (f"{package}::action::dds_::{name}_GetResult_", hashes["GetResult"]),
            "cancel_goal": ("action_msgs::srv::dds_::CancelGoal_", hashes["CancelGoal"]),
            "feedback": (f"{package}::action::dds_::{name}_FeedbackMessage_", hashes["FeedbackMessage"]),
            "status": ("action_msgs::msg::dds_::GoalStatusArray_", hashes["GoalStatusArray"]),
        }
        self.action = action.strip("/")
        self.kept: list[Any] = []
        self.sequence = 0
        self.goal = b""
        self.cancelled: set[bytes] = set()
        self.results: dict[bytes, tuple[int, int]] = {}
        self.changed = threading.Condition()

    def key(self, part: str) -> str:
        kind, type_hash = self.types[part]
        return f"0/{self.action}/_action/{part}/{kind}/{type_hash}"

    def tokens(self, node: str, parts: dict[str, str]) -> None:
        zid = self.session.info.zid()
        lead = f"@ros2_lv/0/{zid}/0"
        self.kept.append(self.session.liveliness().declare_token(f"{lead}/0/NN/%/%/{node}"))
        for number, (part, mark) in enumerate(parts.items(), 1):
            kind, type_hash = self.types[part]
            name = f"%{self.action}/_action/{part}".replace("/", "%")
            token = f"{lead}/{number}/{mark}/%/%/{node}/{name}/{kind}/{type_hash}/::,10:,:,:,,"
            self.kept.append(self.session.liveliness().declare_token(token))

    def attachment(self) -> bytes:
        self.sequence += 1
        return struct.pack("<qqB16s", self.sequence, time.time_ns(), 16, b"g" * 16)

    # --- server ------------------------------------------------------------------------------------------------

    def serve(self) -> None:
        self.tokens("counter2", {"send_goal": "SS", "get_result": "SS", "cancel_goal": "SS", "feedback": "MP"})
        for part, take in (
            ("send_goal", self._take_goal),
            ("get_result", self._take_result),
            ("cancel_goal", self._take_cancel),
        ):
            self.kept.append(self.session.declare_queryable(self.key(part), self._apart(take), complete=True))

    def _apart(self, take: Any) -> Any:
        return lambda query: threading.Thread(target=take, args=(query,), daemon=True).start()

    def _reply(self, query: zenoh.Query, payload: bytes) -> None:
        query.reply(query.key_expr, payload, attachment=query.attachment)
        query.drop()

    def _take_goal(self, query: zenoh.Query) -> None:
        raw = query.payload.to_bytes()
        uuid, number = raw[4:20], struct.unpack_from("<i", raw, 20)[0]
        say("goal", goal=number)
        self._reply(query, HEAD + struct.pack("<?3xii", number >= 0, 0, 0))
        if number >= 0:
            threading.Thread(target=self._count, args=(uuid, number), daemon=True).start()

    def _count(self, uuid: bytes, number: int) -> None:
        step = 0
        while step < number and uuid not in self.cancelled:
            step += 1
            feedback = HEAD + uuid + struct.pack("<i", step)
            self.session.put(self.key("feedback"), feedback, attachment=self.attachment())
            time.sleep(STEP)
        with self.changed:
            self.results[uuid] = (5 if uuid in self.cancelled else 4, step)
            self.changed.notify_all()

    def _take_result(self, query: zenoh.Query) -> None:
        uuid = query.payload.to_bytes()[4:20]
        with self.changed:
            self.changed.wait_for(lambda: uuid in self.results, 60)
            status, result = self.results.get(uuid, (0, 0))
        self._reply(query, HEAD + struct.pack("<b3xi", status, result))

    def _take_cancel(self, query: zenoh.Query) -> None:
        info = query.payload.to_bytes()[4:28]
        say("cancel")
        self.cancelled.add(info[:16])
        self._reply(query, HEAD + struct.pack("<b3xI", 0, 1) + info)

    # --- client ------------------------------------------------------------------------------------------------

    def client(self) -> None:
        self.tokens("client2", {"send_goal": "SC", "get_result": "SC", "cancel_goal": "SC", "feedback": "MS"})
        self.kept.append(self.session.declare_subscriber(self.key("feedback"), self._feedback))

    def _feedback(self, sample: zenoh.Sample) -> None:
        raw = sample.payload.to_bytes()
        if raw[4:20] == self.goal:
            say("feedback", value=struct.unpack_from("<i", raw, 20)[0])

    def _call(self, part: str, payload: bytes) -> bytes:
        asked = self.attachment()
        for reply in self.session.get(
            self.key(part), payload=payload, attachment=asked, timeout=30, target=zenoh.QueryTarget.ALL_COMPLETE
        ):
            if reply.ok is None:
                say("error", text=reply.err.payload.to_string())
            elif reply.ok.attachment.to_bytes()[:8] == asked[:8]:
                return bytes(reply.ok.payload.to_bytes())
        return b""

    def send(self, goal: int) -> None:
        self.goal = os.urandom(16)
        raw = self._call("send_goal", HEAD + self.goal + struct.pack("<i", goal))
        say("accepted", ok=bool(raw) and bool(raw[4]))
        threading.Thread(target=self._wait, args=(self.goal,), daemon=True).start()

    def _wait(self, goal: bytes) -> None:
        raw = self._call("get_result", HEAD + goal)
        status, result = struct.unpack_from("<b3xi", raw, 4) if raw else (-1, 0)
        say("ended", status=status, result=result)

    def cancel(self) -> None:
        raw = self._call("cancel_goal", HEAD + self.goal + bytes(8))
        say("cancelling", code=raw[4] if raw else -1)


def main() -> None:
    endpoint, action, kind, hashes = sys.argv[1:5]
    end = ActionEnd(endpoint, action, kind, json.loads(hashes))
    say("up")
    for line in sys.stdin:
        told = json.loads(line)
        if told["do"] == "serve":
            end.serve()
        elif told["do"] == "client":
            end.client()
        elif told["do"] == "send":
            end.send(told["goal"])
        elif told["do"] == "cancel":
            end.cancel()
        say("done", do=told["do"])
    end.session.close()


if __name__ == "__main__":
    main()
