// Serve std_srvs/SetBool (roscpp), and answer at once.
// Options: --service. Events: up.
#include <std_srvs/SetBool.h>

#include "node.hpp"

int main(int argc, char** argv) {
  node::Options options(argc, argv);
  node::init(argc, argv, options, "switch");
  ros::NodeHandle handle;
  boost::function<bool(std_srvs::SetBoolRequest&, std_srvs::SetBoolResponse&)> answer =
      [](std_srvs::SetBoolRequest& request, std_srvs::SetBoolResponse& response) {
        response.success = request.data;
        response.message = "switched";
        return true;
      };
  ros::ServiceServer server = handle.advertiseService(options.text("service", "/switch"), answer);
  node::say("up");
  ros::spin();
}
