#include "drivers/v4l2/video_error.h"

#include <cerrno>
#include <cstring>

namespace booth {

bool is_gone(int error) { return error == ENODEV || error == ENXIO || error == ENOENT; }

Error system_error(const std::string& who, const std::string& what, int error) {
  const std::string begin = who + ": " + what + ": ";
  if (is_gone(error)) return {ErrorCode::device_lost, begin + "it is not plugged in"};
  if (error == EBUSY) return {ErrorCode::busy, begin + "another program uses it"};
  if (error == EACCES || error == EPERM)
    return {ErrorCode::io, begin + "not permitted; is this user in the group video?"};
  // A device that answers no more than this is as good as gone; opening it anew is what helps.
  if (error == EIO || error == EPIPE || error == EPROTO || error == ETIMEDOUT)
    return {ErrorCode::device_lost, begin + "it does not answer (" + std::strerror(error) + ")"};
  return {ErrorCode::io, begin + std::strerror(error)};
}

}  // namespace booth
