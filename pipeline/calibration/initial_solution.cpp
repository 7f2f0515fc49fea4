#include "pipeline/calibration/initial_solution.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <numeric>
#include <opencv2/calib3d.hpp>
#include <set>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

struct Points {
  std::vector<cv::Point3f> board;
  std::vector<cv::Point2f> pixel;
};

Points points_of(const BoardView& view, const std::vector<Eigen::Vector3d>& on_board) {
  Points points;
  for (const TargetCorner& corner : view.corners) {
    const Eigen::Vector3d& p = on_board[static_cast<size_t>(corner.id)];
    points.board.emplace_back(static_cast<float>(p.x()), static_cast<float>(p.y()), 0.0F);
    points.pixel.emplace_back(static_cast<float>(corner.pixel.x()), static_cast<float>(corner.pixel.y()));
  }
  return points;
}

/// The board's poses that may explain a view, the likelier first.
std::vector<Eigen::Isometry3d> plane_poses(const Points& points, const Intrinsics& k) {
  const cv::Matx33d camera(k.fx, 0, k.cx, 0, k.fy, k.cy, 0, 0, 1);
  std::vector<cv::Mat> rotations, translations;
  cv::solvePnPGeneric(points.board, points.pixel, camera, k.distortion, rotations, translations, false,
                      cv::SOLVEPNP_IPPE);
  std::vector<Eigen::Isometry3d> poses;
  for (size_t i = 0; i < rotations.size(); ++i) {
    cv::Matx33d rotation;
    cv::Rodrigues(rotations[i], rotation);
    Eigen::Isometry3d pose = Eigen::Isometry3d::Identity();
    for (int row = 0; row < 3; ++row) {
      for (int column = 0; column < 3; ++column) pose.linear()(row, column) = rotation(row, column);
      pose.translation()[row] = translations[i].at<double>(row);
    }
    if (pose.matrix().allFinite()) poses.push_back(pose);
  }
  return poses;
}

/// Mean of squared distances between a view's corners and where a pose puts them, each capped.
double misfit(const BoardView& view, const std::vector<Eigen::Vector3d>& on_board, const Intrinsics& k,
              const Eigen::Isometry3d& camera_from_board) {
  constexpr double cap_px2 = 400;
  double sum = 0;
  for (const TargetCorner& corner : view.corners) {
    const auto pixel = project_camera_point(k, camera_from_board * on_board[static_cast<size_t>(corner.id)]);
    sum += pixel ? std::min(cap_px2, (*pixel - corner.pixel).squaredNorm()) : cap_px2;
  }
  return sum / static_cast<double>(view.corners.size());
}

double focal_from_homographies(const std::vector<Points>& views, const CalibrationDevice& device) {
  std::vector<std::vector<cv::Point3f>> board;
  std::vector<std::vector<cv::Point2f>> pixel;
  for (const Points& points : views) {
    board.push_back(points.board);
    pixel.push_back(points.pixel);
  }
  const cv::Mat k = cv::initCameraMatrix2D(board, pixel, {device.width, device.height}, 1.0);
  return k.at<double>(0, 0);
}

/// The views of one device as a bundle of their own, its camera in the origin.
Bundle own_bundle(const Intrinsics& k, std::span<DeviceView*> views, const std::vector<Eigen::Vector3d>& on_board) {
  Bundle bundle;
  bundle.intrinsics = {k};
  bundle.camera_from_world = {Eigen::Isometry3d::Identity()};
  // Blunders among the corners are not known yet: all count alike, within a pixel.
  constexpr double sigma_px = 0.3;
  for (const DeviceView* view : views) {
    const int board = static_cast<int>(bundle.world_from_board.size());
    bundle.world_from_board.push_back(view->camera_from_board.front());
    for (const TargetCorner& corner : view->view->corners)
      bundle.observations.push_back({.device = 0,
                                     .board = board,
                                     .corner = corner.id,
                                     .p_board = on_board[static_cast<size_t>(corner.id)],
                                     .pixel = corner.pixel,
                                     .covariance = sigma_px * sigma_px * Eigen::Matrix2d::Identity()});
  }
  return bundle;
}

double root_mean_square(const Bundle& bundle) {
  double sum = 0;
  for (const BundleObservation& observation : bundle.observations) {
    const double squared = residual(bundle, observation).squaredNorm();
    constexpr double cap_px2 = 400;
    sum += std::isfinite(squared) ? std::min(squared, cap_px2) : cap_px2;
  }
  return std::sqrt(sum / static_cast<double>(bundle.observations.size()));
}

double largest_tilt(std::span<DeviceView*> views) {
  double largest = 0;
  for (size_t i = 0; i < views.size(); ++i)
    for (size_t j = i + 1; j < views.size(); ++j) {
      const Eigen::Vector3d a = views[i]->camera_from_board.front().linear().col(2);
      const Eigen::Vector3d b = views[j]->camera_from_board.front().linear().col(2);
      largest = std::max(largest, std::acos(std::clamp(a.dot(b), -1.0, 1.0)));
    }
  return largest;
}

/// A pair of devices and the poses of the board that both saw.
struct Edge {
  size_t corners = 0;
  std::vector<std::pair<const DeviceView*, const DeviceView*>> shared;
};

/// second_from_first that the shared poses agree on best.
Eigen::Isometry3d relative_pose(const Edge& edge, const DeviceStart& first, const DeviceStart& second,
                                const std::vector<Eigen::Vector3d>& on_board) {
  Eigen::Isometry3d best = Eigen::Isometry3d::Identity();
  double least = std::numeric_limits<double>::infinity();
  for (const auto& [a, b] : edge.shared)
    for (const Eigen::Isometry3d& from_a : a->camera_from_board)
      for (const Eigen::Isometry3d& from_b : b->camera_from_board) {
        const Eigen::Isometry3d candidate = from_b * from_a.inverse();
        double sum = 0;
        for (const auto& [seen_a, seen_b] : edge.shared) {
          double least_here = std::numeric_limits<double>::infinity();
          for (const Eigen::Isometry3d& pose : seen_a->camera_from_board)
            least_here = std::min(least_here, misfit(*seen_b->view, on_board, second.intrinsics, candidate * pose));
          double least_back = std::numeric_limits<double>::infinity();
          for (const Eigen::Isometry3d& pose : seen_b->camera_from_board)
            least_back =
                std::min(least_back, misfit(*seen_a->view, on_board, first.intrinsics, candidate.inverse() * pose));
          sum += least_here + least_back;
        }
        if (sum < least) {
          least = sum;
          best = candidate;
        }
      }
  return best;
}

int find_set(std::vector<int>& parent, int i) {
  while (parent[static_cast<size_t>(i)] != i) i = parent[static_cast<size_t>(i)];
  return i;
}

std::optional<DeviceStart> try_start(const CalibrationDevice& device, std::span<DeviceView*> views,
                                     const std::vector<Eigen::Vector3d>& on_board, const Intrinsics* known,
                                     const Work& work) {
  const double longest = std::max(device.width, device.height);
  std::vector<Points> points;
  for (const DeviceView* view : views) points.push_back(points_of(*view->view, on_board));
  // From wide angles to long lenses; the adjustment finds its way from within a factor of about 1.6.
  std::vector<double> focals{0.7 * longest, 1.2 * longest, 2.0 * longest, 3.5 * longest};
  const double from_homographies = focal_from_homographies(points, device);
  if (from_homographies > 0.2 * longest && from_homographies < 20 * longest)
    focals.insert(focals.begin(), from_homographies);

  std::vector<Intrinsics> tries;
  if (known) tries.push_back(*known);
  for (const double focal : focals) {
    Intrinsics k;
    k.width = device.width;
    k.height = device.height;
    k.fx = k.fy = focal;
    k.cx = 0.5 * (device.width - 1);
    k.cy = 0.5 * (device.height - 1);
    tries.push_back(k);
  }

  BundleOptions options;
  // A lens's axis meets the sensor near its middle; a projector's is often shifted upwards.
  options.priors.principal_point = device.projector ? 0.3 : 0.03;
  options.most_iterations = 40;
  std::optional<DeviceStart> best;
  std::vector<std::vector<Eigen::Isometry3d>> best_poses;
  for (const Intrinsics& k : tries) {
    bool posed = true;
    for (size_t i = 0; i < views.size() && posed; ++i) {
      views[i]->camera_from_board = plane_poses(points[i], k);
      posed = !views[i]->camera_from_board.empty();
    }
    if (!posed) continue;
    Bundle bundle = own_bundle(k, views, on_board);
    if (!adjust(bundle, options, work)) continue;
    DeviceStart start{.intrinsics = bundle.intrinsics[0], .rms_px = root_mean_square(bundle), .tilt_rad = 0};
    const double ratio = start.intrinsics.fx / start.intrinsics.fy;
    constexpr double most_stretched = 1.3;
    if (!(start.intrinsics.fx > 0) || !(ratio < most_stretched && ratio > 1 / most_stretched)) continue;
    constexpr double clearly_better = 0.98;
    if (best && start.rms_px > clearly_better * best->rms_px) continue;
    best_poses.clear();
    for (size_t i = 0; i < views.size(); ++i) {
      // The adjusted pose first; the other one of the plane may still turn out to be right.
      std::vector<Eigen::Isometry3d> poses{bundle.world_from_board[i]};
      for (const Eigen::Isometry3d& pose : plane_poses(points[i], start.intrinsics)) {
        constexpr double same_rad = 0.1;
        const Eigen::AngleAxisd difference(poses.front().linear().transpose() * pose.linear());
        if (difference.angle() > same_rad) poses.push_back(pose);
      }
      best_poses.push_back(std::move(poses));
    }
    best = start;
  }
  if (!best) return std::nullopt;
  for (size_t i = 0; i < views.size(); ++i) views[i]->camera_from_board = best_poses[i];
  best->tilt_rad = largest_tilt(views);
  return best;
}

}  // namespace

std::optional<DeviceStart> start_device(const CalibrationDevice& device, std::span<DeviceView*> views,
                                        const std::vector<Eigen::Vector3d>& on_board, const Intrinsics* known,
                                        const Work& work) {
  try {
    return try_start(device, views, on_board, known, work);
  } catch (const cv::Exception&) {
    // OpenCV throws where corners in a row, or crowded together, leave a pose open.
    return std::nullopt;
  }
}

Chain chain_devices(std::span<const std::optional<DeviceStart>> starts, std::span<const DeviceView> views, size_t poses,
                    const std::vector<Eigen::Vector3d>& on_board) {
  const int devices = static_cast<int>(starts.size());
  std::map<std::pair<int, int>, Edge> edges;
  for (size_t i = 0; i < views.size(); ++i)
    for (size_t j = i + 1; j < views.size(); ++j) {
      const DeviceView *a = &views[i], *b = &views[j];
      if (a->pose != b->pose || !starts[static_cast<size_t>(a->device)] || !starts[static_cast<size_t>(b->device)])
        continue;
      if (a->device > b->device) std::swap(a, b);
      Edge& edge = edges[{a->device, b->device}];
      edge.corners += std::min(a->view->corners.size(), b->view->corners.size());
      edge.shared.emplace_back(a, b);
    }
  // Kruskal's algorithm, the strongest edge first.
  std::vector<std::pair<std::pair<int, int>, const Edge*>> order;
  for (const auto& [pair, edge] : edges) order.emplace_back(pair, &edge);
  std::stable_sort(order.begin(), order.end(),
                   [](const auto& a, const auto& b) { return a.second->corners > b.second->corners; });
  std::vector<int> parent(static_cast<size_t>(devices));
  std::iota(parent.begin(), parent.end(), 0);
  std::vector<std::vector<std::pair<int, Eigen::Isometry3d>>> neighbours(static_cast<size_t>(devices));
  for (const auto& [pair, edge] : order) {
    const int a = find_set(parent, pair.first), b = find_set(parent, pair.second);
    if (a == b) continue;
    parent[static_cast<size_t>(std::max(a, b))] = std::min(a, b);
    const Eigen::Isometry3d second_from_first = relative_pose(*edge, *starts[static_cast<size_t>(pair.first)],
                                                              *starts[static_cast<size_t>(pair.second)], on_board);
    neighbours[static_cast<size_t>(pair.first)].emplace_back(pair.second, second_from_first);
    neighbours[static_cast<size_t>(pair.second)].emplace_back(pair.first, second_from_first.inverse());
  }

  std::map<int, int> sizes;
  for (int i = 0; i < devices; ++i)
    if (starts[static_cast<size_t>(i)]) ++sizes[find_set(parent, i)];
  Chain chain;
  chain.camera_from_world.resize(static_cast<size_t>(devices));
  chain.world_from_board.resize(poses);
  int largest = 0;
  for (const auto& [set, size] : sizes)
    if (size > largest) {
      largest = size;
      chain.root = set;
    }
  if (chain.root < 0) return chain;
  chain.camera_from_world[static_cast<size_t>(chain.root)] = Eigen::Isometry3d::Identity();
  std::vector<int> reached{chain.root};
  for (size_t i = 0; i < reached.size(); ++i)
    for (const auto& [next, next_from_here] : neighbours[static_cast<size_t>(reached[i])]) {
      auto& pose = chain.camera_from_world[static_cast<size_t>(next)];
      if (pose) continue;
      pose = next_from_here * *chain.camera_from_world[static_cast<size_t>(reached[i])];
      reached.push_back(next);
    }

  // Each place of the board as the device sees it that all others agree with best.
  for (size_t p = 0; p < poses; ++p) {
    double least = std::numeric_limits<double>::infinity();
    for (const DeviceView& from : views) {
      if (from.pose != static_cast<int>(p) || !chain.camera_from_world[static_cast<size_t>(from.device)]) continue;
      for (const Eigen::Isometry3d& candidate : from.camera_from_board) {
        const Eigen::Isometry3d world_from_board =
            chain.camera_from_world[static_cast<size_t>(from.device)]->inverse() * candidate;
        double sum = 0;
        for (const DeviceView& seen : views) {
          const auto& pose = chain.camera_from_world[static_cast<size_t>(seen.device)];
          if (seen.pose != from.pose || !pose) continue;
          sum += misfit(*seen.view, on_board, starts[static_cast<size_t>(seen.device)]->intrinsics,
                        *pose * world_from_board);
        }
        if (sum < least) {
          least = sum;
          chain.world_from_board[p] = world_from_board;
        }
      }
    }
  }
  return chain;
}

}  // namespace booth
