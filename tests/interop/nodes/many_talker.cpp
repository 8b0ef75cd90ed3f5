// Publish numbered, checksummed payloads on many topics of one node (roscpp).
//
// Options: --topics A,B,...; --rate of each; --size; --source; --latch: one message each, latched. Events: up; done.
#include "payload.hpp"

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "many_talker");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(1);
  spinner.start();
  const bool latch = options.flag("latch");
  std::vector<ros::Publisher> publishers;
  std::stringstream topics(options.text("topics", "/chatter"));
  for (std::string topic; std::getline(topics, topic, ',');)
    publishers.push_back(node.advertise<std_msgs::UInt8MultiArray>(topic, 10000, latch));
  payload::say("up", "\"node\": \"" + ros::this_node::getName() + "\"");
  payload::Pattern pattern(size_t(options.number("size", 64)));
  const double rate = options.number("rate", 10);
  const uint32_t source = uint32_t(options.number("source", 1));
  std_msgs::UInt8MultiArray message;
  uint32_t sequence = 0;
  auto due = std::chrono::steady_clock::now();
  do {
    pattern.fill(message.data, source, ++sequence);
    for (ros::Publisher& publisher : publishers) publisher.publish(message);
    due += std::chrono::nanoseconds(int64_t(1e9 / rate));
    std::this_thread::sleep_until(due);
  } while (ros::ok() && !latch);
  payload::say("done", "\"sent\": " + std::to_string(sequence));
  ros::waitForShutdown();
}
