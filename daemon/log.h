#pragma once

#include "config/booth_config.h"

namespace booth {

/// Sends the default logger to standard error. Where that is the journal, lines carry their priority for it and no
/// time, which it adds itself; else they carry the time, and colours on a terminal.
void set_up_log(LogLevel level);

}  // namespace booth
