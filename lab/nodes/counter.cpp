// Count what arrives, without looking into it. Events: up; window each 0.5 s: messages and bytes so far, highest
// sequence, nanoseconds of the steady clock.
#include "node.hpp"

int main(int argc, char** argv) {
  node::Options options(argc, argv);
  node::init(argc, argv, options, "sink");
  ros::NodeHandle node;
  uint64_t count = 0, bytes = 0, sequence = 0;
  ros::Subscriber subscriber = node.subscribe<std_msgs::UInt8MultiArray>(
      options.text("topic", "/flood"), uint32_t(options.number("queue", 1000)),
      [&](const std_msgs::UInt8MultiArray::ConstPtr& message) {
        ++count;
        bytes += message->data.size();
        std::memcpy(&sequence, message->data.data(), 8);
      },
      ros::VoidConstPtr(), node::hints(options));
  ros::WallTimer timer = node.createWallTimer(ros::WallDuration(0.5), [&](const ros::WallTimerEvent&) {
    auto now = std::chrono::steady_clock::now().time_since_epoch().count();
    node::say("window", "\"count\": " + std::to_string(count) + ", \"bytes\": " + std::to_string(bytes) +
                               ", \"sequence\": " + std::to_string(sequence) + ", \"ns\": " + std::to_string(now));
  });
  node::say("up");
  ros::spin();
}
