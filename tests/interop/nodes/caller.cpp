// Call rmpa_test/Work as it is told (roscpp); lines and events as of caller.py. roscpp tells no texts of errors.
#include <iostream>
#include <mutex>

#include "payload.hpp"
#include "work.hpp"

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "caller");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(1);
  spinner.start();
  const std::string service = options.text("service", "/work");
  payload::say("up", "\"node\": \"" + ros::this_node::getName() + "\"");
  if (options.flag("wait")) {
    ros::service::waitForService(service);
    payload::say("there");
  }
  std::thread([&] {
    std::string op, how;
    double seconds;
    size_t size;
    unsigned count;
    while (std::cin >> op >> seconds >> size >> count >> how) {
      std::mutex mutex;
      unsigned ok = 0, same = 0;
      auto call = [&](ros::ServiceClient& client, unsigned number) {
        rmpa_test::Work work;
        work.request.op = op;
        work.request.seconds = seconds;
        payload::Pattern(size).fill(work.request.data, 1, number);
        bool good = client.call(work.request, work.response);
        std::lock_guard<std::mutex> lock(mutex);
        ok += good;
        same += good && work.response.data == work.request.data && work.response.text == op;
      };
      auto began = std::chrono::steady_clock::now();
      if (how == "parallel") {
        std::vector<std::thread> threads;
        for (unsigned i = 0; i < count; ++i)
          threads.emplace_back([&, i] {
            ros::ServiceClient client = node.serviceClient<rmpa_test::Work>(service);
            call(client, i);
          });
        for (auto& thread : threads) thread.join();
      } else {
        ros::ServiceClient client = node.serviceClient<rmpa_test::Work>(service, how == "persistent");
        for (unsigned i = 0; i < count; ++i) call(client, i);
      }
      double took = std::chrono::duration<double>(std::chrono::steady_clock::now() - began).count();
      payload::say("done", "\"ok\": " + std::to_string(ok) + ", \"same\": " + std::to_string(same) +
                               ", \"took\": " + std::to_string(took));
    }
  }).detach();
  ros::waitForShutdown();
}
