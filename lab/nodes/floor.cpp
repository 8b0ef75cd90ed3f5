// The floor: raw TCP ping-pong over loopback, no ROS.  floor serve | floor ping PORT
// ping reads "SIZE COUNT FILE" lines and writes each round trip's nanoseconds (8 bytes, native) to FILE.
#include <arpa/inet.h>
#include <netinet/tcp.h>
#include <sys/socket.h>
#include <unistd.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <vector>

static bool read_all(int fd, char* data, size_t size) {
  while (size) {
    ssize_t got = recv(fd, data, size, 0);
    if (got <= 0) return false;
    data += got;
    size -= size_t(got);
  }
  return true;
}

static bool write_all(int fd, const char* data, size_t size) {
  while (size) {
    ssize_t sent = send(fd, data, size, MSG_NOSIGNAL);
    if (sent <= 0) return false;
    data += sent;
    size -= size_t(sent);
  }
  return true;
}

static void no_delay(int fd) {
  int one = 1;
  setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
}

int main(int argc, char** argv) {
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  std::vector<char> data(4 + (1 << 21));
  if (argc > 1 && !std::strcmp(argv[1], "serve")) {
    int listener = socket(AF_INET, SOCK_STREAM, 0);
    bind(listener, reinterpret_cast<sockaddr*>(&address), sizeof address);
    listen(listener, 1);
    socklen_t length = sizeof address;
    getsockname(listener, reinterpret_cast<sockaddr*>(&address), &length);
    std::printf("@ {\"event\": \"up\", \"port\": %d}\n", ntohs(address.sin_port));
    std::fflush(stdout);
    int peer = accept(listener, nullptr, nullptr);
    no_delay(peer);
    uint32_t size;
    while (read_all(peer, data.data(), 4)) {
      std::memcpy(&size, data.data(), 4);
      if (!read_all(peer, data.data() + 4, size) || !write_all(peer, data.data(), 4 + size)) break;
    }
    return 0;
  }
  address.sin_port = htons(uint16_t(std::atoi(argv[2])));
  int fd = socket(AF_INET, SOCK_STREAM, 0);
  if (connect(fd, reinterpret_cast<sockaddr*>(&address), sizeof address)) return 1;
  no_delay(fd);
  std::printf("@ {\"event\": \"ready\"}\n");
  std::fflush(stdout);
  unsigned size, count;
  char path[1000];
  while (std::scanf("%u %u %999s", &size, &count, path) == 3) {
    std::vector<uint64_t> samples;
    std::memcpy(data.data(), &size, 4);
    for (unsigned i = 0; i < count; ++i) {
      auto start = std::chrono::steady_clock::now();
      if (!write_all(fd, data.data(), 4 + size) || !read_all(fd, data.data(), 4 + size)) return 1;
      samples.push_back(uint64_t((std::chrono::steady_clock::now() - start).count()));
    }
    FILE* out = std::fopen(path, "wb");
    std::fwrite(samples.data(), 8, samples.size(), out);
    std::fclose(out);
    std::printf("@ {\"event\": \"round\", \"lost\": 0}\n");
    std::fflush(stdout);
  }
}
