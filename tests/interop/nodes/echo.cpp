// Send back, on --reply, whatever comes on --topic (roscpp). Event: up.
#include "payload.hpp"

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "echo");
  ros::NodeHandle node;
  ros::Publisher publisher = node.advertise<std_msgs::UInt8MultiArray>(options.text("reply", "/reply"), 100);
  ros::Subscriber subscriber = node.subscribe<std_msgs::UInt8MultiArray>(
      options.text("topic", "/chatter"), 100,
      [&](const std_msgs::UInt8MultiArray::ConstPtr& message) { publisher.publish(message); }, ros::VoidConstPtr(),
      payload::hints(options));
  payload::say("up", "\"node\": \"" + ros::this_node::getName() + "\"");
  ros::spin();
}
