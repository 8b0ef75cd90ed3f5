// Receive what a talker sends, check it and count it (roscpp); options and events as of listener.py.
#include "payload.hpp"

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "listener");
  ros::NodeHandle node;
  payload::Tally tally;
  const uint64_t wanted = uint64_t(options.number("count", 0));
  const bool each = options.flag("each");
  auto take = [&](const std_msgs::UInt8MultiArray::ConstPtr& message) {
    tally.take(message->data);
    if (tally.count == 1) payload::say("first", "\"stamp_ns\": " + std::to_string(payload::wall_ns()) + ", " + tally.report());
    if (each) payload::say("report", tally.report());
    if (tally.count == wanted) payload::say("done", tally.report());
  };
  ros::Subscriber subscriber = node.subscribe<std_msgs::UInt8MultiArray>(
      options.text("topic", "/chatter"), uint32_t(options.number("queue", 10000)), take, ros::VoidConstPtr(),
      payload::hints(options));
  uint64_t reported = 0;
  ros::WallTimer timer = node.createWallTimer(ros::WallDuration(0.2), [&](const ros::WallTimerEvent&) {
    if (tally.count != reported) payload::say("report", tally.report());
    reported = tally.count;
  });
  payload::say("up", "\"node\": \"" + ros::this_node::getName() + "\"");
  ros::spin();
}
