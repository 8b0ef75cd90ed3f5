// What every roscpp node has: options, machine-readable lines, one clock, and the head of a measured message.
#pragma once

#include <ros/ros.h>
#include <std_msgs/UInt8MultiArray.h>
#include <sys/prctl.h>
#include <time.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <map>
#include <string>
#include <thread>
#include <vector>

namespace node {

// CLOCK_MONOTONIC is the same in all network namespaces and is never set.
inline uint64_t now_ns() {
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return uint64_t(now.tv_sec) * 1000000000u + uint64_t(now.tv_nsec);
}

// Nanoseconds since 1970, as ros::Rate and the payload of the tests have them.
inline uint64_t wall_ns() {
  using namespace std::chrono;
  return uint64_t(duration_cast<nanoseconds>(system_clock::now().time_since_epoch()).count());
}

inline void sleep_until(uint64_t ns) {
  timespec due{time_t(ns / 1000000000u), long(ns % 1000000000u)};
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, nullptr)) {
  }
}

// Of the calling thread: the kernel's 50 us of slack are not the path's.
inline void sleep_sharply() { prctl(PR_SET_TIMERSLACK, 1); }

// "--word value" pairs and bare "--word" flags.
class Options {
 public:
  Options(int argc, char** argv) {
    for (int i = 1; i < argc; ++i) {
      std::string word = argv[i];
      if (word.rfind("--", 0) != 0) continue;
      bool has_value = i + 1 < argc && std::string(argv[i + 1]).rfind("--", 0) != 0 &&
                       std::string(argv[i + 1]).find(":=") == std::string::npos;
      values_[word.substr(2)] = has_value ? argv[i + 1] : "1";
      if (has_value) ++i;
    }
  }
  std::string text(const std::string& key, const std::string& fallback) const {
    auto found = values_.find(key);
    return found == values_.end() ? fallback : found->second;
  }
  double number(const std::string& key, double fallback) const {
    auto found = values_.find(key);
    return found == values_.end() ? fallback : std::stod(found->second);
  }
  bool flag(const std::string& key) const { return values_.count(key) > 0; }

 private:
  std::map<std::string, std::string> values_;
};

inline void init(int& argc, char** argv, const Options& options, const std::string& program) {
  std::string name = options.text("name", "");
  uint32_t how = name.empty() ? uint32_t(ros::init_options::AnonymousName) : 0u;
  ros::init(argc, argv, name.empty() ? program : name, how);
}

// One machine-readable line; fields are JSON members.
inline void say(const std::string& event, const std::string& fields = "") {
  std::printf("@ {\"event\": \"%s\"%s%s}\n", event.c_str(), fields.empty() ? "" : ", ", fields.c_str());
  std::fflush(stdout);
}

inline std::string number(const std::string& key, uint64_t value) { return "\"" + key + "\": " + std::to_string(value); }

inline ros::TransportHints hints(const Options& options) { return ros::TransportHints().tcpNoDelay(options.flag("nodelay")); }

// The first 16 bytes of a measured message, in native order.
struct Head {
  static constexpr size_t kSize = 16;
  uint32_t round, sequence;
  uint64_t due;
  void write(std::vector<uint8_t>& data) const {
    std::memcpy(&data[0], &round, 4);
    std::memcpy(&data[4], &sequence, 4);
    std::memcpy(&data[8], &due, 8);
  }
  bool read(const std::vector<uint8_t>& data) {
    if (data.size() < kSize) return false;
    std::memcpy(&round, &data[0], 4);
    std::memcpy(&sequence, &data[4], 4);
    std::memcpy(&due, &data[8], 8);
    return true;
  }
};

// Advertise a topic, and say "connected" with the number of subscribers whenever that changes.
inline ros::Publisher advertise(ros::NodeHandle& node, const std::string& topic, uint32_t queue) {
  static std::atomic<int> subscribers{0};
  auto changed = [](int by) {
    return [by](const ros::SingleSubscriberPublisher&) { say("connected", number("subscribers", subscribers += by)); };
  };
  return node.advertise<std_msgs::UInt8MultiArray>(topic, queue, changed(1), changed(-1));
}

// A file of rows that a caller reads when an event says that it is whole.
template <typename Row>
void write_rows(const std::string& path, const Row* rows, size_t count) {
  FILE* out = std::fopen(path.c_str(), "wb");
  if (out == nullptr || std::fwrite(rows, sizeof(Row), count, out) != count || std::fclose(out) != 0) {
    std::perror(path.c_str());
    std::exit(1);
  }
}

}  // namespace node
