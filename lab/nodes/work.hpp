// The service type of the workers and callers; work.py is the same in Python.
#pragma once

#include <ros/ros.h>

#include <string>
#include <vector>

namespace rmpa_test {

struct WorkRequest {
  std::string op;
  double seconds = 0;
  std::vector<uint8_t> data;
};
struct WorkResponse {
  std::string text;
  std::vector<uint8_t> data;
};
struct Work {
  using Request = WorkRequest;
  using Response = WorkResponse;
  Request request;
  Response response;
  using RequestType = Request;
  using ResponseType = Response;
};

}  // namespace rmpa_test

#define RMPA_WORK_TRAITS(kind, name, sum)                                                                \
  template <>                                                                                      \
  struct MD5Sum<rmpa_test::kind> {                                                                 \
    static const char* value() { return sum; }                                                     \
    static const char* value(const rmpa_test::kind&) { return value(); }                           \
  };                                                                                               \
  template <>                                                                                      \
  struct DataType<rmpa_test::kind> {                                                               \
    static const char* value() { return "rmpa_test/" name; }                                      \
    static const char* value(const rmpa_test::kind&) { return value(); }                           \
  };

namespace ros {
namespace message_traits {
RMPA_WORK_TRAITS(WorkRequest, "WorkRequest", "ef2f32801e2873644ea789559134f902")
RMPA_WORK_TRAITS(WorkResponse, "WorkResponse", "c9283e94f17c7db454a05bd846b5786e")
}  // namespace message_traits
namespace service_traits {
RMPA_WORK_TRAITS(Work, "Work", "af5edcf406bf3ebf7ab094f161a24925")
RMPA_WORK_TRAITS(WorkRequest, "Work", "af5edcf406bf3ebf7ab094f161a24925")
RMPA_WORK_TRAITS(WorkResponse, "Work", "af5edcf406bf3ebf7ab094f161a24925")
}  // namespace service_traits
namespace serialization {
template <>
struct Serializer<rmpa_test::WorkRequest> {
  template <typename Stream, typename T>
  static void allInOne(Stream& stream, T m) {
    stream.next(m.op);
    stream.next(m.seconds);
    stream.next(m.data);
  }
  ROS_DECLARE_ALLINONE_SERIALIZER
};
template <>
struct Serializer<rmpa_test::WorkResponse> {
  template <typename Stream, typename T>
  static void allInOne(Stream& stream, T m) {
    stream.next(m.text);
    stream.next(m.data);
  }
  ROS_DECLARE_ALLINONE_SERIALIZER
};
}  // namespace serialization
}  // namespace ros
