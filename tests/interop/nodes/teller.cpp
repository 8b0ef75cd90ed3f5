// Publish what it is told to (roscpp); options, commands and events as of teller.py.
#include <fstream>
#include <iostream>

#include "payload.hpp"

static std::vector<size_t> sizes_of(const std::string& text) {
  std::vector<size_t> sizes;
  std::istringstream words(text);
  for (std::string word; std::getline(words, word, ',');) sizes.push_back(std::stoul(word));
  return sizes;
}

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "teller");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(1);
  spinner.start();
  ros::Publisher publisher = node.advertise<std_msgs::UInt8MultiArray>(
      options.text("topic", "/chatter"), uint32_t(options.number("queue", 10000)), options.flag("latch"));
  payload::say("up", "\"node\": \"" + ros::this_node::getName() + "\"");
  while (ros::ok() && publisher.getNumSubscribers() < options.number("wait", 0))
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  payload::say("connected");
  const uint32_t source = uint32_t(options.number("source", 1));
  const std::string folder = options.text("save", "");
  std::map<size_t, payload::Pattern> patterns;
  uint32_t sequence = 0;
  std::string words;
  uint64_t count;
  double rate;
  while (ros::ok() && std::cin >> words >> count >> rate) {
    const std::vector<size_t> sizes = sizes_of(words);
    auto due = std::chrono::steady_clock::now();
    for (uint64_t i = 0; i < count && ros::ok(); ++i) {
      const size_t size = sizes[i % sizes.size()];
      std_msgs::UInt8MultiArray message;
      patterns.try_emplace(size, size).first->second.fill(message.data, source, ++sequence);
      if (!folder.empty()) {
        std::ofstream out(folder + "/" + std::to_string(source) + "-" + std::to_string(sequence));
        out.write(reinterpret_cast<const char*>(message.data.data()), std::streamsize(message.data.size()));
      }
      publisher.publish(message);
      if (rate > 0) {
        due += std::chrono::nanoseconds(int64_t(1e9 / rate));
        std::this_thread::sleep_until(due);
      }
    }
    payload::say("told", "\"sent\": " + std::to_string(sequence));
  }
  ros::waitForShutdown();
}
