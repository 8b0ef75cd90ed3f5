// What the talkers send and the listeners check, and the options of every node; payload.py is the same in Python.
#pragma once

#include <ros/ros.h>
#include <std_msgs/UInt8MultiArray.h>

#include <boost/crc.hpp>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <map>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

namespace payload {

constexpr size_t kHeader = 20;
constexpr size_t kPeriod = 251;

inline uint32_t crc32(const uint8_t* data, size_t size) {
  boost::crc_32_type crc;
  crc.process_bytes(data, size);
  return static_cast<uint32_t>(crc.checksum());
}

inline uint64_t wall_ns() {
  using namespace std::chrono;
  return duration_cast<nanoseconds>(system_clock::now().time_since_epoch()).count();
}

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

// Bodies of one size: the same bytes as payload.py makes.
class Pattern {
 public:
  explicit Pattern(size_t size) : size_(std::max(size, kHeader)), bytes_(size_ - kHeader + kPeriod) {
    for (uint64_t i = 0; i < bytes_.size(); ++i) bytes_[i] = static_cast<uint8_t>(i * i + (i >> 8));
  }
  void fill(std::vector<uint8_t>& data, uint32_t source, uint32_t sequence) const {
    data.resize(size_);
    const uint8_t* body = bytes_.data() + sequence % kPeriod;
    size_t length = size_ - kHeader;
    uint64_t stamp = wall_ns();
    uint32_t crc = crc32(body, length);
    std::memcpy(&data[0], &source, 4);
    std::memcpy(&data[4], &sequence, 4);
    std::memcpy(&data[8], &stamp, 8);
    std::memcpy(&data[16], &crc, 4);
    if (length) std::memcpy(&data[kHeader], body, length);
  }

 private:
  size_t size_;
  std::vector<uint8_t> bytes_;
};

struct Source {
  uint64_t count = 0, first = 0, last = 0, gaps = 0, doubled = 0;
};

class Tally {
 public:
  uint64_t count = 0;
  void take(const std::vector<uint8_t>& data) {
    ++count;
    bytes_ += data.size();
    uint32_t source, sequence, crc;
    if (data.size() < kHeader) {
      ++bad_;
      return;
    }
    std::memcpy(&source, &data[0], 4);
    std::memcpy(&sequence, &data[4], 4);
    std::memcpy(&crc, &data[16], 4);
    if (crc32(data.data() + kHeader, data.size() - kHeader) != crc) {
      ++bad_;
      return;
    }
    Source& seen = sources_[source];
    if (seen.count++ == 0) {
      seen.first = seen.last = sequence;
    } else if (sequence > seen.last) {
      seen.gaps += sequence - seen.last - 1;
      seen.last = sequence;
    } else {
      ++seen.doubled;
    }
  }
  std::string report() const {
    uint64_t gaps = 0, doubled = 0, last = 0;
    std::ostringstream rows;
    for (const auto& [key, row] : sources_) {
      gaps += row.gaps;
      doubled += row.doubled;
      last = std::max(last, row.last);
      rows << (rows.tellp() > 0 ? ", " : "") << '"' << key << "\": {\"count\": " << row.count << ", \"first\": "
           << row.first << ", \"last\": " << row.last << ", \"gaps\": " << row.gaps << ", \"doubled\": " << row.doubled
           << "}";
    }
    std::ostringstream out;
    out << "\"count\": " << count << ", \"bytes\": " << bytes_ << ", \"bad\": " << bad_ << ", \"gaps\": " << gaps
        << ", \"doubled\": " << doubled << ", \"last\": " << last << ", \"sources\": {" << rows.str() << "}";
    return out.str();
  }

 private:
  uint64_t bytes_ = 0, bad_ = 0;
  std::map<uint32_t, Source> sources_;
};

// One machine-readable line; fields are JSON members.
inline void say(const std::string& event, const std::string& fields = "") {
  std::printf("@ {\"event\": \"%s\"%s%s}\n", event.c_str(), fields.empty() ? "" : ", ", fields.c_str());
  std::fflush(stdout);
}

inline ros::TransportHints hints(const Options& options) { return ros::TransportHints().tcpNoDelay(options.flag("nodelay")); }

}  // namespace payload
