// A client of a Smart Resource by rmpa_ros: options and events as of resource_client.py; asks --rate at its start.
#include <rmpa_ros/rmpa_ros.h>

#include "payload.hpp"

#include <std_msgs/String.h>

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "client");
  ros::NodeHandle node;
  rmpa_ros::Resource camera(options.text("resource", "camera"));
  const auto tell = [](const char* kind, const rmpa_ros::Status& status) {
    std::string values;
    for (const auto& pair : status.values)
      values += (values.empty() ? "\"" : ", \"") + pair.first + "\": \"" + pair.second + "\"";
    payload::say(kind, "\"level\": " + std::to_string(status.level) + ", \"message\": \"" + status.message +
                           "\", \"values\": {" + values + "}");
  };
  camera.onResponse([&](const rmpa_ros::Status& answer) { tell("response", answer); });
  camera.onAlarm([&](const rmpa_ros::Status& alarm) { tell("alarm", alarm); });
  camera.onProfile([](const std::string& name) { payload::say("profile", "\"name\": \"" + name + "\""); });
  camera.ask({{"rate", options.text("rate", ">= 10 Hz hard")}});
  const ros::Subscriber frames = node.subscribe<std_msgs::String>(
      options.text("frames", "/camera/frames"), 100, [&](const std_msgs::String::ConstPtr&) { camera.arrived(); });
  ros::Timer saying;
  const std::string said = options.text("say", "");
  if (!said.empty()) {
    saying = node.createTimer(ros::Duration(0.5), [&, said](const ros::TimerEvent&) { camera.say(said, 54.5); });
  }
  payload::say("up", "\"node\": \"" + ros::this_node::getName() + "\"");
  ros::spin();
}
