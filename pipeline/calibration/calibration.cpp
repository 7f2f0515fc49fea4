#include "pipeline/calibration/calibration.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <map>
#include <numbers>
#include <set>
#include <tuple>

#include "pipeline/calibration/board.h"
#include "pipeline/calibration/bundle_adjustment.h"
#include "pipeline/calibration/initial_solution.h"
#include "pipeline/calibration/pattern_registration.h"
#include "pipeline/calibration/world_frame.h"

namespace booth {
namespace {

/// Boards that face the same way to within this tell no focal length.
constexpr double parallel_rad = 5 * std::numbers::pi / 180;
/// IPPE and a homography need four corners; six tell a blunder.
constexpr size_t fewest_corners = 6;

std::string decimal(double value, int digits) {
  char text[64];
  std::snprintf(text, sizeof text, "%.*f", digits, value);
  return text;
}

double median(std::vector<double> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

Result<void> check_devices(const CalibrationInput& input) {
  std::set<std::string> ids;
  int projectors = 0;
  for (const CalibrationDevice& device : input.devices) {
    if (!is_safe_id(device.id) || !ids.insert(device.id).second)
      return Error{ErrorCode::invalid_argument, "device id \"" + device.id + "\" is not a unique, plain name"};
    if (device.width < 1 || device.height < 1)
      return Error{ErrorCode::invalid_argument, device.id + ": a picture of " + std::to_string(device.width) + " × " +
                                                    std::to_string(device.height) + " pixels"};
    if (device.projector && ++projectors > 1)
      return Error{ErrorCode::invalid_argument, device.id + ": a rig has one projector"};
  }
  return {};
}

/// Everything the solution is made from, in an order that does not depend on the input's.
struct Task {
  const CalibrationInput& input;
  std::vector<Eigen::Vector3d> on_board;
  std::vector<int> poses;         ///< with a usable view, ascending
  std::vector<DeviceView> views;  ///< usable ones, by device and pose
};

Result<void> check_view(const BoardView& view, const CalibrationDevice& device, size_t corners) {
  int previous = -1;
  for (const TargetCorner& corner : view.corners) {
    if (corner.id <= previous || static_cast<size_t>(corner.id) >= corners)
      return Error{ErrorCode::invalid_argument, view.camera + ": corner " + std::to_string(corner.id) + " of pose " +
                                                    std::to_string(view.pose) + " is not the board's, or twice there"};
    previous = corner.id;
    const bool inside = corner.pixel.x() > -device.width && corner.pixel.x() < 2 * device.width &&
                        corner.pixel.y() > -device.height && corner.pixel.y() < 2 * device.height;
    if (!inside || !(corner.covariance.determinant() > 0) || !corner.covariance.allFinite() ||
        !(corner.covariance(0, 0) > 0))
      return Error{ErrorCode::invalid_argument, view.camera + ": corner " + std::to_string(corner.id) + " of pose " +
                                                    std::to_string(view.pose) +
                                                    " lies outside the picture or has no covariance"};
  }
  return {};
}

/// Corners in a row leave the board free to turn about it.
bool spread_out(const BoardView& view, const std::vector<Eigen::Vector3d>& on_board, double square_m) {
  Eigen::Vector2d mean = Eigen::Vector2d::Zero();
  for (const TargetCorner& corner : view.corners) mean += on_board[static_cast<size_t>(corner.id)].head<2>();
  mean /= static_cast<double>(view.corners.size());
  Eigen::Matrix2d scatter = Eigen::Matrix2d::Zero();
  for (const TargetCorner& corner : view.corners) {
    const Eigen::Vector2d offset = on_board[static_cast<size_t>(corner.id)].head<2>() - mean;
    scatter += offset * offset.transpose() / static_cast<double>(view.corners.size());
  }
  constexpr double least_squares = 0.4;  // standard deviation across; two full rows have 0.5
  return Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d>(scatter).eigenvalues().minCoeff() >
         std::pow(least_squares * square_m, 2);
}

Result<Task> prepare(const CalibrationInput& input) {
  const CalibrationBoard& board = input.board;
  constexpr int fewest_squares = 3, most_squares = 100;
  if (std::min(board.squares_x, board.squares_y) < fewest_squares ||
      std::max(board.squares_x, board.squares_y) > most_squares || !(board.square_m > 0))
    return Error{ErrorCode::invalid_argument, "the board has no sensible number of squares, or no size"};
  if (const auto valid = check_devices(input); !valid) return valid.error();
  Task task{.input = input, .on_board = board_corners(board), .poses = {}, .views = {}};
  std::map<std::pair<int, int>, const BoardView*> ordered;
  for (const BoardView& view : input.views) {
    const auto device = std::find_if(input.devices.begin(), input.devices.end(),
                                     [&](const CalibrationDevice& known) { return known.id == view.camera; });
    if (device == input.devices.end())
      return Error{ErrorCode::invalid_argument, "a view is of " + view.camera + ", which is not to be calibrated"};
    if (const auto valid = check_view(view, *device, task.on_board.size()); !valid) return valid.error();
    if (view.corners.size() < fewest_corners || !spread_out(view, task.on_board, board.square_m)) continue;
    const int number = static_cast<int>(device - input.devices.begin());
    if (!ordered.emplace(std::pair{number, view.pose}, &view).second)
      return Error{ErrorCode::invalid_argument,
                   view.camera + ": two views of pose " + std::to_string(view.pose) + " of the board"};
  }
  std::set<int> poses;
  for (const auto& [key, view] : ordered) poses.insert(key.second);
  task.poses.assign(poses.begin(), poses.end());
  for (const auto& [key, view] : ordered) {
    const auto pose = std::lower_bound(task.poses.begin(), task.poses.end(), key.second);
    task.views.push_back({.device = key.first,
                          .pose = static_cast<int>(pose - task.poses.begin()),
                          .view = view,
                          .camera_from_board = {}});
  }
  return task;
}

std::string about_blurred(const CalibrationInput& input) {
  std::set<std::string> cameras;
  size_t pictures = 0;
  for (const BoardView& view : input.views)
    if (view.blurred) {
      cameras.insert(view.camera);
      ++pictures;
    }
  if (pictures == 0) return {};
  std::string names;
  for (const std::string& camera : cameras) names += (names.empty() ? "" : ", ") + camera;
  return std::to_string(pictures) + (pictures == 1 ? " picture" : " pictures") +
         " of the board could not be used because of blur (" + names +
         "): hold the board still while the picture is taken, and check the focus";
}

Result<void> check_poses(const Task& task, const CalibrationOptions& options) {
  if (task.poses.empty()) {
    const std::string blurred = about_blurred(task.input);
    return Error{ErrorCode::too_few_views,
                 blurred.empty() ? "no camera found the board: is it the board that is configured, and in the light?"
                                 : "no camera found the board sharp enough; " + blurred};
  }
  if (task.poses.size() == 1)
    return Error{ErrorCode::too_few_views,
                 "the board was seen in one place only: move and tilt it between the shots, and take more"};
  if (static_cast<int>(task.poses.size()) < options.fewest_poses)
    return Error{ErrorCode::too_few_views, "the board was seen in " + std::to_string(task.poses.size()) +
                                               " places only; at least " + std::to_string(options.fewest_poses) +
                                               " are needed, and ten are better"};
  return {};
}

std::vector<std::optional<DeviceStart>> start_devices(Task& task, const Work& work) {
  std::vector<std::optional<DeviceStart>> starts(task.input.devices.size());
  work.parallel_for(starts.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) {
      const CalibrationDevice& device = task.input.devices[i];
      std::vector<DeviceView*> own;
      for (DeviceView& view : task.views)
        if (view.device == static_cast<int>(i)) own.push_back(&view);
      if (own.empty()) continue;
      const Intrinsics* known = nullptr;
      if (task.input.previous) {
        const CalibratedView* before = task.input.previous->find(device.id);
        if (device.projector && task.input.previous->projector) before = &*task.input.previous->projector;
        if (before && before->intrinsics.width == device.width && before->intrinsics.height == device.height)
          known = &before->intrinsics;
      }
      starts[i] = start_device(device, own, task.on_board, known, work);
    }
  });
  return starts;
}

/// The largest angle between any two places of the board, and how far its places lie from one plane.
struct PoseSpread {
  double tilt_rad = 0;
  double off_plane_m = 0;
};

PoseSpread spread_of(const std::vector<Eigen::Isometry3d>& boards) {
  PoseSpread spread;
  const Eigen::Vector3d normal = boards.front().linear().col(2);
  for (const Eigen::Isometry3d& a : boards) {
    for (const Eigen::Isometry3d& b : boards)
      spread.tilt_rad =
          std::max(spread.tilt_rad, std::acos(std::clamp(a.linear().col(2).dot(b.linear().col(2)), -1.0, 1.0)));
    spread.off_plane_m =
        std::max(spread.off_plane_m, std::abs(normal.dot(a.translation() - boards.front().translation())));
  }
  return spread;
}

/// A bundle of the devices and poses that are connected, and which they are.
struct Connected {
  Bundle bundle;
  std::vector<int> devices;  ///< of the input
  std::vector<int> poses;    ///< of the task
};

void observe(Bundle& bundle, int device, int board, std::span<const TargetCorner> corners,
             const std::vector<Eigen::Vector3d>& on_board) {
  for (const TargetCorner& corner : corners)
    bundle.observations.push_back({.device = device,
                                   .board = board,
                                   .corner = corner.id,
                                   .p_board = on_board[static_cast<size_t>(corner.id)],
                                   .pixel = corner.pixel,
                                   .covariance = corner.covariance});
}

Connected connect(const Task& task, const std::vector<std::optional<DeviceStart>>& starts, const Chain& chain) {
  Connected connected;
  std::map<int, int> device_of, pose_of;
  for (size_t i = 0; i < starts.size(); ++i) {
    if (!chain.camera_from_world[i]) continue;
    if (static_cast<int>(i) == chain.root) connected.bundle.fixed_device = static_cast<int>(connected.devices.size());
    device_of[static_cast<int>(i)] = static_cast<int>(connected.devices.size());
    connected.devices.push_back(static_cast<int>(i));
    connected.bundle.intrinsics.push_back(starts[i]->intrinsics);
    connected.bundle.camera_from_world.push_back(*chain.camera_from_world[i]);
  }
  for (size_t i = 0; i < task.poses.size(); ++i) {
    if (!chain.world_from_board[i]) continue;
    pose_of[static_cast<int>(i)] = static_cast<int>(connected.poses.size());
    connected.poses.push_back(static_cast<int>(i));
    connected.bundle.world_from_board.push_back(*chain.world_from_board[i]);
  }
  for (const DeviceView& view : task.views)
    if (device_of.contains(view.device))
      observe(connected.bundle, device_of.at(view.device), pose_of.at(view.pose), view.view->corners, task.on_board);
  return connected;
}

/// A two-dimensional normal vector's standard deviation over the median of its length.
constexpr double sigma_of_median = 1 / 1.1774;

double normalised(const Bundle& bundle, const BundleObservation& observation) {
  const Eigen::Vector2d e = residual(bundle, observation);
  return e.allFinite() ? std::sqrt(e.dot(observation.covariance.inverse() * e)) : 1e9;
}

/// The residuals' standard deviation in units of their covariances, whatever the blunders among them.
double spread(const Bundle& bundle) {
  std::vector<double> lengths;
  for (const BundleObservation& observation : bundle.observations) lengths.push_back(normalised(bundle, observation));
  return std::max(1e-3, sigma_of_median * median(std::move(lengths)));
}

/// Scales the covariances of each view's corners to what their residuals show: a view at a grazing angle, or in bad
/// light, is worse than its pixels' noise alone tells.
void weigh_views(Bundle& bundle) {
  std::map<std::pair<int, int>, std::vector<BundleObservation*>> views;
  for (BundleObservation& observation : bundle.observations)
    views[{observation.device, observation.board}].push_back(&observation);
  for (auto& [key, view] : views) {
    std::vector<double> lengths;
    for (const BundleObservation* observation : view) lengths.push_back(normalised(bundle, *observation));
    // A view's own pose, and its share of the device's parameters, take up part of the residuals.
    constexpr double parameters = 12;
    const double residuals = 2.0 * static_cast<double>(view.size());
    if (residuals <= 2 * parameters) continue;
    const double sigma = sigma_of_median * median(std::move(lengths)) * std::sqrt(residuals / (residuals - parameters));
    for (BundleObservation* observation : view) observation->covariance *= std::max(1e-4, sigma * sigma);
  }
}

/// Adjusts until weights and blunders stay the same, and then without the blunders by plain least squares.
/// @param weigh  whether views are weighed by their residuals
/// @return the residuals' spread
Result<double> adjust_robustly(Bundle& bundle, bool weigh, const Work& work) {
  constexpr int most_passes = 5;
  constexpr double blunder = 5;  // standard deviations
  BundleOptions options;
  double scale = spread(bundle);
  for (int pass = 0; pass < most_passes; ++pass) {
    options.loss_scale = 3 * scale;
    if (const auto adjusted = adjust(bundle, options, work); !adjusted) return adjusted.error();
    if (weigh) weigh_views(bundle);
    scale = spread(bundle);
    bool changed = false;
    for (BundleObservation& observation : bundle.observations) {
      const bool outlier = normalised(bundle, observation) > blunder * scale;
      changed |= outlier != observation.outlier;
      observation.outlier = outlier;
    }
    if (!changed && pass > 1) break;
  }
  options.loss_scale = 0;
  if (const auto adjusted = adjust(bundle, options, work); !adjusted) return adjusted.error();
  return spread(bundle);
}

/// Plain least squares over all corners. @return the residuals' spread
Result<double> adjust_plainly(Bundle& bundle, const Work& work) {
  for (BundleObservation& observation : bundle.observations) {
    observation.outlier = false;
    observation.covariance = Eigen::Matrix2d::Identity();
  }
  const BundleOptions options{.priors = BundlePriors::none(), .loss_scale = 0};
  if (const auto adjusted = adjust(bundle, options, work); !adjusted) return adjusted.error();
  return spread(bundle);
}

/// Replaces the corners of every view that has a crop by those that the whole pattern gives.
/// @return how far corners moved, root mean square, pixels
double refine_corners(const Task& task, Connected& connected, std::map<std::pair<int, int>, double>& blur,
                      const Work& work) {
  const BoardPattern pattern(task.input.board);
  Bundle& bundle = connected.bundle;
  std::vector<const DeviceView*> views;
  for (const DeviceView& view : task.views)
    if (std::find(connected.devices.begin(), connected.devices.end(), view.device) != connected.devices.end())
      views.push_back(&view);
  std::vector<std::vector<TargetCorner>> corners(views.size());
  std::vector<double> blurs(views.size());
  const auto index_of = [](const std::vector<int>& list, int value) {
    return static_cast<int>(std::find(list.begin(), list.end(), value) - list.begin());
  };
  for (size_t i = 0; i < views.size(); ++i) {
    const auto found = blur.find({views[i]->device, views[i]->pose});
    constexpr double start_blur_px = 0.5;
    blurs[i] = found == blur.end() ? start_blur_px : found->second;
  }
  work.parallel_for(views.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) {
      const DeviceView& view = *views[i];
      const auto device = static_cast<size_t>(index_of(connected.devices, view.device));
      const auto pose = static_cast<size_t>(index_of(connected.poses, view.pose));
      if (!view.view->crop.empty())
        corners[i] = register_pattern(pattern, *view.view, bundle.intrinsics[device],
                                      bundle.camera_from_world[device] * bundle.world_from_board[pose], blurs[i]);
      // Where the pattern does not look as printed, the saddles remain.
      if (corners[i].size() < std::max(fewest_corners, view.view->corners.size() / 2)) corners[i] = view.view->corners;
    }
  });
  std::map<std::tuple<int, int, int>, Eigen::Vector2d> before;
  for (const BundleObservation& observation : bundle.observations)
    before[{observation.device, observation.board, observation.corner}] = observation.pixel;
  bundle.observations.clear();
  double moved = 0;
  size_t counted = 0;
  for (size_t i = 0; i < views.size(); ++i) {
    const int device = index_of(connected.devices, views[i]->device);
    const int pose = index_of(connected.poses, views[i]->pose);
    blur[{views[i]->device, views[i]->pose}] = blurs[i];
    observe(bundle, device, pose, corners[i], task.on_board);
    for (const TargetCorner& corner : corners[i]) {
      const auto found = before.find({device, pose, corner.id});
      if (found == before.end()) continue;
      moved += (found->second - corner.pixel).squaredNorm();
      ++counted;
    }
  }
  return counted > 0 ? std::sqrt(moved / static_cast<double>(counted)) : 0;
}

/// The rig in the bundle's own frame.
Rig rig_of(const Task& task, const Connected& connected) {
  Rig rig;
  rig.name = task.input.previous ? task.input.previous->name : "booth";
  rig.volume = task.input.previous
                   ? task.input.previous->volume
                   : Eigen::AlignedBox3d(Eigen::Vector3d(-0.9, 0.0, -0.6), Eigen::Vector3d(0.9, 2.2, 0.6));
  for (size_t i = 0; i < connected.devices.size(); ++i) {
    const CalibrationDevice& device = task.input.devices[static_cast<size_t>(connected.devices[i])];
    RigCamera camera;
    camera.id = device.id;
    camera.intrinsics = connected.bundle.intrinsics[i];
    camera.camera_from_world = connected.bundle.camera_from_world[i];
    camera.role = device.role;
    camera.mount_rotation_deg = device.mount_rotation_deg;
    if (device.projector)
      rig.projector = camera;
    else
      rig.cameras.push_back(camera);
  }
  return rig;
}

/// What places the rig in the world, and what is to be said about it.
struct Placement {
  Eigen::Isometry3d world_from_bundle = Eigen::Isometry3d::Identity();
  bool guessed = false;
  bool wrong_scale = false;
  std::vector<std::string> messages;
};

Placement place(const Task& task, const Connected& connected, const Rig& rig) {
  Placement placement;
  std::optional<RigAlignment> alignment;
  if (task.input.previous) alignment = align_rigs(rig, *task.input.previous);
  if (alignment && alignment->cameras >= 3) {
    // A new rig as a whole larger or smaller than the old one, with the same shape, was measured with another rule.
    constexpr double tolerance = 0.01;
    const double size = rig.volume.sizes().norm();
    const double factor = 1 / alignment->scale;
    if (std::abs(factor - 1) > tolerance && alignment->residual_m < 0.2 * std::abs(factor - 1) * size) {
      placement.wrong_scale = true;
      const double square_mm = 1000 * task.input.board.square_m;
      placement.messages.push_back(
          "compared with the previous calibration everything is " + decimal(100 * std::abs(factor - 1), 1) + " % " +
          (factor > 1 ? "larger" : "smaller") + ": measure the board's squares; they are said to be " +
          decimal(square_mm, 2) + " mm, and " + decimal(square_mm * alignment->scale, 2) + " mm would agree");
    }
  }
  if (task.input.floor_pose) {
    const auto pose = std::find(task.poses.begin(), task.poses.end(), *task.input.floor_pose);
    const auto place_of_pose = pose == task.poses.end() ? connected.poses.end()
                                                        : std::find(connected.poses.begin(), connected.poses.end(),
                                                                    static_cast<int>(pose - task.poses.begin()));
    if (place_of_pose != connected.poses.end()) {
      const auto board = static_cast<size_t>(place_of_pose - connected.poses.begin());
      placement.world_from_bundle =
          world_from_floor_board(task.input.board) * connected.bundle.world_from_board[board].inverse();
      return placement;
    }
    placement.messages.push_back("no camera saw the board on the floor");
  }
  if (alignment) {
    placement.world_from_bundle = alignment->target_from_source;
    return placement;
  }
  placement.guessed = true;
  placement.world_from_bundle = guess_world(rig);
  placement.messages.emplace_back(
      "floor and origin are guessed from how the cameras are mounted: take a shot of the board lying on the floor "
      "where "
      "the subject stands");
  return placement;
}

void move_world(Bundle& bundle, const Eigen::Isometry3d& to_from) {
  for (Eigen::Isometry3d& pose : bundle.camera_from_world) pose = pose * to_from.inverse();
  for (Eigen::Isometry3d& pose : bundle.world_from_board) pose = to_from * pose;
}

/// Why a device is not in the solution.
std::string why_unsolved(const Task& task, size_t device, bool started) {
  const std::string& id = task.input.devices[device].id;
  int seen = 0, blurred = 0;
  for (const DeviceView& view : task.views) seen += view.device == static_cast<int>(device) ? 1 : 0;
  for (const BoardView& view : task.input.views) blurred += view.camera == id && view.blurred ? 1 : 0;
  if (seen == 0 && blurred > 0)
    return id + ": every picture of the board is blurred; check the focus, and hold the board still";
  if (seen == 0) return id + ": never saw the board; show it to this camera, together with another one";
  if (!started) return id + ": its views of the board do not fit any lens; check that it is the configured board";
  return id + ": shares no pose of the board with the other cameras; show the board to it and to a neighbour at once";
}

/// The device's figures; `variance` scales the covariances of its corners to what the residuals show.
void rate(const CalibrationDevice& device, const Bundle& bundle, size_t number, const DeviceCovariance& covariance,
          const Task& task, const Connected& connected, DeviceQuality& quality) {
  quality.solved = true;
  double sum = 0;
  std::set<int> boards;
  for (const BundleObservation& observation : bundle.observations) {
    if (observation.device != static_cast<int>(number)) continue;
    const Eigen::Vector2d e = residual(bundle, observation);
    const int pose = task.poses[static_cast<size_t>(connected.poses[static_cast<size_t>(observation.board)])];
    quality.residuals.push_back({pose, observation.corner, observation.pixel, e, observation.outlier});
    boards.insert(observation.board);
    ++quality.corners;
    if (observation.outlier)
      ++quality.outliers;
    else
      sum += e.squaredNorm();
  }
  const int used = quality.corners - quality.outliers;
  quality.views = static_cast<int>(boards.size());
  quality.rms_px = used > 0 ? std::sqrt(sum / used) : 0;
  const auto largest = [](const auto& matrix) {
    return std::sqrt(
        std::max(0.0, Eigen::SelfAdjointEigenSolver<std::decay_t<decltype(matrix)>>(matrix).eigenvalues().maxCoeff()));
  };
  quality.pose = {.center_m = largest(covariance.center), .rotation_rad = largest(covariance.rotation)};
  const Eigen::Vector2d mean(0.5, 0.5);
  const Eigen::Matrix2d focal = covariance.pinhole.topLeftCorner<2, 2>();
  quality.focal_sigma_px = std::sqrt(std::max(0.0, mean.dot(focal * mean)));
  const Eigen::Matrix2d middle = covariance.pinhole.bottomRightCorner<2, 2>();
  quality.principal_point_sigma_px = largest(middle);

  const double focal_px = bundle.intrinsics[number].fx;
  constexpr double loose_focal = 0.005;
  if (quality.focal_sigma_px > loose_focal * focal_px)
    quality.messages.push_back(device.id + ": its focal length is uncertain by " +
                               decimal(100 * quality.focal_sigma_px / focal_px, 1) +
                               " %; show it the board nearer, and tilted to the sides");
  constexpr double many_outliers = 0.2;
  if (quality.outliers > many_outliers * quality.corners)
    quality.messages.push_back(device.id + ": " + std::to_string(quality.outliers) + " of " +
                               std::to_string(quality.corners) +
                               " corners do not fit; did the board, or the camera, move during the shots?");
  constexpr int few_views = 3;
  if (quality.views < few_views)
    quality.messages.push_back(device.id + ": saw the board in " + std::to_string(quality.views) +
                               (quality.views == 1 ? " pose only; show it more" : " poses only; show it more"));
}

void judge(const Calibration& solved, const Placement& placement, const CalibrationOptions& options,
           CalibrationVerdict& verdict, std::string& reason) {
  const DeviceQuality* worst_rms = nullptr;
  const DeviceQuality* worst_pose = nullptr;
  for (const DeviceQuality& device : solved.devices) {
    if (!device.solved) {
      verdict = CalibrationVerdict::bad;
      reason = device.messages.front();
      return;
    }
    if (!worst_rms || device.rms_px > worst_rms->rms_px) worst_rms = &device;
    if (!worst_pose || device.pose.center_m > worst_pose->pose.center_m) worst_pose = &device;
  }
  const std::string rms_text = worst_rms->id + " is off by " + decimal(worst_rms->rms_px, 2) + " px";
  const std::string pose_text =
      worst_pose->id + " is placed to within " + decimal(1000 * worst_pose->pose.center_m, 1) + " mm";
  verdict = CalibrationVerdict::bad;
  if (placement.wrong_scale) {
    reason = placement.messages.front();
  } else if (worst_rms->rms_px > options.usable_rms_px) {
    reason = rms_text + ", more than " + decimal(options.usable_rms_px, 2);
  } else if (worst_pose->pose.center_m > options.usable_center_m) {
    reason = pose_text + " only; take more shots of the board";
  } else {
    verdict = CalibrationVerdict::usable;
    if (worst_rms->rms_px > options.good_rms_px)
      reason = rms_text + "; good is up to " + decimal(options.good_rms_px, 2);
    else if (worst_pose->pose.center_m > options.good_center_m)
      reason = pose_text + "; good is up to " + decimal(1000 * options.good_center_m, 1) +
               " mm: take more shots of the board";
    else if (placement.guessed)
      reason = placement.messages.back();
    else {
      verdict = CalibrationVerdict::good;
      reason =
          "no camera is off by more than " + decimal(worst_rms->rms_px, 2) + " px, and the least certain, " + pose_text;
    }
  }
}

}  // namespace

std::vector<CalibrationDevice> calibration_devices(const Rig& rig) {
  std::vector<CalibrationDevice> devices;
  for (const RigCamera& camera : rig.cameras)
    devices.push_back({.id = camera.id,
                       .width = camera.intrinsics.width,
                       .height = camera.intrinsics.height,
                       .role = camera.role,
                       .mount_rotation_deg = camera.mount_rotation_deg});
  if (rig.projector)
    devices.push_back({.id = rig.projector->id,
                       .width = rig.projector->intrinsics.width,
                       .height = rig.projector->intrinsics.height,
                       .projector = true});
  return devices;
}

std::string_view to_string(CalibrationVerdict verdict) {
  switch (verdict) {
    case CalibrationVerdict::good: return "good";
    case CalibrationVerdict::usable: return "usable";
    case CalibrationVerdict::bad: return "bad";
  }
  return "bad";
}

Result<Calibration> solve_calibration(const CalibrationInput& input, const CalibrationOptions& options,
                                      const Work& work) {
  auto prepared = prepare(input);
  if (!prepared) return prepared.error();
  Task& task = *prepared;
  if (const auto enough = check_poses(task, options); !enough) return enough.error();

  const auto starts = start_devices(task, work);
  if (work.stopped()) return Work::cancelled();
  double tilt_rad = 0;
  bool any = false;
  for (const auto& start : starts) {
    any |= start.has_value();
    if (start) tilt_rad = std::max(tilt_rad, start->tilt_rad);
  }
  if (!any)
    return Error{ErrorCode::too_few_views, "the views of the board fit no lens: is it the board that is configured?"};
  const Chain chain = chain_devices(starts, task.views, task.poses.size(), task.on_board);
  Connected connected = connect(task, starts, chain);
  Bundle& bundle = connected.bundle;
  const PoseSpread poses = spread_of(bundle.world_from_board);
  if (std::max(tilt_rad, poses.tilt_rad) < parallel_rad) {
    const bool one_plane = poses.off_plane_m < 0.5 * input.board.square_m;
    return Error{ErrorCode::too_few_views,
                 one_plane
                     ? "the board lay in the same plane in all shots: hold it up, and tilt it differently each time"
                     : "the board faced the same way in all shots: tilt it differently each time"};
  }
  work.report(0.3);

  auto scale = adjust_robustly(bundle, false, work);
  if (!scale) return scale.error();
  work.report(0.5);
  if (options.refine_corners && check(input.board)) {
    constexpr int most_rounds = 4;
    constexpr double settled_px = 0.003;
    std::map<std::pair<int, int>, double> blur;
    for (int round = 0; round < most_rounds; ++round) {
      if (work.stopped()) return Work::cancelled();
      const double moved_px = refine_corners(task, connected, blur, work);
      scale = adjust_robustly(bundle, true, work);
      if (!scale) return scale.error();
      work.report(0.5 + 0.1 * (round + 1));
      if (round > 0 && moved_px < settled_px) break;
    }
  }

  if (options.plain_least_squares) {
    scale = adjust_plainly(bundle, work);
    if (!scale) return scale.error();
  }

  const Placement placement = place(task, connected, rig_of(task, connected));
  move_world(bundle, placement.world_from_bundle);
  const auto covariances =
      device_covariances(bundle, options.plain_least_squares ? BundlePriors::none() : BundlePriors{}, *scale * *scale);

  Calibration solved;
  solved.rig = rig_of(task, connected);
  for (const int pose : connected.poses) solved.poses.push_back(task.poses[static_cast<size_t>(pose)]);
  solved.world_from_board = bundle.world_from_board;
  double sum = 0;
  int used = 0;
  for (size_t i = 0; i < input.devices.size(); ++i) {
    DeviceQuality quality;
    quality.id = input.devices[i].id;
    const auto found = std::find(connected.devices.begin(), connected.devices.end(), static_cast<int>(i));
    if (found == connected.devices.end()) {
      quality.messages.push_back(why_unsolved(task, i, starts[i].has_value()));
    } else if (!covariances) {
      return covariances.error();
    } else {
      const auto number = static_cast<size_t>(found - connected.devices.begin());
      rate(input.devices[i], bundle, number, (*covariances)[number], task, connected, quality);
      const int inliers = quality.corners - quality.outliers;
      sum += quality.rms_px * quality.rms_px * inliers;
      used += inliers;
    }
    solved.devices.push_back(std::move(quality));
  }
  solved.rms_px = used > 0 ? std::sqrt(sum / used) : 0;
  for (RigCamera& camera : solved.rig.cameras)
    for (const DeviceQuality& quality : solved.devices)
      if (quality.id == camera.id) {
        camera.rms_px = quality.rms_px;
        camera.uncertainty = quality.pose;
      }
  judge(solved, placement, options, solved.verdict, solved.reason);
  if (!input.whites.empty()) {
    std::vector<std::string> cameras;
    for (const RigCamera& camera : solved.rig.cameras) cameras.push_back(camera.id);
    solved.colours = match_colours(cameras, input.whites);
    for (size_t i = 0; i < cameras.size(); ++i) solved.rig.cameras[i].colour_gain = solved.colours.cameras[i].gain;
  }

  solved.messages = placement.messages;
  for (const DeviceQuality& quality : solved.devices)
    solved.messages.insert(solved.messages.end(), quality.messages.begin(), quality.messages.end());
  if (const std::string blurred = about_blurred(input); !blurred.empty()) solved.messages.push_back(blurred);
  solved.messages.insert(solved.messages.end(), solved.colours.messages.begin(), solved.colours.messages.end());
  work.report(1);
  return solved;
}

}  // namespace booth
