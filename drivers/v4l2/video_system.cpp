#include "drivers/v4l2/video_system.h"

#include <fcntl.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <charconv>
#include <filesystem>
#include <fstream>

namespace booth {
namespace {

namespace fs = std::filesystem;

constexpr const char* device_folder = "/dev";
constexpr std::string_view node_prefix = "video";

/// N of "videoN", or -1.
int node_number(const std::string& name) {
  int number = -1;
  if (!name.starts_with(node_prefix)) return -1;
  const char* const end = name.data() + name.size();
  const auto parsed = std::from_chars(name.data() + node_prefix.size(), end, number);
  return parsed.ec == std::errc() && parsed.ptr == end ? number : -1;
}

class LinuxVideoSystem final : public VideoSystem {
 public:
  std::vector<std::string> nodes() override {
    std::vector<int> numbers;
    std::error_code error;
    for (fs::directory_iterator entry(device_folder, error), end; !error && entry != end; entry.increment(error))
      if (const int number = node_number(entry->path().filename()); number >= 0) numbers.push_back(number);
    std::sort(numbers.begin(), numbers.end());
    std::vector<std::string> paths;
    for (const int number : numbers)
      paths.push_back(std::string(device_folder) + "/" + std::string(node_prefix) + std::to_string(number));
    return paths;
  }

  std::string resolve(const std::string& path) override {
    std::error_code error;
    const fs::path node = fs::canonical(path, error);
    return error ? std::string() : node.string();
  }

  std::string serial(const std::string& node) override {
    // The node's "device" is the USB interface; the serial number belongs to the device above it.
    std::ifstream file("/sys/class/video4linux/" + fs::path(node).filename().string() + "/device/../serial");
    std::string serial;
    std::getline(file, serial);
    return serial;
  }

  int open(const std::string& node) override {
    const int fd = ::open(node.c_str(), O_RDWR | O_NONBLOCK | O_CLOEXEC);
    return fd >= 0 ? fd : -errno;
  }

  void close(int fd) override { ::close(fd); }

  int control(int fd, unsigned long request, void* argument) override {
    int result = 0;
    do {
      result = ::ioctl(fd, request, argument);
    } while (result < 0 && errno == EINTR);
    return result < 0 ? -errno : result;
  }

  const uint8_t* map(int fd, size_t length, int64_t offset) override {
    void* const memory = ::mmap(nullptr, length, PROT_READ, MAP_SHARED, fd, offset);
    return memory == MAP_FAILED ? nullptr : static_cast<const uint8_t*>(memory);
  }

  void unmap(const uint8_t* memory, size_t length) override { ::munmap(const_cast<uint8_t*>(memory), length); }
};

}  // namespace

std::shared_ptr<VideoSystem> linux_video_system() { return std::make_shared<LinuxVideoSystem>(); }

}  // namespace booth
