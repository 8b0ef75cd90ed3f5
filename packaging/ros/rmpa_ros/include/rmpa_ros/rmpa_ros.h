// Smart Resources from a roscpp node: ask for a quality, hear what comes of it, say an attribute. One header, C++11.
//
//   rmpa_ros::Resource camera("camera");
//   camera.onResponse([](const rmpa_ros::Status& answer) { ROS_INFO_STREAM(answer); });
//   camera.onAlarm([](const rmpa_ros::Status& alarm) { ROS_WARN_STREAM(alarm); });
//   camera.onProfile([](const std::string& name) { ROS_INFO_STREAM("the camera runs " << name); });
//   camera.ask({{"rate", ">= 20 Hz hard"}, {"latency", "<= 50 ms"}});
//   ros::Subscriber images = nh.subscribe<sensor_msgs::Image>(
//       "/usb_cam/image_raw", 10, [&](const sensor_msgs::ImageConstPtr& image) { camera.arrived(image->header); });
//   ros::spin();
//
// Requests, responses and alarms are topics below the resource's node (docs/guides/smart-resources.md of RMPA), which
// cross the mesh like any other: the resource may be in any module. Callbacks come from ros::spin's threads.
#ifndef RMPA_ROS_RMPA_ROS_H
#define RMPA_ROS_RMPA_ROS_H

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <iomanip>
#include <map>
#include <mutex>
#include <ostream>
#include <random>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include <diagnostic_msgs/DiagnosticArray.h>
#include <ros/ros.h>
#include <std_msgs/Header.h>
#include <std_msgs/String.h>

namespace rmpa_ros {

// Attributes with their values or requests, in order.
typedef std::vector<std::pair<std::string, std::string> > Values;

enum Level { OK, WARN, ERROR_LEVEL, STALE };

// A response or an alarm: a level, a short text, and by attribute what was wanted and given.
struct Status {
  int level = OK;
  std::string message;
  Values values;
  bool operator==(const Status& other) const {
    return level == other.level && message == other.message && values == other.values;
  }
};

inline std::ostream& operator<<(std::ostream& out, const Status& status) {
  static const char* const kLevels[] = {"OK", "WARN", "ERROR", "STALE"};
  out << kLevels[std::min(std::max(status.level, 0), 3)] << ": " << status.message;
  for (const auto& pair : status.values) out << "; " << pair.first << ": " << pair.second;
  return out;
}

// A Smart Resource in this module's graph, as its clients and the nodes that it is made of see it. Made after
// ros::init; must live as long as the node spins.
class Resource {
 public:
  // name: of the resource's node: "camera", "/robot1/camera".
  explicit Resource(const std::string& name) : name_(name.empty() || name[0] != '/' ? "/" + name : name) {}
  Resource(const Resource&) = delete;
  Resource& operator=(const Resource&) = delete;

  // Asks for a quality: {{"rate", ">= 20 Hz hard"}, {"image.latency", "<= 50 ms weight=2"}}. A request replaces the
  // last one; an empty one releases it. The resource drops it when this node ends. priority: the higher one wins where
  // clients contradict each other; expires: dropped after "30 s".
  void ask(const Values& requests, int priority = 0, const std::string& expires = "") {
    Values values = requests;
    if (priority != 0) values.emplace_back("priority", std::to_string(priority));
    if (!expires.empty()) values.emplace_back("expires", expires);
    std::string mark;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      requests_ = requests;
      mark_ = mark = makeMark();
      answered_ = false;
    }
    hearResponses();
    publish("requirements", values, mark, true);
  }

  // Asks for nothing any more.
  void release() { ask(Values()); }

  // Called with each response to this node's request that differs from the one before.
  void onResponse(std::function<void(const Status&)> callback) {
    on_response_ = std::move(callback);
    hearResponses();
  }

  // Called with each alarm, and with level OK when one is over.
  void onAlarm(std::function<void(const Status&)> callback) {
    on_alarm_ = std::move(callback);
    alarms_ = nh_.subscribe<diagnostic_msgs::DiagnosticArray>(
        name_ + "/alarms", 10, [this](const diagnostic_msgs::DiagnosticArray::ConstPtr& message) {
          for (const auto& status : message->status) on_alarm_(read(status));
        });
  }

  // Called with the name of the profile that runs, now and after each change; empty: none runs.
  void onProfile(std::function<void(const std::string&)> callback) {
    on_profile_ = std::move(callback);
    profile_ = nh_.subscribe<std_msgs::String>(
        name_ + "/profile", 1, [this](const std_msgs::String::ConstPtr& message) { on_profile_(message->data); });
  }

  // Counts a message of the resource that has arrived here; call it in the callback of your subscriber. Once a second
  // the resource is told rate, period_sd, latency and loss as they are here, those that this node asks for.
  void arrived(const std_msgs::Header& header) { count(&header); }
  // Likewise for a message without a header, which has no latency and no loss.
  void arrived() { count(nullptr); }

  // Tells the resource a quality as this client sees it: {{"rate", "12 Hz"}}; repeat it each second.
  void observe(const Values& values) { publish("observed", values); }

  // Says an attribute of the resource that this node is a part of, in its unit. The node is one of the resource's
  // file, [node.NAME], and the attribute one of [attribute.NAME] without value; others are refused.
  void say(const std::string& attribute, double value) { publish("attributes", {{attribute, text(value)}}); }
  void say(const std::string& attribute, const std::string& word) { publish("attributes", {{attribute, word}}); }

 private:
  static std::string text(double value) {
    std::ostringstream out;
    out << std::setprecision(17) << value;
    return out.str();
  }

  static std::string makeMark() {
    std::random_device random;
    std::ostringstream out;
    for (int i = 0; i < 4; ++i) out << std::hex << std::setw(8) << std::setfill('0') << (random() & 0xffffffffu);
    return out.str();
  }

  static Status read(const diagnostic_msgs::DiagnosticStatus& status) {
    Status made;
    made.level = status.level;
    made.message = status.message;
    for (const auto& pair : status.values) made.values.emplace_back(pair.key, pair.value);
    return made;
  }

  void hearResponses() {
    if (responses_) return;
    responses_ = nh_.subscribe<diagnostic_msgs::DiagnosticArray>(
        name_ + "/responses", 10, [this](const diagnostic_msgs::DiagnosticArray::ConstPtr& message) {
          for (const auto& status : message->status) {
            const Status answer = read(status);
            {
              // In the resource's graph this node may have its proxy's name, so the unique mark identifies it.
              std::lock_guard<std::mutex> lock(mutex_);
              if (mark_.empty() || status.hardware_id != mark_ || (answered_ && answer == answer_)) continue;
              answered_ = true;
              answer_ = answer;
            }
            if (on_response_) on_response_(answer);
          }
        });
  }

  void publish(const std::string& topic, const Values& values, const std::string& mark = "", bool latch = false) {
    diagnostic_msgs::DiagnosticArray message;
    message.header.stamp = ros::Time::now();
    message.status.resize(1);
    message.status[0].name = ros::this_node::getName();
    message.status[0].hardware_id = mark;
    for (const auto& pair : values) {
      message.status[0].values.emplace_back();
      message.status[0].values.back().key = pair.first;
      message.status[0].values.back().value = pair.second;
    }
    std::lock_guard<std::mutex> lock(publishing_);
    auto found = publishers_.find(topic);
    if (found == publishers_.end()) {
      const auto made = nh_.advertise<diagnostic_msgs::DiagnosticArray>(name_ + "/" + topic, 10, latch);
      found = publishers_.emplace(topic, made).first;
    }
    found->second.publish(message);
  }

  void count(const std_msgs::Header* header) {
    const double now = ros::Time::now().toSec();
    std::lock_guard<std::mutex> lock(mutex_);
    if (counted_) {
      ++periods_;
      sum_ += now - last_;
      squares_ += (now - last_) * (now - last_);
    }
    if (!timer_) {
      timer_ = nh_.createTimer(ros::Duration(1.0), [this](const ros::TimerEvent&) { report(); });
    }
    counted_ = true;
    last_ = now;
    ++count_;
    if (header == nullptr) return;
    if (!header->stamp.isZero()) {
      ages_ += now - header->stamp.toSec();
      ++stamped_;
    }
    if (numbered_) {
      const std::uint32_t gap = header->seq - sequence_ - 1;
      if (gap < 0x80000000u) lost_ += gap;
    }
    numbered_ = true;
    sequence_ = header->seq;
  }

  void report() {
    Values known;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      std::map<std::string, double> measured;
      const double mean = periods_ ? sum_ / periods_ : 0.0;
      // The present period is at least as long as the silence, so the rate falls as soon as the source stops.
      const double longest = std::max(mean, ros::Time::now().toSec() - last_);
      if (longest > 0) measured["rate"] = 1 / longest;
      if (periods_ > 1) measured["period_sd"] = std::sqrt(std::max(0.0, squares_ / periods_ - mean * mean));
      if (stamped_) measured["latency"] = std::max(0.0, ages_ / stamped_);
      if (count_ && numbered_) measured["loss"] = static_cast<double>(lost_) / static_cast<double>(lost_ + count_);
      for (const auto& request : requests_) {
        const auto found = measured.find(request.first.substr(request.first.rfind('.') + 1));
        if (found != measured.end()) known.emplace_back(request.first, text(found->second));
      }
      periods_ = count_ = stamped_ = 0;
      lost_ = 0;
      sum_ = squares_ = ages_ = 0;
    }
    if (!known.empty()) publish("observed", known);
  }

  ros::NodeHandle nh_;
  const std::string name_;
  std::mutex mutex_, publishing_;
  std::map<std::string, ros::Publisher> publishers_;
  ros::Subscriber responses_, alarms_, profile_;
  std::function<void(const Status&)> on_response_, on_alarm_;
  std::function<void(const std::string&)> on_profile_;
  ros::Timer timer_;
  Values requests_;
  std::string mark_;
  Status answer_;
  bool answered_ = false;
  // What has arrived since the last report.
  bool counted_ = false, numbered_ = false;
  double last_ = 0, sum_ = 0, squares_ = 0, ages_ = 0;
  std::uint64_t lost_ = 0;
  std::uint32_t sequence_ = 0;
  unsigned periods_ = 0, count_ = 0, stamped_ = 0;
};

}  // namespace rmpa_ros

#endif  // RMPA_ROS_RMPA_ROS_H
