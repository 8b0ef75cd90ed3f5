// A loop of ros::Rate (roscpp) that publishes a message each time. Options: --topic --rate.
// Reads "COUNT FILE" lines; FILE gets for each of COUNT times when it was due and when it began, ns of ROS's clock, which
// is the wall's (8 bytes each, native order). Events: up; connected; done.
#include <iostream>

#include "node.hpp"

int main(int argc, char** argv) {
  node::Options options(argc, argv);
  node::init(argc, argv, options, "timed_loop");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(1);
  spinner.start();
  ros::Publisher publisher =
      node.advertise<std_msgs::UInt8MultiArray>(options.text("topic", "/rated"), uint32_t(options.number("queue", 100)));
  node::say("up");
  while (ros::ok() && publisher.getNumSubscribers() == 0) std::this_thread::sleep_for(std::chrono::milliseconds(5));
  node::say("connected");
  const double hertz = options.number("rate", 100);
  const uint64_t period = uint64_t(1e9 / hertz);
  std_msgs::UInt8MultiArray message;
  message.data.assign(64, 7);
  size_t count;
  std::string path;
  while (ros::ok() && std::cin >> count >> path) {
    std::vector<uint64_t> noted;
    noted.reserve(2 * count);
    ros::Rate rate(hertz);
    uint64_t due = node::wall_ns();
    for (size_t i = 0; i < count && ros::ok(); ++i) {
      rate.sleep();
      const uint64_t began = node::wall_ns();
      due += period;
      if (began > due + 2 * period) due = began;  // as ros::Rate begins anew
      noted.push_back(due);
      noted.push_back(began);
      publisher.publish(message);
    }
    FILE* out = std::fopen(path.c_str(), "wb");
    std::fwrite(noted.data(), 8, noted.size(), out);
    std::fclose(out);
    node::say("done");
  }
}
