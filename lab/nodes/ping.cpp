// Round trips from --topic to --reply (roscpp); the other end is the echo node of the tests.
// Reads "SIZE COUNT FILE" lines and writes each round trip's nanoseconds (8 bytes, native) to FILE.
// Events: up; ready with the first round trip; round with the number lost (not back within a second).
#include <ros/callback_queue.h>

#include <iostream>

#include "node.hpp"

int main(int argc, char** argv) {
  node::Options options(argc, argv);
  node::init(argc, argv, options, "ping");
  ros::NodeHandle node;
  ros::CallbackQueue* queue = ros::getGlobalCallbackQueue();
  uint64_t returned = 0;
  ros::Publisher publisher = node.advertise<std_msgs::UInt8MultiArray>(options.text("topic", "/ping"), 10);
  ros::Subscriber subscriber = node.subscribe<std_msgs::UInt8MultiArray>(
      options.text("reply", "/pong"), 10,
      [&](const std_msgs::UInt8MultiArray::ConstPtr& message) {
        if (message->data.size() >= 8) std::memcpy(&returned, message->data.data(), 8);
      },
      ros::VoidConstPtr(), node::hints(options));
  node::say("up");

  uint64_t sequence = 0;
  std_msgs::UInt8MultiArray message;
  auto trip = [&](double timeout) {
    std::memcpy(message.data.data(), &++sequence, 8);
    publisher.publish(message);
    auto deadline = std::chrono::steady_clock::now() + std::chrono::duration<double>(timeout);
    while (returned != sequence && ros::ok() && std::chrono::steady_clock::now() < deadline)
      queue->callAvailable(ros::WallDuration(timeout));
    return returned == sequence;
  };
  message.data.resize(64);
  while (ros::ok() && !trip(0.1)) {
  }
  node::say("ready");
  unsigned size, count;
  std::string path;
  while (ros::ok() && std::cin >> size >> count >> path) {
    message.data.assign(size, 7);
    std::vector<uint64_t> samples;
    unsigned lost = 0;
    for (unsigned i = 0; i < count && ros::ok(); ++i) {
      auto start = std::chrono::steady_clock::now();
      if (trip(1.0))
        samples.push_back(uint64_t((std::chrono::steady_clock::now() - start).count()));
      else
        ++lost;
    }
    FILE* out = std::fopen(path.c_str(), "wb");
    std::fwrite(samples.data(), 8, samples.size(), out);
    std::fclose(out);
    node::say("round", "\"lost\": " + std::to_string(lost));
  }
}
