"""A plain program of eclipse-zenoh, without any code of ours: it talks on one key, and then listens on another.

``plain_program.py PORT TALK LISTEN``: it publishes CDR strings without attachment and with a token, and prints what
it hears as hexadecimal lines.
"""

from __future__ import annotations

import json
import sys
import time

import zenoh

HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
QOS = "::,10:,:,:,,"


def main() -> None:
    port, talk, listen = sys.argv[1:4]
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    with zenoh.open(config) as session:
        kind = f"std_msgs::msg::dds_::String_/{HASH}"
        session.declare_subscriber(
            f"0/{listen}/{kind}", lambda sample: print(bytes(sample.payload).hex(), flush=True)
        )
        head = f"@ros2_lv/0/{session.zid()}/0"
        token = session.liveliness().declare_token(f"{head}/1/MP/%/%/plain/%{talk}/{kind}/{QOS}")
        publisher = session.declare_publisher(f"0/{talk}/{kind}")
        print("ready", flush=True)
        number = 0
        while not sys.stdin.closed and number < 10_000:
            if publisher.matching_status.matching:
                text = str(number).encode() + b"\0"
                publisher.put(b"\0\1\0\0" + len(text).to_bytes(4, "little") + text)
                number += 1
            time.sleep(0.01)
        token.undeclare()


if __name__ == "__main__":
    main()
