// Receive what talkers send on many topics, check and count it for each topic (roscpp).
//
// Options: --topics A,B,... Events: up; report five times a second, with {topic: report} of those that were heard.
#include <map>

#include "payload.hpp"

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "many_listener");
  ros::NodeHandle node;
  std::map<std::string, payload::Tally> tallies;
  std::vector<ros::Subscriber> subscribers;
  std::stringstream topics(options.text("topics", "/chatter"));
  for (std::string topic; std::getline(topics, topic, ',');) {
    payload::Tally& tally = tallies[topic];
    subscribers.push_back(node.subscribe<std_msgs::UInt8MultiArray>(
        topic, 10000,
        [&tally](const std_msgs::UInt8MultiArray::ConstPtr& message) { tally.take(message->data); },
        ros::VoidConstPtr(), payload::hints(options)));
  }
  ros::WallTimer timer = node.createWallTimer(ros::WallDuration(0.2), [&](const ros::WallTimerEvent&) {
    std::string rows;
    for (const auto& [topic, tally] : tallies)
      if (tally.count) rows += (rows.empty() ? "" : ", ") + ("\"" + topic + "\": {" + tally.report() + "}");
    payload::say("report", "\"topics\": {" + rows + "}");
  });
  payload::say("up", "\"node\": \"" + ros::this_node::getName() + "\"");
  ros::spin();
}
