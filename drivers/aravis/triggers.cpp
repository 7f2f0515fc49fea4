#include "drivers/aravis/triggers.h"

#include <algorithm>
#include <barrier>
#include <chrono>
#include <optional>
#include <thread>

namespace booth {

Result<Timestamp> SoftwareTrigger::fire() {
  const auto cameras = cameras_();
  std::vector<std::optional<Error>> faults(cameras.size());
  std::barrier ready(static_cast<std::ptrdiff_t>(cameras.size()) + 1);
  std::vector<std::jthread> threads;
  threads.reserve(cameras.size());
  for (size_t i = 0; i < cameras.size(); ++i)
    threads.emplace_back([&, i] {
      ready.arrive_and_wait();
      if (const auto fired = cameras[i]->fire_software(); !fired) faults[i] = fired.error();
    });
  const Timestamp when = clock_.now();
  ready.arrive_and_wait();
  threads.clear();  // joins
  size_t failed = 0;
  for (const auto& fault : faults) {
    if (!fault) continue;
    ++failed;
    if (warn_) warn_(fault->message);
  }
  if (failed > 0 && failed == cameras.size()) return Error{ErrorCode::device_lost, faults.front()->message};
  return when;
}

Result<Timestamp> ActionTrigger::fire() {
  const auto cameras = cameras_();
  Timestamp when = clock_.now();
  std::optional<uint64_t> action_time;
  if (settings_.schedule_ahead_us > 0) {
    constexpr Timestamp ns_per_us = 1000;
    when += ns_per_us * settings_.schedule_ahead_us;
    for (const auto& camera : cameras)
      if (const auto time = camera->device_time(when); time && !action_time) action_time = static_cast<uint64_t>(*time);
    if (!action_time)
      return Error{ErrorCode::device_lost, "action: schedule_ahead_us: no camera's clock can be read to schedule by"};
  }
  if (const auto sent = sender_.send(action_time); !sent) return Error{ErrorCode::device_lost, sent.error().message};
  const auto answers =
      sender_.await(cameras.size(), std::chrono::milliseconds(cameras.empty() ? 0 : settings_.acknowledge_timeout_ms));
  size_t silent = 0;
  for (const auto& camera : cameras) {
    const auto answer = std::find_if(answers.begin(), answers.end(), [&](const ActionAcknowledge& one) {
      return camera->address() && one.from.s_addr == camera->address()->s_addr;
    });
    if (answer != answers.end()) continue;
    ++silent;
    if (warn_) warn_("camera " + camera->info().id + ": did not acknowledge the action command");
  }
  if (silent > 0 && silent == cameras.size())
    return Error{ErrorCode::device_lost, "no camera acknowledged the action command"};
  return when;
}

}  // namespace booth
