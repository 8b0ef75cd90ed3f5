// Publish numbered, checksummed payloads at a steady rate (roscpp); options and events as of talker.py.
#include "payload.hpp"

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "talker");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(1);
  spinner.start();
  ros::Publisher publisher = node.advertise<std_msgs::UInt8MultiArray>(
      options.text("topic", "/chatter"), int(options.number("queue", 10000)), options.flag("latch"));
  payload::say("up", "\"node\": \"" + ros::this_node::getName() + "\"");
  while (ros::ok() && publisher.getNumSubscribers() < options.number("wait", 0))
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  payload::say("connected", "\"subscribers\": " + std::to_string(publisher.getNumSubscribers()));
  payload::Pattern pattern(size_t(options.number("size", 64)), options.flag("noise"));
  const double rate = options.number("rate", 10);
  const uint64_t count = uint64_t(options.number("count", 0));
  const uint32_t source = uint32_t(options.number("source", 1));
  std_msgs::UInt8MultiArray message;
  uint32_t sequence = 0;
  auto due = std::chrono::steady_clock::now();
  while (ros::ok() && (!count || sequence < count)) {
    pattern.fill(message.data, source, ++sequence);
    publisher.publish(message);
    if (rate > 0) {
      due += std::chrono::nanoseconds(int64_t(1e9 / rate));
      std::this_thread::sleep_until(due);
    }
  }
  payload::say("done", "\"sent\": " + std::to_string(sequence));
  ros::waitForShutdown();
}
