#pragma once

#include <string>

#include "pipeline/types/result.h"

namespace booth {

/// Whether the errno says that the device is not there any more.
bool is_gone(int error);

/// `who: what: why`, with the code that the errno stands for: device_lost, busy, io (also: not permitted).
Error system_error(const std::string& who, const std::string& what, int error);

}  // namespace booth
