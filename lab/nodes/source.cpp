// Publish on an absolute schedule (roscpp): a message that leaves late does not move those behind it.
// Options: --topic --queue; --phase: ms from a whole multiple of the period on CLOCK_MONOTONIC to each moment at which
// a message is due (default: wherever that falls).
// Reads "ROUND SIZE RATE COUNT FILE" lines: COUNT messages of SIZE bytes (16 at the least) at RATE Hz; each begins with
// the round (4 bytes), its sequence from 0 (4) and the ns at which it was due (8).
// FILE gets for each message how many ns after that it was given to roscpp (8 bytes).
// Events: up; connected with the number of subscribers; sent with the round, the count and when the first was due.
#include <cmath>
#include <iostream>

#include "node.hpp"

constexpr uint64_t kLead = 20000000;  // ns from the command to the first message

int main(int argc, char** argv) {
  node::Options options(argc, argv);
  node::init(argc, argv, options, "source");
  ros::NodeHandle handle;
  ros::AsyncSpinner spinner(1);
  ros::Publisher publisher =
      node::advertise(handle, options.text("topic", "/cmd"), uint32_t(options.number("queue", 100)));
  spinner.start();
  node::sleep_sharply();
  node::say("up");
  const double phase = options.number("phase", -1);
  uint32_t round;
  size_t size, count;
  double rate;
  std::string path;
  while (ros::ok() && std::cin >> round >> size >> rate >> count >> path) {
    std_msgs::UInt8MultiArray message;
    message.data.assign(std::max(size, node::Head::kSize), 7);
    std::vector<uint64_t> late(count, 0);
    uint64_t start = node::now_ns() + kLead;
    if (phase >= 0) {
      const double period = 1e9 / rate, behind = double(start) - phase * 1e6;
      start += uint64_t(std::ceil(behind / period) * period - behind);
    }
    uint32_t sent = 0;
    for (; sent < count && ros::ok(); ++sent) {
      const uint64_t due = start + uint64_t(1e9 / rate * sent);
      node::Head{round, sent, due}.write(message.data);
      node::sleep_until(due);
      late[sent] = node::now_ns() - due;
      publisher.publish(message);
    }
    node::write_rows(path, late.data(), sent);
    node::say("sent", node::number("round", round) + ", " + node::number("count", sent) + ", " +
                          node::number("start_ns", start));
  }
}
