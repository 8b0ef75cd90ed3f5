// Send goals of actionlib's TestAction as it is told to (roscpp); lines and events as of action_client.py.
#include <actionlib/TestAction.h>
#include <actionlib/client/simple_action_client.h>

#include <iostream>

#include "payload.hpp"

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "action_client");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(1);
  spinner.start();
  using Client = actionlib::SimpleActionClient<actionlib::TestAction>;
  Client client(node, options.text("action", "/count"), false);
  payload::say("up", "\"node\": \"" + ros::this_node::getName() + "\"");
  auto done = [](const actionlib::SimpleClientGoalState& state, const actionlib::TestResultConstPtr& result) {
    payload::say("done", "\"state\": \"" + state.toString() + "\", \"result\": " +
                             std::to_string(result ? result->result : 0));
  };
  auto feedback = [](const actionlib::TestFeedbackConstPtr& message) {
    payload::say("feedback", "\"value\": " + std::to_string(message->feedback));
  };
  std::thread obey([&] {
    std::string line;
    while (std::getline(std::cin, line)) {
      std::istringstream words(line);
      std::string word;
      double number = 0;
      words >> word >> number;
      if (word == "server") {
        const bool found = client.waitForServer(ros::Duration(number));
        payload::say("server", std::string("\"found\": ") + (found ? "true" : "false"));
      } else if (word == "send") {
        actionlib::TestGoal goal;
        goal.goal = int(number);
        client.sendGoal(goal, done, [] { payload::say("active"); }, feedback);
      } else if (word == "cancel") {
        client.cancelGoal();
      }
    }
  });
  obey.detach();  // a read of standard input would outlast SIGTERM
  ros::waitForShutdown();
  std::_Exit(0);
}
