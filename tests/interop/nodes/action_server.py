"""Serve actionlib's TestAction (rospy): count to the goal, one feedback a step; below 0: abort.

The result is the last number; it is preempted between two steps. Events: ``up``; ``goal`` with each that is begun;
``ended`` with its last number and how.
"""

import sys

import actionlib
import rospy
from actionlib.msg import TestAction, TestFeedback, TestGoal, TestResult
from payload import parser, say


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--action", default="/count")
    options.add_argument("--period", type=float, default=0.05, help="seconds from one step to the next")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "action_server", anonymous=not args.name)

    def execute(goal: TestGoal) -> None:
        say("goal", goal=goal.goal)
        if goal.goal < 0:
            server.set_aborted(TestResult(-1), "it is below 0")
            say("ended", last=-1, how="aborted")
            return
        for step in range(1, goal.goal + 1):
            if server.is_preempt_requested() or rospy.is_shutdown():
                server.set_preempted(TestResult(step - 1))
                say("ended", last=step - 1, how="preempted")
                return
            server.publish_feedback(TestFeedback(step))
            rospy.rostime.wallsleep(args.period)
        server.set_succeeded(TestResult(goal.goal))
        say("ended", last=goal.goal, how="succeeded")

    server = actionlib.SimpleActionServer(args.action, TestAction, execute_cb=execute, auto_start=False)
    server.start()
    say("up", node=rospy.get_name())
    rospy.spin()


if __name__ == "__main__":
    main()
