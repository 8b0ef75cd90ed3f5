// Serve actionlib's TestAction (roscpp); options and events as of action_server.py.
#include <actionlib/TestAction.h>
#include <actionlib/server/simple_action_server.h>

#include "payload.hpp"

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "action_server");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(2);
  spinner.start();
  using Server = actionlib::SimpleActionServer<actionlib::TestAction>;
  const double period = options.number("period", 0.05);
  Server* self = nullptr;
  auto ended = [](int last, const char* how) {
    payload::say("ended", "\"last\": " + std::to_string(last) + ", \"how\": \"" + how + "\"");
  };
  auto execute = [&](const actionlib::TestGoalConstPtr& goal) {
    payload::say("goal", "\"goal\": " + std::to_string(goal->goal));
    actionlib::TestResult result;
    if (goal->goal < 0) {
      result.result = -1;
      self->setAborted(result, "it is below 0");
      return ended(-1, "aborted");
    }
    actionlib::TestFeedback feedback;
    for (int step = 1; step <= goal->goal; ++step) {
      if (self->isPreemptRequested() || !ros::ok()) {
        result.result = step - 1;
        self->setPreempted(result);
        return ended(step - 1, "preempted");
      }
      feedback.feedback = step;
      self->publishFeedback(feedback);
      std::this_thread::sleep_for(std::chrono::duration<double>(period));
    }
    result.result = goal->goal;
    self->setSucceeded(result);
    ended(goal->goal, "succeeded");
  };
  Server server(node, options.text("action", "/count"), execute, false);
  self = &server;
  server.start();
  payload::say("up", "\"node\": \"" + ros::this_node::getName() + "\"");
  ros::waitForShutdown();
}
