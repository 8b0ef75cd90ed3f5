"""Send goals of actionlib's TestAction as it is told to (rospy).

Reads lines: ``server SECONDS`` waits so long for a server; ``send NUMBER``; ``cancel``. Events: ``up``; ``server``
with whether one was found; ``active``; ``feedback`` with each number; ``done`` with the state and the result.
"""

import sys
import threading

import actionlib
import rospy
from actionlib.msg import TestAction, TestGoal, TestResult
from actionlib_msgs.msg import GoalStatus
from payload import parser, say


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--action", default="/count")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "action_client", anonymous=not args.name)
    client = actionlib.SimpleActionClient(args.action, TestAction)
    say("up", node=rospy.get_name())

    def done(state: int, result: TestResult) -> None:
        say("done", state=GoalStatus.to_string(state), result=result.result if result else 0)

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
                    TestGoal(int(rest[0])),
                    done_cb=done,
                    active_cb=lambda: say("active"),
                    feedback_cb=lambda feedback: say("feedback", value=feedback.feedback),
                )
            elif word == "cancel":
                client.cancel_goal()

    threading.Thread(target=obey, daemon=True).start()  # a read of standard input would outlast SIGTERM
    rospy.spin()


if __name__ == "__main__":
    main()
