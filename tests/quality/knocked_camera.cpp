#include "tests/quality/knocked_camera.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>

#include "pipeline/geometry/camera_model.h"

namespace booth::quality {
namespace {

/// The room of the synthetic recordings, measured in their pictures: metres, world frame.
const Eigen::Vector3d room_low(-2.46, 0.0, -2.46), room_high(2.46, 2.6, 2.46);

/// Where a ray from inside leaves the room.
Eigen::Vector3d meet_room(const Eigen::Vector3d& from, const Eigen::Vector3d& direction) {
  double nearest = std::numeric_limits<double>::infinity();
  for (int axis = 0; axis < 3; ++axis) {
    if (direction[axis] == 0) continue;
    nearest = std::min(nearest, ((direction[axis] > 0 ? room_high : room_low)[axis] - from[axis]) / direction[axis]);
  }
  return from + nearest * direction;
}

double sample(const Image& image, const Eigen::Vector2d& at, int channel) {
  const double x = std::clamp(at.x(), 0.0, image.width - 1.001), y = std::clamp(at.y(), 0.0, image.height - 1.001);
  const int i = static_cast<int>(x), j = static_cast<int>(y);
  const double a = x - i, b = y - j;
  return (1 - b) * ((1 - a) * image.at(i, j, channel) + a * image.at(i + 1, j, channel)) +
         b * ((1 - a) * image.at(i, j + 1, channel) + a * image.at(i + 1, j + 1, channel));
}

}  // namespace

KnockedCamera::KnockedCamera(const Rig& rig, const RigCamera& camera, const Frame& frame, const Silhouette& subject)
    : camera_(camera), frame_(frame), subject_(subject), middle_(rig.volume.center()) {
  for (int y = 0; y < frame.pixels->height; ++y)
    for (int x = 0; x < frame.pixels->width; ++x)
      rays_.push_back(unproject(camera.intrinsics, {x, y}).hnormalized().cast<float>());
}

KnockedCamera::View KnockedCamera::see(const Eigen::Isometry3d& motion) const {
  const Image& seen = *frame_.pixels;
  Image picture(seen.width, seen.height, seen.channels), subject(seen.width, seen.height, 1);
  const Eigen::Isometry3d world_from_camera = (motion * camera_.camera_from_world).inverse();
  const Eigen::Vector3d center = world_from_camera.translation();
  const Eigen::Vector3d facing = world_from_camera.linear().col(2);
  const double depth_m = facing.dot(middle_ - center);
  const Eigen::Vector2d nowhere(-1e3, -1e3);
  for (int y = 0; y < seen.height; ++y)
    for (int x = 0; x < seen.width; ++x) {
      const Eigen::Vector2f& ray =
          rays_[static_cast<size_t>(y) * static_cast<size_t>(seen.width) + static_cast<size_t>(x)];
      const Eigen::Vector3d direction = world_from_camera.linear() * ray.cast<double>().homogeneous();
      const Eigen::Vector2d near = project(camera_, center + depth_m * direction).value_or(nowhere);
      const double covered = sample(subject_.coverage, near, 0);
      subject.at(x, y) = static_cast<uint8_t>(std::lround(covered));
      const Eigen::Vector2d far = project(camera_, meet_room(center, direction)).value_or(nowhere);
      for (int c = 0; c < seen.channels; ++c)
        picture.at(x, y, c) = static_cast<uint8_t>(std::lround(sample(seen, covered > 0 ? near : far, c)));
    }
  View view{frame_, std::move(subject)};
  view.frame.pixels = std::make_shared<const Image>(std::move(picture));
  return view;
}

}  // namespace booth::quality
