#include "daemon/log.h"

#include <spdlog/sinks/base_sink.h>
#include <spdlog/sinks/stdout_color_sinks.h>
#include <spdlog/spdlog.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <syslog.h>
#include <systemd/sd-journal.h>
#include <unistd.h>

#include <cerrno>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <mutex>

#include "pipeline/types/rig.h"

namespace booth {
namespace {

int priority_of(spdlog::level::level_enum level) {
  switch (level) {
    case spdlog::level::critical: return LOG_CRIT;
    case spdlog::level::err: return LOG_ERR;
    case spdlog::level::warn: return LOG_WARNING;
    case spdlog::level::debug:
    case spdlog::level::trace: return LOG_DEBUG;
    default: return LOG_INFO;
  }
}

/// Hands entries to the journal with their fields; to standard error, where it does not take them.
class JournalSink final : public spdlog::sinks::base_sink<std::mutex> {
 protected:
  void sink_it_(const spdlog::details::log_msg& message) override {
    const std::string text(message.payload.data(), message.payload.size());
    const int priority = priority_of(message.level);
    std::vector<std::string> fields = journal_fields(priority, text);
    std::vector<iovec> pieces;
    for (std::string& field : fields) pieces.push_back({field.data(), field.size()});
    if (sd_journal_sendv(pieces.data(), static_cast<int>(pieces.size())) < 0)
      std::cerr << "<" << priority << ">" << text << std::endl;  // see sd-daemon(3)
  }
  void flush_() override {}
};

/// $JOURNAL_STREAM names the device and inode of the journal's stream.
bool is_journal(int descriptor) {
  const char* stream = std::getenv("JOURNAL_STREAM");
  struct stat status {};
  if (stream == nullptr || ::fstat(descriptor, &status) != 0) return false;
  return std::to_string(status.st_dev) + ":" + std::to_string(status.st_ino) == stream;
}

spdlog::level::level_enum spdlog_level(LogLevel level) {
  switch (level) {
    case LogLevel::error: return spdlog::level::err;
    case LogLevel::warning: return spdlog::level::warn;
    case LogLevel::info: return spdlog::level::info;
    case LogLevel::debug: return spdlog::level::debug;
  }
  return spdlog::level::info;
}

}  // namespace

std::vector<std::string> journal_fields(int priority, std::string_view message) {
  std::vector<std::string> fields{"MESSAGE=" + std::string(message), "PRIORITY=" + std::to_string(priority),
                                  "SYSLOG_IDENTIFIER=" + std::string(program_invocation_short_name)};
  const auto add_id = [&](std::string_view subject, const std::vector<std::string>& names) {
    if (!message.starts_with(subject)) return;
    const std::string id(message.substr(subject.size(), message.find(':') - subject.size()));
    if (!is_safe_id(id)) return;
    for (const std::string& name : names) fields.push_back(name + "=" + id);
  };
  add_id("capture ", {"BOOTH_CAPTURE"});
  add_id("job ", {"BOOTH_JOB", "BOOTH_CAPTURE"});  // a job has its capture's id
  return fields;
}

void set_up_log(LogLevel level) {
  std::shared_ptr<spdlog::logger> logger;
  if (is_journal(STDERR_FILENO)) {
    logger = std::make_shared<spdlog::logger>("booth", std::make_shared<JournalSink>());
  } else {
    logger = std::make_shared<spdlog::logger>("booth", std::make_shared<spdlog::sinks::stderr_color_sink_mt>());
    logger->set_pattern("%Y-%m-%dT%H:%M:%S.%e %^%-7l%$ %v");
  }
  logger->set_level(spdlog_level(level));
  spdlog::set_default_logger(std::move(logger));
}

}  // namespace booth
