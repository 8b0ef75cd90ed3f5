// The velocity node of the paper's robot (roscpp): each command that comes in leaves as a velocity, its head kept.
// Options: --cmd --vel --nodelay --queue; --mode event: at once; --mode polled: at --rate Hz, the newest command if there
// is a new one, at whole multiples of its period on CLOCK_MONOTONIC, so that a source can be given a phase to it.
// Events: up; connected with the number of subscribers of the velocity.
#include <mutex>
#include <thread>

#include "node.hpp"

int main(int argc, char** argv) {
  node::Options options(argc, argv);
  node::init(argc, argv, options, "velocity");
  ros::NodeHandle handle;
  const bool polled = options.text("mode", "event") == "polled";
  const uint32_t queue = uint32_t(options.number("queue", 100));
  std::mutex mutex;
  std_msgs::UInt8MultiArray::ConstPtr newest;
  ros::Publisher publisher = node::advertise(handle, options.text("vel", "/vel"), queue);
  ros::Subscriber subscriber = handle.subscribe<std_msgs::UInt8MultiArray>(
      options.text("cmd", "/cmd"), queue,
      [&](const std_msgs::UInt8MultiArray::ConstPtr& message) {
        if (!polled) {
          publisher.publish(*message);
          return;
        }
        std::lock_guard<std::mutex> lock(mutex);
        newest = message;
      },
      ros::VoidConstPtr(), node::hints(options));
  std::thread loop;
  if (polled) {
    loop = std::thread([&] {
      node::sleep_sharply();
      const double period = 1e9 / options.number("rate", 10.0);
      for (uint64_t turn = uint64_t(double(node::now_ns()) / period) + 1; ros::ok(); ++turn) {
        node::sleep_until(uint64_t(period * double(turn)));
        std_msgs::UInt8MultiArray::ConstPtr message;
        {
          std::lock_guard<std::mutex> lock(mutex);
          message.swap(newest);
        }
        if (message) publisher.publish(*message);
      }
    });
  }
  node::say("up");
  ros::spin();
  if (loop.joinable()) loop.join();
}
