#include "daemon/serial_executor.h"

#include <pthread.h>
#include <spdlog/spdlog.h>

#include <chrono>
#include <exception>
#include <utility>

namespace booth {

SerialExecutor::SerialExecutor(std::string name, size_t capacity)
    : name_(std::move(name)), tasks_(capacity), thread_([this] { run(); }) {
  pthread_setname_np(thread_.native_handle(), name_.c_str());
}

SerialExecutor::~SerialExecutor() { tasks_.close(); }

bool SerialExecutor::post(std::function<void()> task) { return tasks_.try_push(std::move(task)); }

void SerialExecutor::run() {
  constexpr std::chrono::milliseconds between_pulses{500};
  while (!tasks_.finished()) {
    pulse_.beat();
    const auto task = tasks_.pop(between_pulses);
    if (!task) continue;
    try {
      (*task)();
    } catch (const std::exception& fault) {
      spdlog::error("{}: a task failed: {}", name_, fault.what());
    }
  }
}

}  // namespace booth
