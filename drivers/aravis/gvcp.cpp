#include "drivers/aravis/gvcp.h"

#include <arpa/inet.h>
#include <ifaddrs.h>
#include <net/if.h>
#include <netdb.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <memory>

namespace booth {
namespace {

constexpr uint16_t gvcp_port = 3956;
constexpr uint8_t key = 0x42;
constexpr uint8_t acknowledge_asked = 0x01;
constexpr uint8_t is_scheduled = 0x80;
constexpr uint16_t discovery_command = 0x0002;
constexpr uint16_t discovery_acknowledge = 0x0003;
constexpr uint16_t action_command_code = 0x0100;
constexpr uint16_t action_acknowledge_code = 0x0101;
constexpr size_t header_size = 8;

void append(std::vector<uint8_t>& bytes, uint64_t value, int size) {
  for (int shift = 8 * (size - 1); shift >= 0; shift -= 8) bytes.push_back(static_cast<uint8_t>(value >> shift));
}

uint16_t word_at(const std::vector<uint8_t>& bytes, size_t at) {
  return static_cast<uint16_t>(bytes[at] << 8 | bytes[at + 1]);
}

std::vector<uint8_t> header(uint8_t flags, uint16_t command, uint16_t size, uint16_t request) {
  std::vector<uint8_t> bytes{key, flags};
  append(bytes, command, 2);
  append(bytes, size, 2);
  append(bytes, request, 2);
  return bytes;
}

sockaddr_in name_of(in_addr address, uint16_t port) {
  sockaddr_in name{};
  name.sin_family = AF_INET;
  name.sin_port = htons(port);
  name.sin_addr = address;
  return name;
}

const sockaddr* generic(const sockaddr_in& name) { return reinterpret_cast<const sockaddr*>(&name); }

class Socket {
 public:
  Socket() : descriptor_(socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0)) {}
  ~Socket() {
    if (descriptor_ >= 0) close(descriptor_);
  }
  Socket(const Socket&) = delete;
  Socket& operator=(const Socket&) = delete;
  int get() const { return descriptor_; }
  int release() { return std::exchange(descriptor_, -1); }

 private:
  int descriptor_;
};

/// One datagram and where it came from, or nothing when none is there.
std::optional<std::pair<std::vector<uint8_t>, in_addr>> receive(int socket) {
  std::vector<uint8_t> bytes(1024);
  sockaddr_in from{};
  socklen_t size = sizeof from;
  const ssize_t count = recvfrom(socket, bytes.data(), bytes.size(), 0, reinterpret_cast<sockaddr*>(&from), &size);
  if (count < 0) return std::nullopt;
  bytes.resize(static_cast<size_t>(count));
  return std::pair{std::move(bytes), from.sin_addr};
}

/// The own addresses of all networks that are up.
std::vector<in_addr> own_addresses() {
  ifaddrs* list = nullptr;
  if (getifaddrs(&list) != 0) return {};
  const std::unique_ptr<ifaddrs, void (*)(ifaddrs*)> owner(list, freeifaddrs);
  std::vector<in_addr> addresses;
  for (const ifaddrs* entry = list; entry != nullptr; entry = entry->ifa_next)
    if (entry->ifa_addr != nullptr && entry->ifa_addr->sa_family == AF_INET && (entry->ifa_flags & IFF_UP) != 0)
      addresses.push_back(reinterpret_cast<const sockaddr_in*>(entry->ifa_addr)->sin_addr);
  return addresses;
}

}  // namespace

std::optional<in_addr> resolve_host(const std::string& host) {
  addrinfo hints{};
  hints.ai_family = AF_INET;
  hints.ai_socktype = SOCK_DGRAM;
  addrinfo* found = nullptr;
  if (getaddrinfo(host.c_str(), nullptr, &hints, &found) != 0) return std::nullopt;
  const std::unique_ptr<addrinfo, void (*)(addrinfo*)> owner(found, freeaddrinfo);
  return reinterpret_cast<const sockaddr_in*>(found->ai_addr)->sin_addr;
}

std::string to_text(in_addr address) {
  std::array<char, INET_ADDRSTRLEN> text{};
  inet_ntop(AF_INET, &address, text.data(), text.size());
  return text.data();
}

Result<in_addr> own_address_towards(in_addr address) {
  const Socket socket;
  const sockaddr_in to = name_of(address, gvcp_port);
  sockaddr_in own{};
  socklen_t size = sizeof own;
  if (connect(socket.get(), generic(to), sizeof to) != 0 ||
      getsockname(socket.get(), reinterpret_cast<sockaddr*>(&own), &size) != 0)
    return Error{ErrorCode::io, "no network leads to " + to_text(address) + ": " + std::strerror(errno)};
  return own.sin_addr;
}

bool gvcp_answers(in_addr address, std::chrono::milliseconds patience) {
  const Socket socket;
  const sockaddr_in to = name_of(address, gvcp_port);
  constexpr int most_questions = 3;
  constexpr uint16_t first_request = 1;
  for (int i = 0; i < most_questions; ++i) {
    const auto question = header(acknowledge_asked, discovery_command, 0, static_cast<uint16_t>(first_request + i));
    if (sendto(socket.get(), question.data(), question.size(), 0, generic(to), sizeof to) < 0) return false;
    pollfd readable{socket.get(), POLLIN, 0};
    while (poll(&readable, 1, static_cast<int>(patience.count() / most_questions)) > 0) {
      const auto answer = receive(socket.get());
      if (!answer) break;
      if (answer->second.s_addr == address.s_addr && answer->first.size() >= header_size &&
          word_at(answer->first, 2) == discovery_acknowledge)
        return true;
    }
  }
  return false;
}

std::vector<uint8_t> action_command(const AravisActionSettings& settings, uint16_t request,
                                    std::optional<uint64_t> action_time) {
  constexpr uint16_t keys_size = 12, time_size = 8;
  std::vector<uint8_t> bytes = header(static_cast<uint8_t>(acknowledge_asked | (action_time ? is_scheduled : 0)),
                                      action_command_code, action_time ? keys_size + time_size : keys_size, request);
  append(bytes, settings.device_key, 4);
  append(bytes, settings.group_key, 4);
  append(bytes, settings.group_mask, 4);
  if (action_time) append(bytes, *action_time, time_size);
  return bytes;
}

std::optional<ActionAcknowledge> parse_action_acknowledge(const std::vector<uint8_t>& bytes, in_addr from,
                                                          uint16_t request) {
  if (bytes.size() < header_size || word_at(bytes, 2) != action_acknowledge_code || word_at(bytes, 6) != request)
    return std::nullopt;
  return ActionAcknowledge{from, word_at(bytes, 0)};
}

Result<ActionSender> ActionSender::create(const AravisActionSettings& settings) {
  ActionSender sender(settings);
  for (const std::string& destination : settings.destinations) {
    const auto to = resolve_host(destination);
    if (!to)
      return Error{ErrorCode::invalid_argument,
                   "action: destinations: \"" + destination + "\", expected an address or a known host"};
    if (to->s_addr != htonl(INADDR_BROADCAST)) {
      if (const auto added = sender.add_route(std::nullopt, *to); !added) return added.error();
      continue;
    }
    for (const in_addr& own : own_addresses())
      if (const auto added = sender.add_route(own, *to); !added) return added.error();
  }
  return sender;
}

ActionSender::ActionSender(ActionSender&& other) noexcept
    : settings_(std::move(other.settings_)), routes_(std::exchange(other.routes_, {})), request_(other.request_) {}

ActionSender::~ActionSender() {
  for (const Route& route : routes_) close(route.socket);
}

Result<void> ActionSender::add_route(std::optional<in_addr> from, in_addr to) {
  Socket socket;
  const int on = 1;
  setsockopt(socket.get(), SOL_SOCKET, SO_BROADCAST, &on, sizeof on);
  if (from) {
    const sockaddr_in own = name_of(*from, 0);
    if (bind(socket.get(), generic(own), sizeof own) != 0)
      return Error{ErrorCode::io, "action: no socket at " + to_text(*from) + ": " + std::strerror(errno)};
  }
  routes_.push_back({socket.release(), name_of(to, gvcp_port)});
  return {};
}

Result<void> ActionSender::send(std::optional<uint64_t> action_time) {
  if (++request_ == 0) request_ = 1;
  const auto command = action_command(settings_, request_, action_time);
  int last_error = 0;
  size_t sent = 0;
  for (const Route& route : routes_) {
    if (sendto(route.socket, command.data(), command.size(), 0, generic(route.to), sizeof route.to) >= 0)
      ++sent;
    else
      last_error = errno;
  }
  if (sent == 0)
    return Error{ErrorCode::io, std::string("the action command cannot be sent: ") + std::strerror(last_error)};
  return {};
}

std::vector<ActionAcknowledge> ActionSender::await(const std::vector<in_addr>& cameras,
                                                   std::chrono::milliseconds patience) const {
  const auto deadline = std::chrono::steady_clock::now() + patience;
  std::vector<ActionAcknowledge> answers;
  std::vector<pollfd> readable;
  for (const Route& route : routes_) readable.push_back({route.socket, POLLIN, 0});
  const auto has_answered = [&](const in_addr& address) {
    return std::any_of(answers.begin(), answers.end(),
                       [&](const ActionAcknowledge& answer) { return answer.from.s_addr == address.s_addr; });
  };
  while (!std::all_of(cameras.begin(), cameras.end(), has_answered)) {
    const auto left = std::chrono::ceil<std::chrono::milliseconds>(deadline - std::chrono::steady_clock::now());
    if (left.count() <= 0 || poll(readable.data(), readable.size(), static_cast<int>(left.count())) <= 0) break;
    for (const pollfd& ready : readable) {
      if (ready.revents == 0) continue;
      while (const auto datagram = receive(ready.fd)) {
        const auto answer = parse_action_acknowledge(datagram->first, datagram->second, request_);
        if (answer && !has_answered(answer->from)) answers.push_back(*answer);
      }
    }
  }
  return answers;
}

}  // namespace booth
