"""A server or client of actionlib for ROS 2's action Fibonacci (rospy), of the package beside: no message is built.

``fibonacci_end.py server|client --action NAME``. The server counts to the order, one feedback a step, and aborts
below 0. The client reads lines: ``server SECONDS``; ``send ORDER``; ``cancel``. Events: ``up``; of the server
``goal``; of the client ``server``, ``feedback`` with each length, ``done`` with the state and the result's length.
"""

import sys
import threading
from pathlib import Path
from typing import Any

import actionlib
import rospy
from actionlib_msgs.msg import GoalID, GoalStatus
from genpy.dynamic import generate_dynamic
from payload import parser, say
from std_msgs.msg import Header

PACKAGE = Path(__file__).parents[1] / "packages" / "test_msgs" / "msg"


def classes() -> dict[str, Any]:
    """The message classes of the action, by name."""
    parts = [f"MSG: test_msgs/{file.stem}\n{file.read_text()}" for file in sorted(PACKAGE.glob("Fibonacci*.msg"))]
    known = [f"MSG: {kind._type}\n{kind._full_text.split('=' * 80)[0]}" for kind in (Header, GoalID, GoalStatus)]
    text = f"\n{'=' * 80}\n".join([(PACKAGE / "FibonacciAction.msg").read_text(), *parts, *known])
    return {
        name.partition("/")[2]: kind for name, kind in generate_dynamic("test_msgs/FibonacciAction", text).items()
    }


def serve(name: str, made: dict[str, Any]) -> None:
    def execute(goal: Any) -> None:
        say("goal", goal=goal.order)
        if goal.order < 0:
            server.set_aborted(made["FibonacciResult"]([]))
            return
        sequence: list[int] = []
        while len(sequence) < goal.order:
            if server.is_preempt_requested() or rospy.is_shutdown():
                server.set_preempted(made["FibonacciResult"](sequence))
                return
            sequence.append(len(sequence))
            server.publish_feedback(made["FibonacciFeedback"](sequence))
            rospy.rostime.wallsleep(0.05)
        server.set_succeeded(made["FibonacciResult"](sequence))

    server = actionlib.SimpleActionServer(name, made["FibonacciAction"], execute_cb=execute, auto_start=False)
    server.start()


def ask(name: str, made: dict[str, Any]) -> None:
    client = actionlib.SimpleActionClient(name, made["FibonacciAction"])

    def obey() -> None:
        sent = False
        for line in sys.stdin:
            word, *rest = line.split()
            if word == "server":
                say("server", found=client.wait_for_server(rospy.Duration(float(rest[0]))))
            elif word == "send":
                if sent:
                    client.wait_for_result()  # it says "done" before it knows that it is
                sent = True
                client.send_goal(
                    made["FibonacciGoal"](int(rest[0])),
                    done_cb=lambda state, result: say(
                        "done", state=GoalStatus.to_string(state), result=len(result.sequence) if result else 0
                    ),
                    feedback_cb=lambda feedback: say("feedback", value=len(feedback.sequence)),
                )
            elif word == "cancel":
                client.cancel_goal()

    threading.Thread(target=obey, daemon=True).start()  # a read of standard input would outlast SIGTERM


def main() -> None:
    options = parser(__doc__)
    options.add_argument("role", choices=("server", "client"))
    options.add_argument("--action", default="/count")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or f"fibonacci_{args.role}", anonymous=not args.name)
    (serve if args.role == "server" else ask)(args.action, classes())
    say("up", node=rospy.get_name())
    rospy.spin()


if __name__ == "__main__":
    main()
