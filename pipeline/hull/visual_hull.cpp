#include "pipeline/hull/visual_hull.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <sstream>
#include <string>

#include "pipeline/geometry/silhouette_view.h"
#include "pipeline/geometry/solid_parts.h"
#include "pipeline/hull/camera_alignment.h"
#include "pipeline/hull/contradictions.h"

namespace booth {
namespace {

constexpr int side = Field::brick_side;
/// Values are cut off at this many voxels: the zero level needs no more than the ends of the edges that cross it.
constexpr double cut_off_voxels = 2;

/// A mask may show so much that is not the subject before an operator is told. Measured where all is well: up to 0.008.
constexpr double much_unexplained = 0.03;

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
  Carving(const Rig& rig, const SilhouetteViews& views, const VisualHullOptions& options, const Work& work)
      : box_(rig.volume),
        views_(views),
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
      const SilhouetteView::Verdict verdict = views_[v]->judge(center, radius_m);
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
      const SilhouetteView::Verdict verdict = views_[v]->judge(center, half_m * std::sqrt(3.0));
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

  void carve(const SilhouetteView& view, const Samples& x, const Samples& y, const Samples& z, Samples& values,
             Samples* within_m) const {
    Samples u, v, depth, within_px;
    for (size_t s = 0; s < values.size(); ++s) view.project(x[s], y[s], z[s], u[s], v[s], depth[s], within_px[s]);
    for (size_t s = 0; s < values.size(); ++s) {
      const float pixel_m = depth[s] * view.per_focal();
      if (within_m != nullptr) (*within_m)[s] = within_px[s] * pixel_m;
      if (!(within_px[s] >= 0) || values[s] >= cut_off_m_) continue;
      const float distance_m = view.outline().at(u[s], v[s]) * pixel_m;
      values[s] = std::clamp(distance_m, values[s], cut_off_m_);
    }
  }

  Eigen::AlignedBox3d box_;
  const SilhouetteViews& views_;
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
  constexpr double most_bricks = 1 << 25;
  const Eigen::Vector3d bricks = rig.volume.sizes() / (options.voxel_m * side) + Eigen::Vector3d::Constant(2);
  if (rig.volume.isEmpty() || !(bricks.prod() <= most_bricks))
    return Error{ErrorCode::invalid_argument, "hull: the rig's volume of " + std::to_string(rig.volume.volume()) +
                                                  " m³ is empty, or too large for a voxel_m of " +
                                                  std::to_string(options.voxel_m)};
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

SilhouetteViews make_views(const Rig& rig, std::span<const Silhouette> silhouettes, const Work& work) {
  SilhouetteViews views(silhouettes.size());
  work.parallel_for(silhouettes.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i)
      if (const RigCamera* camera = rig.find(silhouettes[i].camera))
        views[i] = std::make_unique<SilhouetteView>(*camera, silhouettes[i].coverage);
  });
  std::erase(views, nullptr);
  return views;
}

std::string describe(const CameraAgreement& agreement) {
  std::ostringstream text;
  text.precision(2);
  text << "the picture of camera " << agreement.camera << " is off by " << agreement.offset_px
       << " pixels from where the other cameras expect it; it was realigned, calibrate it anew";
  return text.str();
}

}  // namespace

Result<VisualHull> carve_visual_hull(const Rig& rig, std::span<const Silhouette> silhouettes,
                                     const VisualHullOptions& options, const Work& work) {
  if (auto fine = check_input(rig, silhouettes, options); !fine) return fine.error();

  VisualHull hull;
  const auto own_rig = std::make_shared<Rig>(rig);
  hull.rig = own_rig;
  SilhouetteViews views = [&] {
    const Step step(work, "hull: outline distances");
    return make_views(*own_rig, silhouettes, work);
  }();
  if (work.stopped()) return Work::cancelled();
  work.report(0.3);

  std::erase_if(views, [&](const std::unique_ptr<SilhouetteView>& view) {
    const bool blind = view->outline().content() == OutlineDistance::Content::no_subject;
    const std::string& id = view->camera().id;
    if (blind) hull.warnings.push_back("camera " + id + " sees no subject; the hull was made without it");
    if (!blind) hull.cameras.push_back(id);
    return blind;
  });
  if (views.empty() && !hull.warnings.empty()) return Error{ErrorCode::no_subject, "no camera sees a subject"};
  if (static_cast<int>(views.size()) < options.min_views)
    return Error{ErrorCode::too_few_views, "only " + std::to_string(views.size()) + " cameras have a silhouette, " +
                                               std::to_string(options.min_views) + " are needed"};

  SolidParts parts;
  const auto carve = [&] {
    const Step step(work, "hull: carving");
    hull.field = Carving(rig, views, options, work).run();
    if (!work.stopped()) parts = keep_largest_part(hull.field, work);
  };
  carve();
  work.report(0.7);
  const std::vector<CameraDeviation> deviations = [&] {
    const Step step(work, "hull: camera poses");
    return realign_cameras(*own_rig, views, hull.field, work);
  }();
  for (size_t v = 0; v < views.size(); ++v) {
    hull.agreement.push_back({.camera = views[v]->camera().id,
                              .moved = deviations[v].moved,
                              .offset_px = deviations[v].offset_px,
                              .deviation = deviations[v].deviation});
    if (deviations[v].moved) hull.warnings.push_back(describe(hull.agreement.back()));
  }
  const bool any_moved = std::any_of(deviations.begin(), deviations.end(), [](const auto& d) { return d.moved; });
  if (any_moved && !work.stopped()) carve();
  // Where a mask lacks a part, others may seem to lack something behind it: the worst is overruled first, and the
  // others are looked at anew.
  const Step step(work, "hull: contradictions");
  std::vector<bool> named(views.size());
  for (size_t round = 0; round < views.size() && !work.stopped(); ++round) {
    const std::vector<Contradiction> contradictions = find_contradictions(rig.volume, views, hull.field, work);
    const auto worst = std::max_element(
        contradictions.begin(), contradictions.end(),
        [](const Contradiction& a, const Contradiction& b) { return a.discs.size() < b.discs.size(); });
    if (worst == contradictions.end()) break;
    auto& view = views[worst->view];
    if (!named[worst->view])
      hull.warnings.push_back("the silhouette of camera " + view->camera().id +
                              " lacks a part of the subject that the other cameras see; it was overruled there");
    named[worst->view] = true;
    view = std::make_unique<SilhouetteView>(view->camera(), overrule(view->coverage(), *worst));
    carve();
  }
  if (work.stopped()) return Work::cancelled();
  if (parts.kept_samples == 0)
    return Error{ErrorCode::no_subject, "no point of the capture volume is inside all silhouettes"};
  std::vector<double> unexplained(views.size());
  work.parallel_for(views.size(), 1, [&](size_t begin, size_t end) {
    for (size_t v = begin; v < end; ++v) unexplained[v] = unexplained_share(*views[v], hull.field);
  });
  for (size_t v = 0; v < views.size(); ++v)
    if (unexplained[v] > much_unexplained)
      hull.warnings.push_back("camera " + views[v]->camera().id + " shows " +
                              std::to_string(std::lround(100 * unexplained[v])) +
                              " % besides the subject that the other cameras do not confirm");
  hull.views = std::move(views);
  work.report(1);
  return hull;
}

}  // namespace booth
