#include "daemon/combined_source.h"

#include <set>
#include <utility>

namespace booth {
namespace {

class FollowedTrigger final : public Trigger {
 public:
  FollowedTrigger(std::unique_ptr<Trigger> first, std::unique_ptr<Trigger> second)
      : first_(std::move(first)), second_(std::move(second)) {}
  const std::string& driver() const override { return first_->driver(); }
  void prepare(ShotRole role) noexcept override {
    first_->prepare(role);
    second_->prepare(role);
  }
  Result<Timestamp> fire() override {
    const auto fired = first_->fire();
    if (!fired) return fired;
    if (const auto followed = second_->fire(); !followed) return followed;
    return fired;
  }

 private:
  const std::unique_ptr<Trigger> first_, second_;
};

class FollowedProjector final : public Projector {
 public:
  FollowedProjector(std::unique_ptr<Projector> first, std::unique_ptr<Projector> second)
      : first_(std::move(first)), second_(std::move(second)) {}
  const ProjectorInfo& info() const override { return first_->info(); }
  Result<void> show(int index) override {
    if (const auto shown = first_->show(index); !shown) return shown;
    return second_->show(index);
  }
  void dark() noexcept override {
    first_->dark();
    second_->dark();
  }

 private:
  const std::unique_ptr<Projector> first_, second_;
};

}  // namespace

Result<std::vector<CameraInfo>> CombinedSource::discover() {
  std::set<std::shared_ptr<DeviceSource>> sources;
  for (const auto& [id, source] : parts_.cameras) sources.insert(source);
  std::vector<CameraInfo> found;
  for (const auto& source : sources) {
    auto seen = source->discover();
    if (!seen) return seen;
    found.insert(found.end(), seen->begin(), seen->end());
  }
  return found;
}

Result<std::unique_ptr<Camera>> CombinedSource::open_camera(const std::string& id) {
  const auto found = parts_.cameras.find(id);
  if (found == parts_.cameras.end()) return Error{ErrorCode::not_found, "there is no camera " + id};
  return found->second->open_camera(id);
}

Result<std::unique_ptr<Trigger>> CombinedSource::open_trigger() {
  auto first = parts_.trigger();
  if (!first || parts_.trigger_follower == nullptr) return first;
  auto second = parts_.trigger_follower->open_trigger();
  if (!second) return second;
  return std::unique_ptr<Trigger>(std::make_unique<FollowedTrigger>(*std::move(first), *std::move(second)));
}

Result<std::unique_ptr<Projector>> CombinedSource::open_projector() {
  if (!parts_.projector) return Error{ErrorCode::unsupported, "this booth has no projector"};
  auto first = parts_.projector();
  if (!first || parts_.projector_follower == nullptr) return first;
  auto second = parts_.projector_follower->open_projector();
  // A recording without a projector has no patterns that could follow.
  if (!second) return second.error().code == ErrorCode::unsupported ? std::move(first) : std::move(second);
  return std::unique_ptr<Projector>(std::make_unique<FollowedProjector>(*std::move(first), *std::move(second)));
}

}  // namespace booth
