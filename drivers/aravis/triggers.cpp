#include "drivers/aravis/triggers.h"

#include <algorithm>
#include <barrier>
#include <chrono>
#include <condition_variable>
#include <cstdlib>
#include <mutex>
#include <optional>
#include <utility>

namespace booth {

namespace {

/// A camera that has not confirmed an order by then is not waited for.
constexpr std::chrono::milliseconds confirmation_patience{100};

}  // namespace

/// One firing: what its threads share.
struct SoftwareTrigger::Order {
  explicit Order(size_t cameras) : ready(static_cast<std::ptrdiff_t>(cameras) + 1), outcomes(cameras) {}
  std::barrier<> ready;
  mutable std::mutex mutex;
  std::condition_variable changed;
  std::vector<std::optional<Result<void>>> outcomes;  ///< guarded by mutex; nothing: not confirmed yet

  bool is_confirmed(size_t number) const {
    const std::lock_guard lock(mutex);
    return outcomes[number].has_value();
  }
};

Result<Timestamp> SoftwareTrigger::fire() {
  slow_.remove_if([](const Slow& one) { return one.order->is_confirmed(one.number); });
  auto cameras = cameras_();
  std::erase_if(cameras, [this](const std::shared_ptr<AravisCamera>& camera) {
    return std::any_of(slow_.begin(), slow_.end(), [&](const Slow& one) { return one.camera == camera; });
  });
  const auto order = std::make_shared<Order>(cameras.size());
  std::list<Slow> sent;
  for (size_t i = 0; i < cameras.size(); ++i)
    sent.push_back({cameras[i], order, i, std::jthread([order, camera = cameras[i], i] {
                      order->ready.arrive_and_wait();
                      auto fired = camera->fire_software();
                      const std::lock_guard lock(order->mutex);
                      order->outcomes[i] = std::move(fired);
                      order->changed.notify_all();
                    })});
  const Timestamp when = clock_.now();
  order->ready.arrive_and_wait();
  std::vector<std::optional<Result<void>>> outcomes;
  {
    std::unique_lock lock(order->mutex);
    order->changed.wait_for(lock, confirmation_patience, [&] {
      return std::all_of(order->outcomes.begin(), order->outcomes.end(),
                         [](const auto& one) { return one.has_value(); });
    });
    outcomes = order->outcomes;
  }
  std::optional<Error> refusal;
  size_t refused = 0;
  for (Slow& one : sent) {
    const auto& outcome = outcomes[one.number];
    if (!outcome) {
      if (warn_) warn_("camera " + one.camera->info().id + ": has not confirmed the order to expose");
      slow_.push_back(std::move(one));
    } else if (!*outcome) {
      ++refused;
      refusal = outcome->error();
      if (warn_) warn_(refusal->message);
    }
  }
  if (refused > 0 && refused == outcomes.size()) return Error{ErrorCode::device_lost, refusal->message};
  return when;
}

namespace {

/// Clocks that follow one PTP master are microseconds apart; they are compared over the network, which takes longer.
constexpr int64_t most_disagreement_ns = 2'000'000;

/// That instant on the clock that all cameras share. @error device_lost  they do not, or none can be read
Result<uint64_t> device_time_of(const std::vector<std::shared_ptr<AravisCamera>>& cameras, Timestamp when) {
  const AravisCamera* first = nullptr;
  int64_t time_ns = 0;
  for (const auto& camera : cameras) {
    const auto own = camera->device_time(when);
    if (!own) continue;
    if (first == nullptr) {
      first = camera.get();
      time_ns = *own;
    } else if (std::abs(*own - time_ns) >
               most_disagreement_ns + first->clock_uncertainty() + camera->clock_uncertainty()) {
      return Error{ErrorCode::device_lost, "action: schedule_ahead_us: the clocks of " + first->info().id + " and " +
                                               camera->info().id + " are " +
                                               std::to_string(std::abs(*own - time_ns) / milliseconds(1)) +
                                               " ms apart: they must follow one PTP master"};
    }
  }
  if (first == nullptr)
    return Error{ErrorCode::device_lost, "action: schedule_ahead_us: no camera's clock can be read to schedule by"};
  return static_cast<uint64_t>(time_ns);
}

}  // namespace

Result<Timestamp> ActionTrigger::fire() {
  const auto cameras = cameras_();
  Timestamp when = clock_.now();
  std::optional<uint64_t> action_time;
  if (settings_.schedule_ahead_us > 0) {
    constexpr Timestamp ns_per_us = 1000;
    when += ns_per_us * settings_.schedule_ahead_us;
    const auto scheduled = device_time_of(cameras, when);
    if (!scheduled) return scheduled.error();
    action_time = *scheduled;
  }
  if (const auto sent = sender_.send(action_time); !sent) return Error{ErrorCode::device_lost, sent.error().message};
  std::vector<in_addr> addresses;
  for (const auto& camera : cameras)
    if (camera->address()) addresses.push_back(*camera->address());
  const auto answers = sender_.await(addresses, std::chrono::milliseconds(settings_.acknowledge_timeout_ms));
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
