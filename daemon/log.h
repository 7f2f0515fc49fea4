#pragma once

#include <string>
#include <string_view>
#include <vector>

#include "config/booth_config.h"

namespace booth {

/// Sends the default logger to standard error. Where that is the journal, entries go to it with their fields; else they
/// are lines with the time, and colours on a terminal.
void set_up_log(LogLevel level);

/// The fields of a journal's entry, each "NAME=value", see systemd.journal-fields(7): the message, its priority, and
/// where it is about a capture or a job, "capture ID: …" or "job ID: …", BOOTH_CAPTURE and BOOTH_JOB.
/// @param priority  syslog's, 0 … 7
std::vector<std::string> journal_fields(int priority, std::string_view message);

}  // namespace booth
