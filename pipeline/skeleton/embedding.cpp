#include "pipeline/skeleton/embedding.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <limits>
#include <queue>
#include <utility>
#include <vector>

namespace booth {
namespace {

using Eigen::Vector3d;

constexpr double infinity = std::numeric_limits<double>::infinity();

struct Sphere {
  Vector3d center = Vector3d::Zero();
  double radius = 0;
};

/// Spheres around medial voxels, the largest first, each with its centre outside of all before it (section 3.1, 3.2).
std::vector<Sphere> pack_spheres(const Interior& interior) {
  const Grid& grid = interior.grid;
  constexpr double least_radius = 1.5;   // voxels
  constexpr double medial_slope = 0.75;  // depth grows by less than this where it has a ridge
  std::vector<std::pair<float, uint32_t>> medial;
  const size_t row = static_cast<size_t>(grid.size[0]), plane = row * static_cast<size_t>(grid.size[1]);
  for (const uint32_t v : interior.inside) {
    const float depth = interior.depth_m[v];
    if (static_cast<double>(depth) < least_radius * grid.voxel_m) continue;
    const auto slope = [&](size_t step) { return interior.depth_m[v + step] - interior.depth_m[v - step]; };
    const Eigen::Vector3f gradient(slope(1), slope(row), slope(plane));
    if (static_cast<double>(gradient.norm()) < 2 * medial_slope * grid.voxel_m) medial.emplace_back(depth, v);
  }
  std::sort(medial.begin(), medial.end(),
            [](const auto& a, const auto& b) { return a.first != b.first ? a.first > b.first : a.second < b.second; });
  constexpr size_t most = 400;
  std::vector<Sphere> spheres;
  for (const auto& [depth, v] : medial) {
    const Vector3d p = interior.point(v);
    const bool covered =
        std::any_of(spheres.begin(), spheres.end(), [&](const Sphere& s) { return (s.center - p).norm() < s.radius; });
    if (!covered) spheres.push_back({p, static_cast<double>(depth)});
    if (spheres.size() == most) break;
  }
  return spheres;
}

/// The spheres that touch, and the shortest ways between all of them (section 3.2).
class SphereGraph {
 public:
  explicit SphereGraph(std::vector<Sphere> spheres) : spheres_(std::move(spheres)), edges_(spheres_.size()) {
    for (size_t a = 0; a < size(); ++a)
      for (size_t b = a + 1; b < size(); ++b) {
        const double gap = (at(a) - at(b)).norm();
        constexpr double nearly = 1.3;  // spheres of a packing hardly overlap, where a limb bends they may just miss
        if (gap > nearly * (spheres_[a].radius + spheres_[b].radius)) continue;
        edges_[a].emplace_back(b, gap);
        edges_[b].emplace_back(a, gap);
      }
    for (size_t a = 0; a < size(); ++a) find_ways_from(a);
  }

  size_t size() const { return spheres_.size(); }
  const Vector3d& at(size_t sphere) const { return spheres_[sphere].center; }
  /// 0 for the largest sphere, towards 1 the smaller it is.
  double smallness(size_t sphere) const { return 1 - spheres_[sphere].radius / spheres_.front().radius; }
  double way(size_t from, size_t to) const { return length_[from][to]; }
  /// Whether the body ends here: no sphere that touches it is farther from the largest one. (The penalty of
  /// extremities, as a rule.)
  bool is_end(size_t sphere) const {
    return std::all_of(edges_[sphere].begin(), edges_[sphere].end(),
                       [&](const auto& edge) { return way(0, edge.first) <= way(0, sphere); });
  }
  /// The point a share of the way along.
  Vector3d along(size_t from, size_t to, double share) const {
    double left = share * way(from, to);
    // The tree of shortest ways is rooted at `to`, so walking it starts at `from`.
    for (size_t here = from; here != to;) {
      const size_t next = towards_[to][here];
      const double step = (at(next) - at(here)).norm();
      if (left <= step) return at(here) + (step > 0 ? left / step : 0) * (at(next) - at(here));
      left -= step;
      here = next;
    }
    return at(to);
  }

 private:
  void find_ways_from(size_t source) {
    std::vector<double> length(size(), infinity);
    std::vector<size_t> previous(size(), source);
    using Entry = std::pair<double, size_t>;
    std::priority_queue<Entry, std::vector<Entry>, std::greater<>> queue;
    length[source] = 0;
    queue.emplace(0, source);
    while (!queue.empty()) {
      const auto [reached, here] = queue.top();
      queue.pop();
      if (reached > length[here]) continue;
      for (const auto& [next, gap] : edges_[here])
        if (reached + gap < length[next]) {
          length[next] = reached + gap;
          previous[next] = here;
          queue.emplace(length[next], next);
        }
    }
    length_.push_back(std::move(length));
    towards_.push_back(std::move(previous));
  }

  std::vector<Sphere> spheres_;
  std::vector<std::vector<std::pair<size_t, double>>> edges_;
  std::vector<std::vector<double>> length_;
  std::vector<std::vector<size_t>> towards_;
};

/// A bone of the reduced skeleton: from a branching point to the next one or to an end (section 3.3). Lengths are
/// shares of stature.
struct ReducedBone {
  double length;
  Vector3d direction;
};
const ReducedBone back_bone{0.27, {0, 1, 0}}, head_bone{0.22, {0, 1, 0}};
ReducedBone arm_bone(size_t side) { return {0.46, Vector3d(0.8 * sign(side), -0.6, 0)}; }
ReducedBone leg_bone(size_t side) { return {0.53, Vector3d(0.15 * sign(side), -0.99, 0)}; }

/// How badly a bone lies between two spheres: wrong length, wrong direction, a way that is not straight (section 3.4's
/// penalties of a single bone).
double penalty(const SphereGraph& graph, size_t from, size_t to, const ReducedBone& bone, double stature) {
  const double way = graph.way(from, to);
  const Vector3d straight = graph.at(to) - graph.at(from);
  if (!(way < infinity) || !(straight.norm() > 0)) return infinity;
  const double length = way / stature / bone.length - 1;
  const double direction = 1 - straight.normalized().dot(bone.direction.normalized());
  const double detour = way / straight.norm() - 1;
  // Limbs of one side end on that side: what keeps both from choosing the same.
  if (bone.direction.x() * straight.x() < 0) return infinity;
  return 4 * length * length + 8 * direction * direction + 0.5 * detour * detour;
}

struct Placement {
  size_t sphere = 0;
  double cost = infinity;
};

/// The best end of the body for the far end of a bone, for every sphere of its near end.
std::vector<Placement> best_ends(const SphereGraph& graph, const ReducedBone& bone, double stature) {
  std::vector<Placement> best(graph.size());
  std::vector<size_t> ends;
  for (size_t sphere = 0; sphere < graph.size(); ++sphere)
    if (graph.is_end(sphere)) ends.push_back(sphere);
  for (size_t from = 0; from < graph.size(); ++from)
    for (const size_t to : ends)
      if (const double cost = penalty(graph, from, to, bone, stature); cost < best[from].cost) best[from] = {to, cost};
  return best;
}

/// Where the branching points and ends of the skeleton are.
struct Embedding {
  size_t pelvis = 0, chest = 0, head = 0;
  std::array<size_t, 2> hand{}, foot{};
  double cost = infinity;
};

Embedding embed(const SphereGraph& graph, double stature) {
  const auto head = best_ends(graph, head_bone, stature);
  std::array<std::vector<Placement>, 2> hand, foot;
  for (const size_t side : {left, right}) {
    hand[side] = best_ends(graph, arm_bone(side), stature);
    foot[side] = best_ends(graph, leg_bone(side), stature);
  }
  Embedding best;
  for (size_t pelvis = 0; pelvis < graph.size(); ++pelvis)
    for (size_t chest = 0; chest < graph.size(); ++chest) {
      // The trunk's joints lie in the thick of it.
      const double outside = std::pow(graph.smallness(pelvis), 2) + std::pow(graph.smallness(chest), 2);
      const double cost = outside + penalty(graph, pelvis, chest, back_bone, stature) + head[chest].cost +
                          hand[left][chest].cost + hand[right][chest].cost + foot[left][pelvis].cost +
                          foot[right][pelvis].cost;
      if (cost < best.cost)
        best = {pelvis,
                chest,
                head[chest].sphere,
                {hand[left][chest].sphere, hand[right][chest].sphere},
                {foot[left][pelvis].sphere, foot[right][pelvis].sphere},
                cost};
    }
  return best;
}

/// The joints between, at their shares of the ways (section 3.4, the last step).
BodyJoints spread(const SphereGraph& graph, const Embedding& e, double floor, double stature) {
  BodyJoints body;
  TrunkJoints& trunk = body.trunk;
  const auto back = [&](double share) { return graph.along(e.pelvis, e.chest, share); };
  trunk.pelvis = trunk.hips = back(0);
  trunk.spine = back(0.15);
  trunk.spine1 = back(0.4);
  trunk.spine2 = back(0.75);
  trunk.neck = graph.along(e.chest, e.head, 0.2);
  trunk.head = graph.along(e.chest, e.head, 0.5);
  trunk.crown = {trunk.head.x(), floor + 0.99 * stature, trunk.head.z()};
  for (const size_t side : {left, right}) {
    ArmJoints& arm = body.arms[side];
    // The last sphere that fits lies in the palm.
    arm.clavicle = graph.along(e.chest, e.hand[side], 0.08);
    arm.shoulder = graph.along(e.chest, e.hand[side], 0.3);
    arm.elbow = graph.along(e.chest, e.hand[side], 0.62);
    arm.wrist = graph.along(e.chest, e.hand[side], 0.93);
    arm.fingers = graph.at(e.hand[side]) + 0.07 * stature * (arm.wrist - arm.elbow).normalized();
    LegJoints& leg = body.legs[side];
    leg.hip = graph.along(e.pelvis, e.foot[side], 0.13);
    leg.knee = graph.along(e.pelvis, e.foot[side], 0.54);
    leg.ankle = graph.along(e.pelvis, e.foot[side], 0.94);
    leg.ball = graph.at(e.foot[side]);
    leg.ball.y() = floor + 0.018 * stature;
    leg.ball.z() = leg.ankle.z() + 0.09 * stature;
    leg.toes = leg.ball + Vector3d(0, 0, 0.04 * stature);
  }
  return body;
}

/// A limb that is refined: three joints and where the last bone ends.
struct Limb {
  std::array<Vector3d*, 3> joint;
  Vector3d to;
  std::array<double, 3> length;  // of the bones that begin at the joints, shares of stature
};

/// What the refinement minimises (section 3.5): bones should lie deep inside, have about their lengths, and be as long
/// as those of the other side.
double misfit(const Interior& interior, const std::array<Limb, 2>& limbs, double stature) {
  constexpr int samples = 6;
  double sum = 0;
  std::array<std::array<double, 3>, 2> lengths{};
  for (size_t side = 0; side < 2; ++side) {
    const Limb& limb = limbs[side];
    for (size_t k = 0; k < 3; ++k) {
      const Vector3d a = *limb.joint[k], b = k < 2 ? *limb.joint[k + 1] : limb.to;
      for (int n = 0; n < samples; ++n) {
        const double depth = interior.depth(a + (n + 0.5) / samples * (b - a));
        constexpr double deep_share = 0.03;  // of stature; limbs are hardly thicker
        const double shallow = std::max(0.0, deep_share - depth / stature) / deep_share;
        sum += shallow * shallow / samples;
      }
      lengths[side][k] = (b - a).norm() / stature / limb.length[k];
      sum += 4 * (lengths[side][k] - 1) * (lengths[side][k] - 1);
    }
  }
  for (size_t k = 0; k < 3; ++k) sum += 10 * (lengths[0][k] - lengths[1][k]) * (lengths[0][k] - lengths[1][k]);
  return sum;
}

/// Moves one joint after the other in steps that become smaller, as long as that helps.
void refine(const Interior& interior, std::array<Limb, 2>& limbs, double stature) {
  double least = misfit(interior, limbs, stature);
  for (double step = 0.016 * stature; step > 0.0015 * stature; step *= 0.5) {
    constexpr int most_rounds = 12;
    bool better = true;
    for (int round = 0; better && round < most_rounds; ++round) {
      better = false;
      for (Limb& limb : limbs)
        for (Vector3d* joint : limb.joint)
          for (int axis = 0; axis < 3; ++axis)
            for (const double way : {step, -step}) {
              (*joint)[axis] += way;
              if (const double now = misfit(interior, limbs, stature); now < least) {
                least = now;
                better = true;
              } else {
                (*joint)[axis] -= way;
              }
            }
    }
  }
}

}  // namespace

Result<BodyJoints> embed_skeleton(const Interior& interior) {
  const auto not_riggable = [](const char* why) { return Error{ErrorCode::not_riggable, why}; };
  if (interior.inside.empty()) return not_riggable("the mesh encloses nothing");
  double floor = infinity, top = -infinity;
  for (const uint32_t v : interior.inside) {
    const double y = interior.point(v).y();
    floor = std::min(floor, y - 0.5 * interior.grid.voxel_m);
    top = std::max(top, y + 0.5 * interior.grid.voxel_m);
  }
  const double stature = top - floor;
  const SphereGraph graph(pack_spheres(interior));
  constexpr size_t fewest = 20;
  if (graph.size() < fewest) return not_riggable("the shape is too simple for a person");
  const Embedding embedding = embed(graph, stature);
  // Each of the six bones that lies as it should costs a few tenths at most.
  constexpr double unacceptable = 4;
  if (!(embedding.cost < unacceptable)) return not_riggable("the skeleton of a person finds no place in the shape");

  BodyJoints body = spread(graph, embedding, floor, stature);
  std::array<Limb, 2> arms, legs;
  for (const size_t side : {left, right}) {
    ArmJoints& arm = body.arms[side];
    LegJoints& leg = body.legs[side];
    arms[side] = {{&arm.shoulder, &arm.elbow, &arm.wrist}, arm.fingers, {0.15, 0.15, 0.10}};
    legs[side] = {{&leg.hip, &leg.knee, &leg.ankle}, leg.ball, {0.24, 0.24, 0.09}};
  }
  refine(interior, arms, stature);
  refine(interior, legs, stature);
  return body;
}

}  // namespace booth
