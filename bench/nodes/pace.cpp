// Publish on an absolute schedule (roscpp): a message that leaves late does not move those behind it.
// Options: --topic --queue. Reads "ROUND SIZE RATE COUNT FILE" lines: COUNT messages of SIZE bytes (16 at the least) at
// RATE Hz; each carries the round (4 bytes), its sequence from 0 (4) and the ns at which it was due (8), native order.
// FILE gets for each message how many ns after that it was given to roscpp (8 bytes).
// Events: up; connected; sent with the round. CLOCK_MONOTONIC is one for all network namespaces, and nobody sets it.
#include <sys/prctl.h>
#include <time.h>

#include <iostream>

#include "payload.hpp"

static uint64_t now_ns() {
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return uint64_t(now.tv_sec) * 1000000000u + uint64_t(now.tv_nsec);
}

static void sleep_until(uint64_t ns) {
  timespec due{time_t(ns / 1000000000u), long(ns % 1000000000u)};
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, nullptr)) {
  }
}

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "pace");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(1);
  spinner.start();
  ros::Publisher publisher = node.advertise<std_msgs::UInt8MultiArray>(options.text("topic", "/paced"),
                                                                       uint32_t(options.number("queue", 100)));
  prctl(PR_SET_TIMERSLACK, 1);  // of this thread: the kernel's 50 us are not the path's
  payload::say("up");
  while (ros::ok() && publisher.getNumSubscribers() == 0) std::this_thread::sleep_for(std::chrono::milliseconds(5));
  payload::say("connected");
  uint32_t round;
  size_t size, count;
  double rate;
  std::string path;
  while (ros::ok() && std::cin >> round >> size >> rate >> count >> path) {
    std_msgs::UInt8MultiArray message;
    message.data.assign(size, 7);
    std::vector<uint64_t> late(count, 0);
    const uint64_t start = now_ns() + 20000000u;
    uint32_t sent = 0;
    for (; sent < count && ros::ok(); ++sent) {
      const uint64_t due = start + uint64_t(1e9 / rate * sent);
      std::memcpy(&message.data[0], &round, 4);
      std::memcpy(&message.data[4], &sent, 4);
      std::memcpy(&message.data[8], &due, 8);
      sleep_until(due);
      late[sent] = now_ns() - due;
      publisher.publish(message);
    }
    FILE* out = std::fopen(path.c_str(), "wb");
    std::fwrite(late.data(), 8, sent, out);
    std::fclose(out);
    payload::say("sent", "\"round\": " + std::to_string(round) + ", \"count\": " + std::to_string(sent));
  }
}
