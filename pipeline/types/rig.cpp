#include "pipeline/types/rig.h"

#include <algorithm>
#include <cmath>
#include <set>

namespace booth {
namespace {

Error invalid(const std::string& owner, const std::string& what) {
  return {ErrorCode::invalid_argument, owner + ": " + what};
}

Result<void> check_view(const CalibratedView& view, const std::string& owner) {
  const Intrinsics& k = view.intrinsics;
  constexpr int largest_side = 32768;
  if (!is_safe_id(view.id)) return invalid(owner, "id \"" + view.id + "\" is not a plain name");
  if (k.width < 1 || k.height < 1 || k.width > largest_side || k.height > largest_side)
    return invalid(owner, "width and height must be 1 … 32768 pixels");
  for (const double number : {k.fx, k.fy, k.cx, k.cy, k.skew})
    if (!std::isfinite(number)) return invalid(owner, "K holds a number that is not finite");
  if (k.fx <= 0 || k.fy <= 0) return invalid(owner, "K needs positive focal lengths");
  for (const double number : k.distortion)
    if (!std::isfinite(number)) return invalid(owner, "distortion holds a number that is not finite");
  if (!view.camera_from_world.matrix().allFinite()) return invalid(owner, "R or t holds a number that is not finite");
  const Eigen::Matrix3d rotation = view.camera_from_world.linear();
  constexpr double tolerance = 1e-4;  // calibration files carry rounded decimals
  if (!(rotation * rotation.transpose()).isApprox(Eigen::Matrix3d::Identity(), tolerance) || rotation.determinant() < 0)
    return invalid(owner, "R is not a rotation");
  return {};
}

}  // namespace

const RigCamera* Rig::find(const std::string& id) const {
  const auto found = std::find_if(cameras.begin(), cameras.end(), [&](const RigCamera& c) { return c.id == id; });
  return found == cameras.end() ? nullptr : &*found;
}

Result<void> check(const Rig& rig) {
  if (rig.cameras.empty()) return invalid("cameras", "the rig has none");
  if (!rig.volume.min().allFinite() || !rig.volume.max().allFinite() || (rig.volume.sizes().array() <= 0).any())
    return invalid("volume", "min must lie below max in every axis");
  std::set<std::string> ids;
  for (size_t i = 0; i < rig.cameras.size(); ++i) {
    const RigCamera& camera = rig.cameras[i];
    const std::string owner = "cameras[" + std::to_string(i) + "]";
    if (const auto checked = check_view(camera, owner); !checked) return checked;
    if (!ids.insert(camera.id).second) return invalid(owner, "id \"" + camera.id + "\" occurs twice");
    const int turn = camera.mount_rotation_deg;
    if (turn != 0 && turn != 90 && turn != 180 && turn != 270)
      return invalid(owner, "mount_rotation_deg must be 0, 90, 180 or 270");
    // Compared as floats: the least one is no binary number.
    if (!(camera.colour_gain >= static_cast<float>(least_colour_gain)).all() ||
        !(camera.colour_gain <= static_cast<float>(most_colour_gain)).all())
      return invalid(owner, "colour_gain must hold 3 numbers within 0.1 … 10");
  }
  if (rig.projector) return check_view(*rig.projector, "projector");
  return {};
}

bool is_safe_id(const std::string& id) {
  if (id.empty() || id.size() > 64 || id.front() == '.') return false;
  return std::all_of(id.begin(), id.end(), [](unsigned char c) {
    return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '-' || c == '_' ||
           c == '.';
  });
}

}  // namespace booth
