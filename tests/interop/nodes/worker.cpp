// Serve rmpa_test/Work (roscpp); options, operations and events as of worker.py.
#include <unistd.h>

#include <stdexcept>

#include "payload.hpp"
#include "work.hpp"

int main(int argc, char** argv) {
  payload::Options options(argc, argv);
  payload::init(argc, argv, options, "worker");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(8);
  spinner.start();
  const bool quiet = options.flag("quiet");
  boost::function<bool(rmpa_test::WorkRequest&, rmpa_test::WorkResponse&)> work =
      [quiet](rmpa_test::WorkRequest& request, rmpa_test::WorkResponse& response) {
        if (!quiet)
          payload::say("call", "\"op\": \"" + request.op + "\", \"size\": " + std::to_string(request.data.size()));
        if (request.op == "die") _exit(1);
        if (request.op == "fail") return false;
        if (request.op == "sleep") std::this_thread::sleep_for(std::chrono::duration<double>(request.seconds));
        response.text = request.op;
        response.data = request.data;
        return true;
      };
  ros::ServiceServer server =
      node.advertiseService<rmpa_test::WorkRequest, rmpa_test::WorkResponse>(options.text("service", "/work"), work);
  payload::say("up", "\"node\": \"" + ros::this_node::getName() + "\"");
  ros::waitForShutdown();
}
