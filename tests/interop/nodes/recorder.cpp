// Note each message of a talker or teller and when it came (roscpp); options, commands and events as of recorder.py.
#include <fstream>
#include <iostream>
#include <mutex>

#include "payload.hpp"

#pragma pack(push, 1)
struct Row {
  uint32_t source, sequence;
  uint64_t sent_ns, came_ns;
  uint32_t size, bad;
};
#pragma pack(pop)

static Row row_of(const std::vector<uint8_t>& data) {
  Row row{0, 0, 0, payload::wall_ns(), uint32_t(data.size()), 1};
  if (data.size() < payload::kHeader) return row;
  uint32_t crc;
  std::memcpy(&row.source, &data[0], 4);
  std::memcpy(&row.sequence, &data[4], 4);
  std::memcpy(&row.sent_ns, &data[8], 8);
  std::memcpy(&crc, &data[16], 4);
  row.bad = payload::crc32(data.data() + payload::kHeader, data.size() - payload::kHeader) != crc;
  return row;
}

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "recorder");
  ros::NodeHandle node;
  std::mutex mutex;
  std::vector<Row> rows;
  payload::Tally tally;
  const std::string folder = options.text("save", "");
  ros::Subscriber subscriber = node.subscribe<std_msgs::UInt8MultiArray>(
      options.text("topic", "/chatter"), uint32_t(options.number("queue", 10000)),
      [&](const std_msgs::UInt8MultiArray::ConstPtr& message) {
        const Row row = row_of(message->data);
        if (!folder.empty()) {
          const std::string path = folder + "/" + std::to_string(row.source) + "-" + std::to_string(row.sequence);
          std::ofstream out(path + ".part");
          out.write(reinterpret_cast<const char*>(message->data.data()), std::streamsize(message->data.size()));
          out.close();
          std::rename((path + ".part").c_str(), path.c_str());
        }
        std::lock_guard<std::mutex> lock(mutex);
        rows.push_back(row);
        tally.take(message->data);
      },
      ros::VoidConstPtr(), payload::hints(options));
  uint64_t reported = 0;
  ros::WallTimer timer = node.createWallTimer(ros::WallDuration(0.1), [&](const ros::WallTimerEvent&) {
    std::lock_guard<std::mutex> lock(mutex);
    if (tally.count != reported) payload::say("report", tally.report());
    reported = tally.count;
  });
  std::thread commands([&] {
    std::string path;
    while (std::getline(std::cin, path)) {
      std::lock_guard<std::mutex> lock(mutex);
      std::ofstream out(path);
      out.write(reinterpret_cast<const char*>(rows.data()), std::streamsize(rows.size() * sizeof(Row)));
      out.close();
      payload::say("noted", "\"count\": " + std::to_string(rows.size()));
      rows.clear();
    }
  });
  commands.detach();
  payload::say("up", "\"node\": \"" + ros::this_node::getName() + "\"");
  ros::spin();
}
