// Publish as fast as roscpp takes it, or at --rate Hz. Options: --topic --size --queue. Events: up; sent each 0.5 s, with
// the count and nanoseconds of the steady clock.
#include "node.hpp"

int main(int argc, char** argv) {
  node::Options options(argc, argv);
  node::init(argc, argv, options, "flood");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(1);
  spinner.start();
  ros::Publisher publisher =
      node.advertise<std_msgs::UInt8MultiArray>(options.text("topic", "/flood"), uint32_t(options.number("queue", 1000)));
  node::say("up");
  while (ros::ok() && publisher.getNumSubscribers() == 0) std::this_thread::sleep_for(std::chrono::milliseconds(5));
  std_msgs::UInt8MultiArray message;
  message.data.assign(size_t(options.number("size", 64)), 7);
  const double rate = options.number("rate", 0);
  const uint64_t batch = rate > 20000 ? 16 : 1;  // a sleep each is more than such a rate leaves time for
  uint64_t sequence = 0;
  auto start = std::chrono::steady_clock::now();
  auto report = start;
  while (ros::ok()) {
    std::memcpy(message.data.data(), &++sequence, 8);
    publisher.publish(message);
    if (rate > 0 && sequence % batch == 0)
      std::this_thread::sleep_until(start + std::chrono::nanoseconds(int64_t(1e9 / rate * double(sequence))));
    if ((sequence % 64 == 0 || batch == 1) && std::chrono::steady_clock::now() > report) {
      report += std::chrono::milliseconds(500);
      auto now = std::chrono::steady_clock::now().time_since_epoch().count();
      node::say("sent", "\"count\": " + std::to_string(sequence) + ", \"ns\": " + std::to_string(now));
    }
  }
}
