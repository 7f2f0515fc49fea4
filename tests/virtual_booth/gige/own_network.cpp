#include <arpa/inet.h>
#include <net/if.h>
#include <netinet/in.h>
#include <sched.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <cstring>
#include <fstream>

#include "tests/virtual_booth/gige/gige_camera.h"

namespace booth::virtual_booth {
namespace {

constexpr int first_camera = 11;  ///< last number of the first camera's address

std::string reason(const std::string& what) { return what + ": " + std::strerror(errno); }

/// Makes the interface (or its alias) carry that address, and sets it up.
bool set_address(int socket, const std::string& interface, const std::string& address) {
  ifreq request{};
  std::strncpy(request.ifr_name, interface.c_str(), IFNAMSIZ - 1);
  auto* name = reinterpret_cast<sockaddr_in*>(&request.ifr_addr);
  name->sin_family = AF_INET;
  name->sin_addr.s_addr = inet_addr(address.c_str());
  if (ioctl(socket, SIOCSIFADDR, &request) != 0) return false;
  if (ioctl(socket, SIOCGIFFLAGS, &request) != 0) return false;
  request.ifr_flags = static_cast<short>(request.ifr_flags | IFF_UP | IFF_RUNNING);
  return ioctl(socket, SIOCSIFFLAGS, &request) == 0;
}

}  // namespace

std::string camera_address(int number) { return "127.0.0." + std::to_string(first_camera + number); }

std::string enter_own_network(int addresses) {
  const uid_t user = geteuid();
  const gid_t group = getegid();
  if (unshare(CLONE_NEWNET) != 0) {
    // Without privileges of our own: those that a user namespace lends.
    if (unshare(CLONE_NEWUSER | CLONE_NEWNET) != 0) return reason("no network namespace for the virtual cameras");
    std::ofstream("/proc/self/setgroups") << "deny";
    std::ofstream("/proc/self/uid_map") << user << " " << user << " 1";
    std::ofstream("/proc/self/gid_map") << group << " " << group << " 1";
  }
  const int socket = ::socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
  if (socket < 0) return reason("no socket");
  bool fine = set_address(socket, "lo", "127.0.0.1");
  for (int i = 0; fine && i < addresses; ++i) fine = set_address(socket, "lo:" + std::to_string(i), camera_address(i));
  const std::string fault = fine ? "" : reason("the loopback interface cannot be given an address");
  close(socket);
  return fault;
}

}  // namespace booth::virtual_booth
