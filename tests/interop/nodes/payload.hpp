// What the talkers send and the listeners check; payload.py is the same in Python. The rest is every node's (node.hpp).
#pragma once

#include <boost/crc.hpp>
#include <chrono>
#include <sstream>
#include <thread>

#include "node.hpp"

namespace payload {

using node::hints;
using node::init;
using node::Options;
using node::say;
using node::wall_ns;

constexpr size_t kHeader = 20;
constexpr size_t kPeriod = 251;

inline uint32_t crc32(const uint8_t* data, size_t size) {
  boost::crc_32_type crc;
  crc.process_bytes(data, size);
  return static_cast<uint32_t>(crc.checksum());
}

// Bodies of one size: the same bytes as payload.py makes; or, with noise, as a camera's: half of them is noise.
class Pattern {
 public:
  explicit Pattern(size_t size, bool noise = false)
      : size_(std::max(size, kHeader)), bytes_(size_ - kHeader + kPeriod) {
    for (uint64_t i = 0; i < bytes_.size(); ++i)
      bytes_[i] = static_cast<uint8_t>(noise ? i / 3600 + (random() & 7) : i * i + (i >> 8));
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

}  // namespace payload
