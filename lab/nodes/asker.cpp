// Calls of rmpa_test/Work, one after the other (roscpp); the other end is the worker node of the tests.
// Reads "SIZE COUNT HOW FILE" lines, HOW once or persistent, and writes each call's nanoseconds (8 bytes, native).
// Events: up; ready once the service is there; round with the number that failed.
#include <cstdio>
#include <iostream>

#include "node.hpp"
#include "work.hpp"

int main(int argc, char** argv) {
  node::Options options(argc, argv);
  node::init(argc, argv, options, "asker");
  ros::NodeHandle node;
  const std::string service = options.text("service", "/work");
  node::say("up");
  ros::service::waitForService(service);
  node::say("ready");
  size_t size;
  unsigned count;
  std::string how, path;
  while (ros::ok() && std::cin >> size >> count >> how >> path) {
    rmpa_test::Work work;
    work.request.op = "echo";
    work.request.data.assign(size, 7);
    std::vector<uint64_t> samples;
    unsigned failed = 0;
    ros::ServiceClient kept = node.serviceClient<rmpa_test::Work>(service, true);
    for (unsigned i = 0; i < count && ros::ok(); ++i) {
      auto start = std::chrono::steady_clock::now();
      bool good = how == "persistent" ? kept.call(work.request, work.response)
                                      : ros::service::call(service, work.request, work.response);
      auto took = std::chrono::steady_clock::now() - start;
      if (good && work.response.data.size() == size)
        samples.push_back(uint64_t(took.count()));
      else
        ++failed;
    }
    FILE* out = std::fopen(path.c_str(), "wb");
    std::fwrite(samples.data(), 8, samples.size(), out);
    std::fclose(out);
    node::say("round", "\"failed\": " + std::to_string(failed));
  }
}
