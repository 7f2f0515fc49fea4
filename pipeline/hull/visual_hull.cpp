#include "pipeline/hull/visual_hull.h"

#include <Eigen/SVD>
#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <string>

#include "pipeline/geometry/camera_model.h"
#include "pipeline/hull/outline_distance.h"
#include "pipeline/hull/solid_parts.h"

namespace booth {
namespace {

constexpr int side = Field::brick_side;
constexpr double nearest_m = 0.01;  // points closer to a camera's plane than this are not seen by it
/// Values are cut off at this many voxels: the zero level needs no more than the ends of the edges that cross it.
constexpr double cut_off_voxels = 2;
/// Beside a cut-off silhouette a camera's say fades over this share of its image's shorter side.
constexpr double feather_share = 0.06;
/// What distances between the outline's tiles may be off by, and the rounding of projections, in pixels.
constexpr double distance_slack_px = 1;

/// A camera with its outline, and what bounds need to know about its lens.
struct View {
  View(const RigCamera& camera_, const Image& coverage)
      : camera(&camera_),
        outline(coverage, feather_share * std::min(coverage.width, coverage.height)),
        rotation(camera_.camera_from_world.linear().cast<float>()),
        translation(camera_.camera_from_world.translation().cast<float>()),
        focal_px(std::sqrt(camera_.intrinsics.fx * camera_.intrinsics.fy)) {
    measure_lens();
  }

  const RigCamera* camera;
  OutlineDistance outline;
  Eigen::Matrix3f rotation;
  Eigen::Vector3f translation;
  double focal_px;
  double stretch_px = 0;     ///< the most pixels that a step of one in the plane z = 1 moves a projection
  double image_radius2 = 0;  ///< beyond this squared distance from the axis in the plane z = 1, nothing is imaged

 private:
  /// Samples the image, and a margin around it that balls on its edge reach into.
  void measure_lens() {
    const Intrinsics& k = camera->intrinsics;
    constexpr int steps = 16;
    constexpr double margin = 0.1;
    for (int i = 0; i <= steps; ++i)
      for (int j = 0; j <= steps; ++j) {
        const Eigen::Vector2d share(static_cast<double>(i) / steps, static_cast<double>(j) / steps);
        const Eigen::Vector2d size(k.width, k.height);
        const Eigen::Vector2d wide = (share * (1 + 2 * margin) - Eigen::Vector2d::Constant(margin)).cwiseProduct(size);
        const Eigen::Vector3d direction = unproject(k, wide);
        constexpr double step = 1e-4;
        const auto middle = project_camera_point(k, direction);
        const auto beside = project_camera_point(k, direction + Eigen::Vector3d(step, 0, 0));
        const auto below = project_camera_point(k, direction + Eigen::Vector3d(0, step, 0));
        if (middle && beside && below) {
          Eigen::Matrix2d jacobian;
          jacobian.col(0) = (*beside - *middle) / step;
          jacobian.col(1) = (*below - *middle) / step;
          stretch_px = std::max(stretch_px, jacobian.jacobiSvd().singularValues()[0]);
        }
        image_radius2 = std::max(image_radius2, unproject(k, share.cwiseProduct(size)).head<2>().squaredNorm());
      }
    constexpr double between_samples = 1.02;
    stretch_px *= between_samples;
    image_radius2 *= between_samples;
  }
};

/// What a camera can say about all points of a ball.
struct Verdict {
  bool seen = false;               ///< the whole ball is inside the image
  bool hidden = false;             ///< no point of it is
  double least_m = 0, most_m = 0;  ///< bounds of the distance at points that are seen
};

Verdict judge(const View& view, const Eigen::Vector3d& center, double radius_m) {
  constexpr double unbounded = std::numeric_limits<double>::infinity();
  const Eigen::Vector3d p = view.camera->camera_from_world * center;
  if (p.z() + radius_m < nearest_m) return {.hidden = true};
  if (p.z() - radius_m < nearest_m) return {.least_m = -unbounded, .most_m = unbounded};
  const double off_axis = p.head<2>().norm() / p.z();
  // From q to p, both in the ball, a projection moves by |(q − p)xy − x (q − p)z| / qz in the plane z = 1.
  const double moved = radius_m * std::sqrt(1 + off_axis * off_axis) / (p.z() - radius_m);
  if (off_axis > moved && (off_axis - moved) * (off_axis - moved) > view.image_radius2) return {.hidden = true};
  const auto pixel = project_camera_point(view.camera->intrinsics, p);
  if (!pixel) return {.least_m = -unbounded, .most_m = unbounded};
  const double moved_px = moved * view.stretch_px + distance_slack_px;
  const double right = view.camera->intrinsics.width - 0.5, bottom = view.camera->intrinsics.height - 0.5;
  // How far inside the image the middle is; negative outside.
  const double within = std::min({pixel->x() + 0.5, right - pixel->x(), pixel->y() + 0.5, bottom - pixel->y()});
  Verdict verdict;
  verdict.seen = within >= moved_px;
  verdict.hidden = within < -moved_px;
  if (verdict.hidden) return verdict;
  // The distance is looked up at the image's nearest point; seen points are no farther from it than twice the move.
  const double reach_px = view.outline.slope() * moved_px * (within < 0 ? 2 : 1);
  const double middle_px = view.outline.at(static_cast<float>(pixel->x()), static_cast<float>(pixel->y()));
  const auto metres = [&](double px) { return px * (p.z() + (px < 0 ? -radius_m : radius_m)) / view.focal_px; };
  const auto metres_low = [&](double px) { return px * (p.z() + (px < 0 ? radius_m : -radius_m)) / view.focal_px; };
  verdict.least_m = metres_low(middle_px - reach_px);
  verdict.most_m = metres(middle_px + reach_px);
  return verdict;
}

/// A cube of bricks, and the cameras whose say about it is still open.
struct Node {
  std::array<int, 3> brick;  ///< its first brick
  int bricks;                ///< along its side
  std::vector<uint32_t> open;
  int sure_views = 0;  ///< cameras that see all of it, besides the open ones
};

enum class Place { outside, inside, open };

class Carving {
 public:
  Carving(const Rig& rig, std::vector<std::unique_ptr<View>> views, const VisualHullOptions& options, const Work& work)
      : box_(rig.volume),
        views_(std::move(views)),
        min_views_(options.min_views),
        cut_off_m_(static_cast<float>(cut_off_voxels * options.voxel_m)),
        work_(work) {
    Grid grid;
    grid.voxel_m = options.voxel_m;
    constexpr int margin = 2;  // samples around the volume, outside
    grid.origin = box_.min() - Eigen::Vector3d::Constant(margin * grid.voxel_m);
    for (int axis = 0; axis < 3; ++axis)
      grid.size[static_cast<size_t>(axis)] =
          static_cast<int>(std::ceil(box_.sizes()[axis] / grid.voxel_m)) + 2 * margin + 1;
    field_ = Field(grid);
  }

  Field run() {
    const std::vector<Node> open = find_open_bricks();
    sample(open);
    return std::move(field_);
  }

 private:
  /// Settles all bricks that surely lie inside or outside; returns the others.
  std::vector<Node> find_open_bricks() {
    constexpr int coarsest = 8;
    std::vector<Node> nodes;
    const auto bricks = field_.bricks();
    std::vector<uint32_t> everybody(views_.size());
    for (size_t v = 0; v < views_.size(); ++v) everybody[v] = static_cast<uint32_t>(v);
    for (int z = 0; z < bricks[2]; z += coarsest)
      for (int y = 0; y < bricks[1]; y += coarsest)
        for (int x = 0; x < bricks[0]; x += coarsest) nodes.push_back({{x, y, z}, coarsest, everybody, 0});
    for (int bricks_along = coarsest;; bricks_along /= 2) {
      std::vector<Place> places(nodes.size());
      constexpr size_t grain = 32;
      work_.parallel_for(nodes.size(), grain, [&](size_t begin, size_t end) {
        for (size_t n = begin; n < end; ++n) places[n] = settle(nodes[n]);
      });
      std::vector<Node> next;
      for (size_t n = 0; n < nodes.size(); ++n) {
        if (places[n] == Place::inside) fill(nodes[n]);
        if (places[n] != Place::open) continue;
        if (bricks_along == 1) {
          next.push_back(std::move(nodes[n]));
          continue;
        }
        for (int part = 0; part < 8; ++part) {
          Node child{nodes[n].brick, bricks_along / 2, nodes[n].open, nodes[n].sure_views};
          bool exists = true;
          for (size_t axis = 0; axis < 3; ++axis) {
            child.brick[axis] += (part >> axis & 1) * child.bricks;
            exists = exists && child.brick[axis] < bricks[axis];
          }
          if (exists) next.push_back(std::move(child));
        }
      }
      nodes = std::move(next);
      if (bricks_along == 1) return nodes;
    }
  }

  /// Asks the open cameras about a node, and strikes out those whose say no longer changes a sample of it.
  Place settle(Node& node) const {
    const Grid& grid = field_.grid();
    const double samples = node.bricks * side - 1;
    const Eigen::Vector3d center = grid.point(node.brick[0] * side, node.brick[1] * side, node.brick[2] * side) +
                                   Eigen::Vector3d::Constant(0.5 * samples * grid.voxel_m);
    // One voxel more, so that the edges to the next brick's samples are settled too.
    const double half_m = (0.5 * samples + 1) * grid.voxel_m;
    const double radius_m = half_m * std::sqrt(3.0);
    const Eigen::Vector3d from_middle = (center - box_.center()).cwiseAbs() - 0.5 * box_.sizes();
    if (from_middle.maxCoeff() > half_m) return Place::outside;
    bool inside = from_middle.maxCoeff() < -half_m - cut_off_m_;
    int seen = node.sure_views, perhaps_seen = node.sure_views;
    std::vector<uint32_t> open;
    for (const uint32_t v : node.open) {
      const Verdict verdict = judge(*views_[v], center, radius_m);
      if (verdict.hidden) continue;
      if (verdict.seen && verdict.least_m > 0) return Place::outside;
      ++perhaps_seen;
      if (verdict.seen) ++seen;
      const bool far_inside = verdict.most_m < -static_cast<double>(cut_off_m_);
      if (!far_inside) inside = false;
      if (verdict.seen && far_inside)
        ++node.sure_views;
      else
        open.push_back(v);
    }
    node.open = std::move(open);
    if (perhaps_seen < min_views_) return Place::outside;
    return inside && seen >= min_views_ ? Place::inside : Place::open;
  }

  void fill(const Node& node) {
    const auto bricks = field_.bricks();
    for (int z = node.brick[2]; z < std::min(node.brick[2] + node.bricks, bricks[2]); ++z)
      for (int y = node.brick[1]; y < std::min(node.brick[1] + node.bricks, bricks[1]); ++y)
        for (int x = node.brick[0]; x < std::min(node.brick[0] + node.bricks, bricks[0]); ++x)
          field_.set_brick(field_.brick_index(x, y, z), Field::all_inside);
  }

  void sample(const std::vector<Node>& nodes) {
    field_.allocate_blocks(nodes.size());
    constexpr size_t grain = 16;
    work_.parallel_for(nodes.size(), grain, [&](size_t begin, size_t end) {
      for (size_t n = begin; n < end; ++n) {
        if (work_.stopped()) return;
        const size_t index = field_.brick_index(nodes[n].brick[0], nodes[n].brick[1], nodes[n].brick[2]);
        field_.set_brick(index, static_cast<int32_t>(n));
        sample_brick(nodes[n], field_.block(static_cast<int32_t>(n)));
      }
    });
  }

  /// A brick's samples, an eighth at a time: many cameras settle an eighth at one look.
  void sample_brick(const Node& node, float* values) const {
    for (int part = 0; part < 8; ++part) {
      const std::array<int, 3> first{(part & 1) * eighth, (part >> 1 & 1) * eighth, (part >> 2) * eighth};
      const Samples part_values = sample_eighth(
          node, {node.brick[0] * side + first[0], node.brick[1] * side + first[1], node.brick[2] * side + first[2]});
      for (int k = 0; k < eighth; ++k)
        for (int j = 0; j < eighth; ++j)
          std::copy_n(part_values.begin() + (k * eighth + j) * eighth, eighth,
                      values + ((first[2] + k) * side + first[1] + j) * side + first[0]);
    }
  }

  static constexpr int eighth = side / 2;  // samples along the side of an eighth of a brick
  using Samples = std::array<float, static_cast<size_t>(eighth) * eighth * eighth>;

  Samples sample_eighth(const Node& node, const std::array<int, 3>& first) const {
    Samples x, y, z;  // world
    Samples values;
    const Grid& grid = field_.grid();
    size_t s = 0;
    for (int k = 0; k < eighth; ++k)
      for (int j = 0; j < eighth; ++j)
        for (int i = 0; i < eighth; ++i, ++s) {
          const Eigen::Vector3d p = grid.point(first[0] + i, first[1] + j, first[2] + k);
          x[s] = static_cast<float>(p.x());
          y[s] = static_cast<float>(p.y());
          z[s] = static_cast<float>(p.z());
          const double outside_box = ((p - box_.center()).cwiseAbs() - 0.5 * box_.sizes()).maxCoeff();
          values[s] = std::clamp(static_cast<float>(outside_box), -cut_off_m_, cut_off_m_);
        }
    const double half_m = 0.5 * (eighth - 1) * grid.voxel_m;
    const Eigen::Vector3d center = grid.point(first[0], first[1], first[2]) + Eigen::Vector3d::Constant(half_m);
    const bool count_views = node.sure_views < min_views_;
    std::vector<Samples> within;  // for every open camera, how far inside its image the samples are, metres
    for (const uint32_t v : node.open) {
      const Verdict verdict = judge(*views_[v], center, half_m * std::sqrt(3.0));
      if (verdict.seen && verdict.least_m > static_cast<double>(cut_off_m_)) {
        values.fill(cut_off_m_);
        return values;
      }
      const bool says_nothing = verdict.hidden || verdict.most_m < -static_cast<double>(cut_off_m_);
      if (says_nothing && !count_views) continue;
      carve(*views_[v], x, y, z, values, count_views ? &within.emplace_back() : nullptr);
    }
    if (!count_views) return values;
    const auto rank = static_cast<size_t>(min_views_ - node.sure_views - 1);
    std::vector<float> ranked(within.size());
    for (s = 0; s < values.size(); ++s) {
      for (size_t n = 0; n < ranked.size(); ++n) ranked[n] = within[n][s];
      std::nth_element(ranked.begin(), ranked.begin() + static_cast<std::ptrdiff_t>(rank), ranked.end(),
                       std::greater<>());
      values[s] = std::clamp(-ranked[rank], values[s], cut_off_m_);
    }
    return values;
  }

  void carve(const View& view, const Samples& x, const Samples& y, const Samples& z, Samples& values,
             Samples* within_m) const {
    Samples u, v, depth;  // pixels, pixels, metres
    project(view, x, y, z, u, v, depth);
    const float right = static_cast<float>(view.camera->intrinsics.width) - 0.5F;
    const float bottom = static_cast<float>(view.camera->intrinsics.height) - 0.5F;
    const auto per_focal = static_cast<float>(1 / view.focal_px);
    for (size_t s = 0; s < values.size(); ++s) {
      const float pixel_m = depth[s] * per_focal;
      const float within_px = std::min(std::min(u[s] + 0.5F, right - u[s]), std::min(v[s] + 0.5F, bottom - v[s]));
      if (within_m != nullptr) (*within_m)[s] = within_px * pixel_m;
      if (!(within_px >= 0) || values[s] >= cut_off_m_) continue;
      const float distance_m = view.outline.at(u[s], v[s]) * pixel_m;
      values[s] = std::clamp(distance_m, values[s], cut_off_m_);
    }
  }

  /// As project_camera_point, in single precision and for many points; what is not imaged lands far outside.
  static void project(const View& view, const Samples& x, const Samples& y, const Samples& z, Samples& u, Samples& v,
                      Samples& depth) {
    const Intrinsics& k = view.camera->intrinsics;
    const Eigen::Matrix3f& r = view.rotation;
    const Eigen::Vector3f& t = view.translation;
    const auto k1 = static_cast<float>(k.distortion[0]), k2 = static_cast<float>(k.distortion[1]);
    const auto p1 = static_cast<float>(k.distortion[2]), p2 = static_cast<float>(k.distortion[3]);
    const auto k3 = static_cast<float>(k.distortion[4]);
    const auto fx = static_cast<float>(k.fx), fy = static_cast<float>(k.fy), skew = static_cast<float>(k.skew);
    const auto cx = static_cast<float>(k.cx), cy = static_cast<float>(k.cy);
    const auto radius2 = static_cast<float>(view.image_radius2);
    constexpr auto near = static_cast<float>(nearest_m);
    constexpr float nowhere = -1e6F;
    for (size_t s = 0; s < x.size(); ++s) {
      const float camera_z = r(2, 0) * x[s] + r(2, 1) * y[s] + r(2, 2) * z[s] + t[2];
      const float d = camera_z > near ? camera_z : near;
      const float a = (r(0, 0) * x[s] + r(0, 1) * y[s] + r(0, 2) * z[s] + t[0]) / d;
      const float b = (r(1, 0) * x[s] + r(1, 1) * y[s] + r(1, 2) * z[s] + t[1]) / d;
      const float r2 = a * a + b * b;
      const float radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
      const float da = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a);
      const float db = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b;
      const bool imaged = camera_z > near && r2 < radius2;
      u[s] = imaged ? fx * da + skew * db + cx : nowhere;
      v[s] = imaged ? fy * db + cy : nowhere;
      depth[s] = d;
    }
  }

  Eigen::AlignedBox3d box_;
  std::vector<std::unique_ptr<View>> views_;
  int min_views_;
  float cut_off_m_;
  const Work& work_;
  Field field_;
};

Result<void> check_input(const Rig& rig, std::span<const Silhouette> silhouettes, const VisualHullOptions& options) {
  if (!(options.voxel_m >= 0.001 && options.voxel_m <= 0.05))
    return Error{ErrorCode::invalid_argument,
                 "hull: voxel_m is " + std::to_string(options.voxel_m) + ", expected 0.001 … 0.05"};
  if (options.min_views < 1)
    return Error{ErrorCode::invalid_argument,
                 "hull: min_views is " + std::to_string(options.min_views) + ", expected at least 1"};
  for (size_t i = 0; i < silhouettes.size(); ++i) {
    const Silhouette& silhouette = silhouettes[i];
    const RigCamera* camera = rig.find(silhouette.camera);
    if (camera == nullptr) continue;
    const Image& image = silhouette.coverage;
    if (image.width != camera->intrinsics.width || image.height != camera->intrinsics.height || image.channels != 1 ||
        image.empty())
      return Error{ErrorCode::invalid_argument,
                   "hull: the silhouette of " + silhouette.camera + " has " + std::to_string(image.width) + " × " +
                       std::to_string(image.height) + " pixels of " + std::to_string(image.channels) +
                       " channels, its camera " + std::to_string(camera->intrinsics.width) + " × " +
                       std::to_string(camera->intrinsics.height) + " of one"};
    for (size_t other = 0; other < i; ++other)
      if (silhouettes[other].camera == silhouette.camera)
        return Error{ErrorCode::invalid_argument, "hull: camera " + silhouette.camera + " has two silhouettes"};
  }
  return {};
}

}  // namespace

Result<VisualHull> carve_visual_hull(const Rig& rig, std::span<const Silhouette> silhouettes,
                                     const VisualHullOptions& options, const Work& work) {
  if (auto fine = check_input(rig, silhouettes, options); !fine) return fine.error();

  std::vector<std::unique_ptr<View>> made(silhouettes.size());
  work.parallel_for(silhouettes.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i)
      if (const RigCamera* camera = rig.find(silhouettes[i].camera))
        made[i] = std::make_unique<View>(*camera, silhouettes[i].coverage);
  });
  if (work.stopped()) return Work::cancelled();
  work.report(0.3);

  VisualHull hull;
  std::vector<std::unique_ptr<View>> views;
  for (auto& view : made) {
    if (!view) continue;
    if (view->outline.content() == OutlineDistance::Content::no_subject) {
      hull.warnings.push_back("camera " + view->camera->id + " sees no subject; the hull was made without it");
      continue;
    }
    hull.cameras.push_back(view->camera->id);
    views.push_back(std::move(view));
  }
  if (views.empty() && !hull.warnings.empty()) return Error{ErrorCode::no_subject, "no camera sees a subject"};
  if (static_cast<int>(views.size()) < options.min_views)
    return Error{ErrorCode::too_few_views, "only " + std::to_string(views.size()) + " cameras have a silhouette, " +
                                               std::to_string(options.min_views) + " are needed"};

  hull.field = Carving(rig, std::move(views), options, work).run();
  if (work.stopped()) return Work::cancelled();
  work.report(0.8);

  const SolidParts parts = keep_largest_part(hull.field, work);
  if (parts.kept_samples == 0)
    return Error{ErrorCode::no_subject, "no point of the capture volume is inside all silhouettes"};
  work.report(1);
  return hull;
}

}  // namespace booth
