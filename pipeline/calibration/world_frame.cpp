#include "pipeline/calibration/world_frame.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <numbers>
#include <vector>

namespace booth {
namespace {

/// A camera as four points: its centre and a step along each of its axes, so that few cameras, or cameras in a row,
/// still fix a rigid motion.
Eigen::Matrix<double, 3, 4> frame_points(const CalibratedView& view, double step_m) {
  Eigen::Matrix<double, 3, 4> points;
  points.col(0) = view.center();
  points.rightCols<3>() = (step_m * view.camera_from_world.linear().transpose()).colwise() + view.center();
  return points;
}

struct Pair {
  const CalibratedView* source;
  const CalibratedView* target;
};

Eigen::Isometry3d rigid_motion(const std::vector<Pair>& pairs) {
  constexpr double step_m = 1;  // a turn of a camera counts as its centre's move by as many metres a radian
  Eigen::Matrix3Xd from(3, 4 * static_cast<Eigen::Index>(pairs.size())), to(from);
  for (size_t i = 0; i < pairs.size(); ++i) {
    from.middleCols<4>(static_cast<Eigen::Index>(4 * i)) = frame_points(*pairs[i].source, step_m);
    to.middleCols<4>(static_cast<Eigen::Index>(4 * i)) = frame_points(*pairs[i].target, step_m);
  }
  return Eigen::Isometry3d(Eigen::umeyama(from, to, false));
}

double distance_after(const Eigen::Isometry3d& motion, const Pair& pair) {
  const Eigen::AngleAxisd turn(pair.target->camera_from_world.linear() * motion.linear() *
                               pair.source->camera_from_world.linear().transpose());
  return std::hypot((motion * pair.source->center() - pair.target->center()).norm(), turn.angle());
}

}  // namespace

Eigen::Isometry3d world_from_floor_board(const CalibrationBoard& board) {
  Eigen::Isometry3d world_from_board = Eigen::Isometry3d::Identity();
  world_from_board.linear().col(0) = Eigen::Vector3d::UnitX();
  world_from_board.linear().col(1) = Eigen::Vector3d::UnitZ();
  world_from_board.linear().col(2) = -Eigen::Vector3d::UnitY();
  const Eigen::Vector3d middle(0.5 * board.squares_x * board.square_m, 0.5 * board.squares_y * board.square_m, 0);
  world_from_board.translation() = -(world_from_board.linear() * middle);
  return world_from_board;
}

std::optional<RigAlignment> align_rigs(const Rig& source, const Rig& target) {
  std::vector<Pair> pairs;
  for (const RigCamera& camera : source.cameras)
    if (const RigCamera* other = target.find(camera.id)) pairs.push_back({&camera, other});
  if (pairs.empty()) return std::nullopt;
  // Cameras are dropped while they are far off compared with the others; most have stayed where they were.
  std::vector<Pair> kept = pairs;
  RigAlignment alignment;
  for (int pass = 0; pass < 10; ++pass) {
    alignment.target_from_source = rigid_motion(kept);
    std::vector<double> distances;
    for (const Pair& pair : pairs) distances.push_back(distance_after(alignment.target_from_source, pair));
    std::vector<double> sorted = distances;
    std::sort(sorted.begin(), sorted.end());
    constexpr double stayed = 0.005;  // metres or radians that a camera may be off and still count as unmoved
    const double limit = std::max(stayed, 3 * sorted[sorted.size() / 2]);
    std::vector<Pair> next;
    for (size_t i = 0; i < pairs.size(); ++i)
      if (distances[i] <= limit) next.push_back(pairs[i]);
    const bool settled = next.size() == kept.size();
    kept = std::move(next);
    if (settled) break;
  }
  alignment.cameras = static_cast<int>(kept.size());
  if (kept.size() >= 3) {
    Eigen::Matrix3Xd from(3, static_cast<Eigen::Index>(kept.size())), to(from);
    for (size_t i = 0; i < kept.size(); ++i) {
      from.col(static_cast<Eigen::Index>(i)) = kept[i].source->center();
      to.col(static_cast<Eigen::Index>(i)) = kept[i].target->center();
    }
    const Eigen::Matrix4d similarity = Eigen::umeyama(from, to, true);
    alignment.scale = std::cbrt(similarity.topLeftCorner<3, 3>().determinant());
    const Eigen::Matrix3Xd moved =
        (similarity.topLeftCorner<3, 3>() * from).colwise() + similarity.topRightCorner<3, 1>().eval();
    alignment.residual_m = std::sqrt((moved - to).squaredNorm() / static_cast<double>(kept.size()));
  }
  return alignment;
}

Eigen::Isometry3d guess_world(const Rig& source) {
  // Upwards in the stored image turns with the mount.
  Eigen::Vector3d up = Eigen::Vector3d::Zero(), front = Eigen::Vector3d::Zero();
  Eigen::Matrix3d across = Eigen::Matrix3d::Zero();
  Eigen::Vector3d target = Eigen::Vector3d::Zero();
  const bool faces = std::any_of(source.cameras.begin(), source.cameras.end(),
                                 [](const RigCamera& camera) { return camera.role == CameraRole::face; });
  for (const RigCamera& camera : source.cameras) {
    const Eigen::Matrix3d world_from_camera = camera.camera_from_world.linear().transpose();
    // Turning the stored image clockwise by the angle makes it upright: its upward direction before is turned back.
    const double angle = camera.mount_rotation_deg * std::numbers::pi / 180;
    up += world_from_camera * Eigen::Vector3d(-std::sin(angle), -std::cos(angle), 0);
    const Eigen::Vector3d axis = world_from_camera.col(2);
    const Eigen::Matrix3d beside = Eigen::Matrix3d::Identity() - axis * axis.transpose();
    across += beside;
    target += beside * camera.center();
  }
  constexpr double ridge = 1e-6;  // parallel axes meet nowhere
  const Eigen::Vector3d middle = (across + ridge * Eigen::Matrix3d::Identity()).ldlt().solve(target);
  for (const RigCamera& camera : source.cameras)
    if (!faces || camera.role == CameraRole::face) {
      front += camera.center() - middle;
      if (!faces) break;  // a ring of cameras has no middle direction: the first stands in front
    }
  Eigen::Isometry3d world_from_source = Eigen::Isometry3d::Identity();
  const Eigen::Vector3d y = up.norm() > ridge ? up.normalized() : Eigen::Vector3d::UnitY();
  Eigen::Vector3d z = front - front.dot(y) * y;
  if (z.norm() < ridge) z = y.unitOrthogonal();
  z.normalize();
  world_from_source.linear().row(0) = y.cross(z).transpose();
  world_from_source.linear().row(1) = y.transpose();
  world_from_source.linear().row(2) = z.transpose();
  constexpr double middle_of_a_person_m = 1.0;
  world_from_source.translation() = Eigen::Vector3d(0, middle_of_a_person_m, 0) - world_from_source.linear() * middle;
  return world_from_source;
}

}  // namespace booth
