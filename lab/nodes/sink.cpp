// Note when each measured message comes (roscpp). Options: --topics with commas --queue --nodelay.
// Reads "ROUND FILE SETTLE" lines: waits until nothing has come for SETTLE seconds (10 at the most), writes what came of
// that round (0: of every round) to FILE as topic's index, sequence, due and arrival (8 bytes each, native order; ns of
// CLOCK_MONOTONIC), and forgets all that came.
// Events: up; noted with the round and the count; first with the topic when its first message came; again with the gap
// when the first after a pause did.
#include <array>
#include <chrono>
#include <iostream>
#include <memory>
#include <mutex>
#include <sstream>
#include <thread>

#include "node.hpp"

constexpr uint64_t kPause = 500000000;     // ns without a message after which the next one comes "again"
constexpr uint64_t kPatience = 10000000000u;  // ns of waiting for silence at the most

struct Arrival {
  uint32_t round, topic, sequence;
  uint64_t due, ns;
};

int main(int argc, char** argv) {
  node::Options options(argc, argv);
  node::init(argc, argv, options, "sink");
  ros::NodeHandle handle;
  std::mutex mutex;
  std::vector<Arrival> arrivals(1 << 18);  // touched now: no page fault and no growth while it counts
  arrivals.clear();
  std::vector<ros::Subscriber> subscribers;
  std::istringstream topics(options.text("topics", "/cmd,/vel"));
  uint32_t index = 0;
  for (std::string topic; std::getline(topics, topic, ','); ++index) {
    auto last = std::make_shared<uint64_t>(0);
    subscribers.push_back(handle.subscribe<std_msgs::UInt8MultiArray>(
        topic, uint32_t(options.number("queue", 1000)),
        [&mutex, &arrivals, topic, index, last](const std_msgs::UInt8MultiArray::ConstPtr& message) {
          const uint64_t now = node::now_ns();
          node::Head head{};
          if (!head.read(message->data)) return;
          {
            std::lock_guard<std::mutex> lock(mutex);
            arrivals.push_back({head.round, index, head.sequence, head.due, now});
          }
          const std::string where = "\"topic\": \"" + topic + "\", " + node::number("came_ns", now);
          if (*last == 0) {
            node::say("first", where);
          } else if (now - *last > kPause) {
            node::say("again", where + ", " + node::number("gap_ns", now - *last));
          }
          *last = now;
        },
        ros::VoidConstPtr(), node::hints(options)));
  }
  std::thread commands([&] {
    uint32_t round;
    std::string path;
    double settle;
    while (std::cin >> round >> path >> settle) {
      const uint64_t begun = node::now_ns();
      for (uint64_t last = begun; node::now_ns() < std::min(begun + kPatience, last + uint64_t(settle * 1e9));) {
        std::this_thread::sleep_for(std::chrono::milliseconds(20));
        std::lock_guard<std::mutex> lock(mutex);
        if (!arrivals.empty()) last = std::max(begun, arrivals.back().ns);
      }
      std::vector<std::array<uint64_t, 4>> rows;
      {
        std::lock_guard<std::mutex> lock(mutex);
        for (const Arrival& one : arrivals)
          if (round == 0 || one.round == round) rows.push_back({one.topic, one.sequence, one.due, one.ns});
        arrivals.clear();
      }
      node::write_rows(path, rows.data(), rows.size());
      node::say("noted", node::number("round", round) + ", " + node::number("count", rows.size()));
    }
  });
  commands.detach();
  node::say("up");
  ros::spin();
}
