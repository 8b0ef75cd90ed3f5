// Note when each message of pace.cpp comes (roscpp). Options: --topic --queue --nodelay.
// Reads "ROUND FILE SETTLE" lines: waits until nothing has come for SETTLE seconds (10 at the most), writes what came
// of that round to FILE as sequence, due and arrival (8 bytes each, native order; ns of CLOCK_MONOTONIC), and forgets
// all that came. Events: up; noted with the round and the count.
#include <time.h>

#include <array>
#include <iostream>
#include <mutex>

#include "payload.hpp"

static uint64_t now_ns() {
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return uint64_t(now.tv_sec) * 1000000000u + uint64_t(now.tv_nsec);
}

struct Arrival {
  uint32_t round;
  uint64_t sequence, due, ns;
};

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "arrive");
  ros::NodeHandle node;
  std::mutex mutex;
  std::vector<Arrival> arrivals(1 << 18);  // touched now: no page fault and no growth while it counts
  arrivals.clear();
  ros::Subscriber subscriber = node.subscribe<std_msgs::UInt8MultiArray>(
      options.text("topic", "/paced"), uint32_t(options.number("queue", 100)),
      [&](const std_msgs::UInt8MultiArray::ConstPtr& message) {
        const uint64_t now = now_ns();
        if (message->data.size() < 16) return;
        uint32_t sequence;
        Arrival arrival{};
        std::memcpy(&arrival.round, &message->data[0], 4);
        std::memcpy(&sequence, &message->data[4], 4);
        std::memcpy(&arrival.due, &message->data[8], 8);
        arrival.sequence = sequence;
        arrival.ns = now;
        std::lock_guard<std::mutex> lock(mutex);
        arrivals.push_back(arrival);
      },
      ros::VoidConstPtr(), payload::hints(options));
  std::thread commands([&] {
    uint32_t round;
    std::string path;
    double settle;
    while (std::cin >> round >> path >> settle) {
      const uint64_t begun = now_ns();
      for (uint64_t last = begun; now_ns() < begun + 10000000000u && now_ns() < last + uint64_t(settle * 1e9);) {
        std::this_thread::sleep_for(std::chrono::milliseconds(20));
        std::lock_guard<std::mutex> lock(mutex);
        if (!arrivals.empty()) last = std::max(begun, arrivals.back().ns);
      }
      std::vector<std::array<uint64_t, 3>> rows;
      {
        std::lock_guard<std::mutex> lock(mutex);
        for (const Arrival& one : arrivals)
          if (one.round == round) rows.push_back({one.sequence, one.due, one.ns});
        arrivals.clear();
      }
      FILE* out = std::fopen(path.c_str(), "wb");
      std::fwrite(rows.data(), sizeof rows[0], rows.size(), out);
      std::fclose(out);
      payload::say("noted", "\"round\": " + std::to_string(round) + ", \"count\": " + std::to_string(rows.size()));
    }
  });
  commands.detach();
  payload::say("up");
  ros::spin();
}
