// Publish numbered payloads, and one to each new subscriber alone (roscpp); options and events as of greeter.py.
#include "payload.hpp"

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "greeter");
  ros::NodeHandle node;
  payload::Pattern greeting(options.number("greeting", 1000));
  uint32_t count = 0;
  const auto greet = [&](const ros::SingleSubscriberPublisher& one) {
    std_msgs::UInt8MultiArray message;
    greeting.fill(message.data, 2, ++count);
    one.publish(message);
    payload::say("greeted", "\"count\": " + std::to_string(count));
  };
  ros::Publisher publisher = node.advertise<std_msgs::UInt8MultiArray>(
      options.text("topic", "/chatter"), 1000, greet, ros::SubscriberStatusCallback(), ros::VoidConstPtr(),
      options.flag("latch"));
  payload::say("up", "\"node\": \"" + ros::this_node::getName() + "\"");
  payload::Pattern pattern(options.number("size", 64));
  uint32_t sequence = 0;
  ros::WallRate rate(double(options.number("rate", 20)));
  while (ros::ok()) {
    std_msgs::UInt8MultiArray message;
    pattern.fill(message.data, 1, ++sequence);
    publisher.publish(message);
    ros::spinOnce();
    rate.sleep();
  }
}
