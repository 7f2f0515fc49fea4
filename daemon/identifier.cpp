#include "daemon/identifier.h"

#include <algorithm>
#include <array>
#include <cstdio>
#include <ctime>
#include <random>

namespace booth {

std::string random_hex(size_t digits) {
  constexpr std::string_view alphabet = "0123456789abcdef";
  std::random_device device;
  std::string text(digits, '0');
  for (char& digit : text) digit = alphabet[device() % alphabet.size()];
  return text;
}

std::string iso8601(std::chrono::system_clock::time_point time, bool milliseconds) {
  const auto since_epoch = std::chrono::floor<std::chrono::milliseconds>(time).time_since_epoch();
  const auto whole = std::chrono::floor<std::chrono::seconds>(since_epoch);
  const std::time_t seconds = whole.count();
  std::tm utc{};
  ::gmtime_r(&seconds, &utc);
  std::array<char, 32> text{};
  std::string result(text.data(), std::strftime(text.data(), text.size(), "%Y-%m-%dT%H:%M:%S", &utc));
  if (milliseconds) {
    const int length =
        std::snprintf(text.data(), text.size(), ".%03d", static_cast<int>((since_epoch - whole).count()));
    result.append(text.data(), static_cast<size_t>(length));
  }
  return result + "Z";
}

std::optional<std::chrono::system_clock::time_point> parse_iso8601(const std::string& text) {
  std::tm utc{};
  if (::strptime(text.c_str(), "%Y-%m-%dT%H:%M:%S", &utc) == nullptr) return std::nullopt;
  using Clock = std::chrono::system_clock;
  const std::chrono::seconds since_epoch(::timegm(&utc));
  if (since_epoch > std::chrono::floor<std::chrono::seconds>(Clock::duration::max()) ||
      since_epoch < std::chrono::ceil<std::chrono::seconds>(Clock::duration::min()))
    return std::nullopt;
  return Clock::time_point(since_epoch);
}

std::string make_capture_id(std::chrono::system_clock::time_point time) {
  std::string id = iso8601(time, true) + "-" + random_hex(4);
  std::replace(id.begin(), id.end(), ':', '-');
  return id;
}

}  // namespace booth
