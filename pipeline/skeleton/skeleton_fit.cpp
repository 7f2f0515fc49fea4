#include "pipeline/skeleton/skeleton_fit.h"

#include <Eigen/Eigenvalues>
#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <initializer_list>
#include <limits>
#include <numbers>
#include <optional>
#include <utility>

#include "pipeline/geometry/interior.h"
#include "pipeline/skeleton/embedding.h"

namespace booth {
namespace {

using Eigen::Vector3d;

// Proportions of people, as shares of stature unless a comment says otherwise. Lengths between joint centres are the
// means of de Leva's men and women; heights and breadths are Drillis and Contini's where they give them.
constexpr double upper_arm_share = 0.150;  // shoulder to elbow; de Leva 0.160, less as stature here has shoes and hair
constexpr double forearm_share = 0.146;    // elbow to wrist; de Leva 0.153, less for the same reason
constexpr double hand_of_arm = 0.27;       // wrist to fingertip, of shoulder to fingertip
constexpr double forearm_of_arm = 0.36;    // elbow to wrist, likewise
constexpr double arm_share = 0.42;         // shoulder to fingertip
constexpr double shortest_arm_share = 0.28;     // what is shorter ends at the elbow
constexpr double longest_arm_share = 0.48;      // what is longer holds something
constexpr double shoulder_half_share = 0.105;   // middle to shoulder joint: half the biacromial breadth less 0.01
constexpr double shoulder_cover_share = 0.031;  // shoulder joint to the skin above and beside it
constexpr double shoulder_drop_share = 0.055;   // from the lowest joint of the neck down to the shoulder joints
constexpr double hip_half_share = 0.060;        // middle to hip joint
constexpr double hip_height_share = 0.52;       // of adults
constexpr double hip_of_crotch = 1.14;          // hip joints' height, of the crotch's
constexpr double knee_of_leg = 0.51;            // ankle to knee, of ankle to hip
constexpr double ankle_height_share = 0.043;
constexpr double foot_share = 0.152;          // length of a foot
constexpr double ball_of_foot = 0.72;         // ankle to the ball of the foot, of ankle to toe tip
constexpr double neck_height_share = 0.875;   // narrowest part of the neck
constexpr double adult_head_share = 0.12;     // narrowest part of the neck to the crown
constexpr double head_front_share = 0.06;     // face to the middle of the head
constexpr double longest_head_share = 0.135;  // face to the back of the head; what is longer has hair or a hood
constexpr double shoulder_ahead_share =
    0.006;  // shoulder joint before the middle of what the shoulder blade makes thick
constexpr double spine_of_trunk_depth = 0.37;   // the column of vertebrae, from the back
constexpr double sacrum_of_trunk_depth = 0.16;  // where it stands on the pelvis
constexpr double deepest_trunk_share = 0.18;    // what is deeper is a skirt's or a coat's

const char* name(size_t side) { return side == left ? "left" : "right"; }

Error not_riggable(const std::string& why) { return {ErrorCode::not_riggable, "skeleton: " + why}; }

/// The body with its measures.
struct Body {
  Interior interior;
  double floor = 0;    // y of the soles
  double stature = 0;  // metres
  Geodesics from_core;

  double voxel() const { return interior.grid.voxel_m; }
  double height(double share) const { return floor + share * stature; }
  int row(double y) const {
    return std::clamp(static_cast<int>(std::lround((y - interior.grid.origin.y()) / voxel())), 0,
                      interior.grid.size[1] - 1);
  }
  double row_y(int j) const { return interior.grid.origin.y() + j * voxel(); }
  bool solid(int i, int j, int k) const { return interior.depth_m[interior.index(i, j, k)] > 0; }
};

/// Which ends of the shape are what.
struct Ends {
  size_t head = 0;
  std::array<std::optional<size_t>, 2> hand, foot;  // left, right
};

// ---- measuring -----------------------------------------------------------------------------------------------------

/// A weighted mean that is empty until something counts.
struct Centroid {
  Vector3d sum = Vector3d::Zero();
  double weight = 0;
  void add(const Vector3d& p, double w) {
    sum += w * p;
    weight += w;
  }
  Vector3d mean() const { return sum / weight; }
};

/// Deep voxels count more: webs and cloth beside a limb hardly move its centre.
double centre_weight(double depth) { return depth * depth; }

/// The centre of the body within a box around a point, or the point itself where there is none.
Vector3d centre_near(const Body& body, const Vector3d& p, const Vector3d& half) {
  const Grid& grid = body.interior.grid;
  std::array<int, 3> low{}, high{};
  for (size_t axis = 0; axis < 3; ++axis) {
    const double at = (p - grid.origin)[static_cast<int>(axis)] / grid.voxel_m,
                 reach = half[static_cast<int>(axis)] / grid.voxel_m;
    low[axis] = std::max(0, static_cast<int>(std::ceil(at - reach)));
    high[axis] = std::min(grid.size[axis] - 1, static_cast<int>(std::floor(at + reach)));
  }
  Centroid centre;
  for (int k = low[2]; k <= high[2]; ++k)
    for (int j = low[1]; j <= high[1]; ++j)
      for (int i = low[0]; i <= high[0]; ++i)
        centre.add(grid.point(i, j, k),
                   centre_weight(static_cast<double>(body.interior.depth_m[body.interior.index(i, j, k)])));
  return centre.weight > 0 ? centre.mean() : p;
}

/// The stretch of a row, seen from the front, that holds x; empty (low > high) where the row has none there.
struct Run {
  double low = 0, high = -1;
  bool empty() const { return low > high; }
  double width() const { return high - low; }
};
Run run_at(const Body& body, double y, double x) {
  const Grid& grid = body.interior.grid;
  const int j = body.row(y);
  const auto filled = [&](int i) {
    for (int k = 0; k < grid.size[2]; ++k)
      if (body.solid(i, j, k)) return true;
    return false;
  };
  const int start = static_cast<int>(std::lround((x - grid.origin.x()) / grid.voxel_m));
  if (start < 0 || start >= grid.size[0] || !filled(start)) return {};
  int low = start, high = start;
  while (low > 0 && filled(low - 1)) --low;
  while (high + 1 < grid.size[0] && filled(high + 1)) ++high;
  return {grid.point(low, 0, 0).x() - 0.5 * grid.voxel_m, grid.point(high, 0, 0).x() + 0.5 * grid.voxel_m};
}

/// From back to front: the stretch of z that the body fills around (x, y).
Run depth_run(const Body& body, double x, double y, double half_width, double half_height) {
  const Grid& grid = body.interior.grid;
  std::vector<double> lows, highs;
  for (int j = body.row(y - half_height); j <= body.row(y + half_height); ++j)
    for (int i = 0; i < grid.size[0]; ++i) {
      if (std::abs(grid.point(i, 0, 0).x() - x) > half_width) continue;
      int first = -1, last = -1;
      for (int k = 0; k < grid.size[2]; ++k)
        if (body.solid(i, j, k)) {
          if (first < 0) first = k;
          last = k;
        }
      if (first < 0) continue;
      lows.push_back(grid.point(0, 0, first).z());
      highs.push_back(grid.point(0, 0, last).z());
    }
  if (lows.empty()) return {};
  const auto median = [](std::vector<double>& values) {
    std::nth_element(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2), values.end());
    return values[values.size() / 2];
  };
  return {median(lows), median(highs)};
}

/// The nearest place at least two voxels (or as deep as it gets there) under the skin.
Vector3d pulled_inside(const Body& body, const Vector3d& p) {
  const double enough = 1.5 * body.voxel();
  if (body.interior.depth(p) >= enough) return p;
  double nearest = std::numeric_limits<double>::infinity();
  Vector3d best = p;
  for (const uint32_t v : body.interior.inside) {
    if (static_cast<double>(body.interior.depth_m[v]) < enough) continue;
    const Vector3d q = body.interior.point(v);
    const double distance = (q - p).squaredNorm();
    if (distance < nearest) {
      nearest = distance;
      best = q;
    }
  }
  return best;
}

// ---- the body and its ends -----------------------------------------------------------------------------------------

Eigen::AlignedBox3d bounds(const Interior& interior) {
  Eigen::AlignedBox3d box;
  for (const uint32_t v : interior.inside) box.extend(interior.point(v));
  box.min().array() -= 0.5 * interior.grid.voxel_m;
  box.max().array() += 0.5 * interior.grid.voxel_m;
  return box;
}

/// What of a mesh lies within a box.
Mesh cropped(const Mesh& mesh, const Eigen::AlignedBox3d& box) {
  Mesh result{mesh.positions, {}};
  for (const auto& t : mesh.triangles)
    if (std::all_of(t.begin(), t.end(), [&](uint32_t v) { return box.contains(mesh.positions[v].cast<double>()); }))
      result.triangles.push_back(t);
  return result;
}

Result<Body> measure(const Mesh& mesh, const SkeletonOptions& options) {
  if (mesh.triangles.empty()) return not_riggable("the mesh is empty");
  Body body;
  body.interior = sample_interior(mesh, options.cells);
  if (body.interior.inside.empty()) return not_riggable("the mesh encloses nothing");
  Eigen::AlignedBox3d box = bounds(body.interior);
  constexpr double fine_enough = 0.9;
  if (box.sizes().y() < fine_enough * options.cells * body.voxel()) {
    // The body is a small part of the mesh: sample it alone.
    const Vector3d margin = Vector3d::Constant(2 * body.voxel());
    body.interior = sample_interior(cropped(mesh, {box.min() - margin, box.max() + margin}), options.cells);
    if (body.interior.inside.empty()) return not_riggable("the mesh encloses nothing");
    box = bounds(body.interior);
  }
  body.floor = box.min().y();
  body.stature = box.sizes().y();
  // People are as tall as their arms span, and several times taller than deep. An adult of 100 kg and 1.6 m fills 0.025
  // of the cube over the stature; a coat and a coarse hull may double that.
  constexpr double widest = 1.4, deepest = 0.8, most_massive = 0.08;
  if (box.sizes().x() > widest * body.stature || box.sizes().z() > deepest * body.stature)
    return not_riggable("the shape is wider or deeper than a standing person is tall");
  const double volume = static_cast<double>(body.interior.inside.size()) * std::pow(body.voxel(), 3);
  if (volume > most_massive * std::pow(body.stature, 3)) return not_riggable("the shape is too massive for a person");
  return body;
}

/// The deepest voxel of the trunk.
std::optional<size_t> find_core(const Body& body) {
  std::optional<size_t> core;
  for (const uint32_t v : body.interior.inside) {
    const double y = body.interior.point(v).y();
    if (y < body.height(0.45) || y > body.height(0.75)) continue;
    if (!core || body.interior.depth_m[v] > body.interior.depth_m[*core]) core = v;
  }
  return core;
}

/// The most prominent extremity of each kind. Those of hair, a bag or a hem stand out less or elsewhere.
Result<Ends> classify(const Body& body, const std::vector<Extremity>& extremities) {
  const double per_stature = 10 * body.stature / body.voxel();  // geodesic steps
  Ends ends;
  // The crown is an end of the shape unless hair reaches farther from the trunk; then it is the highest place.
  std::optional<size_t> head;
  for (const Extremity& e : extremities)
    if (const double y = body.interior.point(e.tip).y();
        y > body.height(0.85) && (!head || y > body.interior.point(*head).y()))
      head = e.tip;
  if (!head)
    head = *std::max_element(body.interior.inside.begin(), body.interior.inside.end(), [&](uint32_t a, uint32_t b) {
      return body.interior.cell(a)[1] < body.interior.cell(b)[1];
    });
  ends.head = *head;

  std::vector<Extremity> feet;
  for (const Extremity& e : extremities)
    if (body.interior.point(e.tip).y() < body.height(0.12) && e.persistence() > 0.06 * per_stature) feet.push_back(e);
  const auto more_prominent = [](const Extremity& a, const Extremity& b) { return a.persistence() > b.persistence(); };
  std::stable_sort(feet.begin(), feet.end(), more_prominent);
  if (feet.size() > 2 && feet[2].persistence() > 0.25 * per_stature)
    return not_riggable("the shape stands on more than two legs");
  if (feet.size() >= 2) {
    const bool ordered = body.interior.point(feet[0].tip).x() > body.interior.point(feet[1].tip).x();
    ends.foot[left] = feet[ordered ? 0 : 1].tip;
    ends.foot[right] = feet[ordered ? 1 : 0].tip;
  }

  const double middle =
      ends.foot[left] ? 0.5 * (body.interior.point(*ends.foot[left]).x() + body.interior.point(*ends.foot[right]).x())
                      : body.interior.point(ends.head).x();
  for (const Extremity& e : extremities) {
    const Vector3d p = body.interior.point(e.tip);
    const double aside = p.x() - middle;
    if (p.y() < body.height(0.2) || p.y() > body.height(0.95) || std::abs(aside) < 0.1 * body.stature) continue;
    if (e.tip == ends.head || e.persistence() < 0.1 * per_stature) continue;
    std::optional<size_t>& hand = ends.hand[aside > 0 ? left : right];
    if (!hand) hand = e.tip;  // farthest first: the hand is the farthest of its side
  }
  return ends;
}

// ---- limbs ---------------------------------------------------------------------------------------------------------

/// One place on a limb's centre line.
struct Station {
  Vector3d p;
  double along = 0;    // metres from the tip
  double area_m2 = 0;  // of the section
};

/// The centre line of a limb from its tip inwards: centres of slabs of equal geodesic distance.
std::vector<Station> centre_line(const Body& body, const std::vector<uint32_t>& limb) {
  constexpr uint32_t slab_steps = 25;  // two and a half voxels
  std::vector<Centroid> centres;
  std::vector<size_t> counts;
  const uint32_t tip_steps = body.from_core.steps[limb.front()];
  for (const uint32_t v : limb) {
    const size_t slab = (tip_steps - body.from_core.steps[v]) / slab_steps;
    if (slab >= centres.size()) {
      centres.resize(slab + 1);
      counts.resize(slab + 1, 0);
    }
    centres[slab].add(body.interior.point(v), centre_weight(static_cast<double>(body.interior.depth_m[v])));
    ++counts[slab];
  }
  std::vector<Station> line;
  for (size_t s = 0; s < centres.size(); ++s)
    if (centres[s].weight > 0)
      line.push_back(
          {centres[s].mean(), 0, static_cast<double>(counts[s]) * std::pow(body.voxel(), 2) * 10 / slab_steps});
  const std::vector<Station> rough = line;
  for (size_t s = 1; s + 1 < line.size(); ++s)
    line[s].p = 0.25 * rough[s - 1].p + 0.5 * rough[s].p + 0.25 * rough[s + 1].p;
  Vector3d before = body.interior.point(limb.front());
  double along = 0;
  for (Station& station : line) {
    along += (station.p - before).norm();
    station.along = along;
    before = station.p;
  }
  return line;
}

/// Cuts an arm's centre line where the section swells into the trunk.
void cut_at_trunk(const Body& body, std::vector<Station>& line) {
  const double forearm = 0.17 * body.stature, upper_arm = 0.27 * body.stature;  // from the fingertips
  constexpr double swollen = 2;                                                 // of the widest section of the forearm
  double widest = 0;
  for (size_t s = 0; s < line.size(); ++s) {
    if (line[s].along < forearm) continue;
    if (line[s].along < upper_arm) {
      widest = std::max(widest, line[s].area_m2);
    } else if (line[s].area_m2 > swollen * widest) {
      line.resize(s);
      break;
    }
  }
  if (line.size() > 2) line.pop_back();  // the last slab is cut off by the end of the limb
}

/// The mean of places, each as likely as a normal distribution has it whose squared deviations are the costs. Unlike
/// the cheapest place it does not jump where several are about as cheap.
class LikelyPlace {
 public:
  void add(const Vector3d& p, double cost) {
    places_.emplace_back(p, cost);
    least_ = std::min(least_, cost);
  }
  std::optional<Vector3d> mean() const {
    if (places_.empty()) return std::nullopt;
    Centroid centroid;
    for (const auto& [p, cost] : places_) centroid.add(p, std::exp(-0.5 * (cost - least_)));
    return centroid.mean();
  }

 private:
  std::vector<std::pair<Vector3d, double>> places_;
  double least_ = std::numeric_limits<double>::infinity();
};

/// The shoulder's outline from the front: the highest inside of every column of x.
std::vector<double> outline_from_above(const Body& body) {
  std::vector<double> top(static_cast<size_t>(body.interior.grid.size[0]), -std::numeric_limits<double>::infinity());
  for (const uint32_t v : body.interior.inside) {
    const auto [i, j, k] = body.interior.cell(v);
    top[static_cast<size_t>(i)] = std::max(top[static_cast<size_t>(i)], body.row_y(j) + 0.5 * body.voxel());
  }
  return top;
}

/// The shoulder joint lies under the outline of shoulder and arm as deep as the joint's cover: on the path of the
/// centre of a ball rolled along the outline from within. Where on the path: by breadth and length of the upper arm.
Vector3d shoulder_joint(const Body& body, const std::vector<double>& outline, double cover, double middle, size_t side,
                        const TrunkJoints& trunk, const std::optional<Vector3d>& elbow) {
  const double lowest = body.height(0.66), highest = trunk.neck.y();
  const double depth_z = 0.5 * (trunk.neck.z() + trunk.spine2.z());
  const double voxel = body.voxel();
  const int reach = static_cast<int>(std::ceil(cover / voxel));
  LikelyPlace likely;
  for (int i = reach; i + reach < static_cast<int>(outline.size()); ++i) {
    const double x = body.interior.grid.point(i, 0, 0).x();
    const double aside = sign(side) * (x - middle) / body.stature;
    if (aside < 0.06 || aside > 0.17) continue;
    double y = highest;
    for (int o = -reach; o <= reach; ++o) {
      const double across = cover * cover - o * o * voxel * voxel;
      if (across >= 0) y = std::min(y, outline[static_cast<size_t>(i + o)] - std::sqrt(across));
    }
    if (!(y > lowest)) continue;
    const Vector3d p(x, y, depth_z);
    const auto squared = [](double v) { return v * v; };
    const double drop = (trunk.neck.y() - p.y()) / body.stature;
    double cost = squared((aside - shoulder_half_share) / 0.012) + squared((drop - shoulder_drop_share) / 0.02);
    if (elbow) cost += squared(((p - *elbow).norm() / body.stature - upper_arm_share) / 0.015);
    likely.add(p, cost);
  }
  Vector3d best = likely.mean().value_or(
      Vector3d(middle + sign(side) * shoulder_half_share * body.stature, body.height(0.8), depth_z));
  const double near = 0.02 * body.stature;
  best.z() = centre_near(body, best, {near, near, body.stature}).z() + shoulder_ahead_share * body.stature;
  return best;
}

double distance_to_segment(const Vector3d& p, const Vector3d& a, const Vector3d& b) {
  const double length2 = (b - a).squaredNorm();
  const double t = length2 > 0 ? std::clamp((p - a).dot(b - a) / length2, 0.0, 1.0) : 0;
  return (p - a - t * (b - a)).norm();
}

/// The station at a length along the line, interpolated.
Vector3d point_along(const std::vector<Station>& line, double along) {
  for (size_t s = 1; s < line.size(); ++s)
    if (line[s].along >= along) {
      const double t =
          std::clamp((along - line[s - 1].along) / std::max(1e-9, line[s].along - line[s - 1].along), 0.0, 1.0);
      return line[s - 1].p + t * (line[s].p - line[s - 1].p);
    }
  return line.back().p;
}

/// Where the arm narrows to the wrist, near where its length says: the more clearly it does, the more that counts.
double wrist_along(const std::vector<Station>& line, double arm_length) {
  const double expected = hand_of_arm * arm_length;
  double palm = 0;
  size_t narrowest = 0;
  for (size_t s = 1; s + 1 < line.size(); ++s) {
    if (line[s].along < 0.7 * expected) palm = std::max(palm, line[s].area_m2);
    if (line[s].along < 0.7 * expected || line[s].along > 1.35 * expected) continue;
    if (line[s].area_m2 <= line[s - 1].area_m2 && line[s].area_m2 <= line[s + 1].area_m2 &&
        (narrowest == 0 || line[s].area_m2 < line[narrowest].area_m2))
      narrowest = s;
  }
  if (narrowest == 0) return expected;
  // The lowest point of the parabola through it and its neighbours lies between the stations.
  const Station &before = line[narrowest - 1], &at = line[narrowest], &after = line[narrowest + 1];
  const double rise = before.area_m2 - at.area_m2, climb = after.area_m2 - at.area_m2;
  const double spacing = 0.5 * (after.along - before.along);
  const double offset = rise + climb > 0 ? 0.5 * (rise - climb) / (rise + climb) * spacing : 0;
  constexpr double hardly = 0.95, clearly = 0.75;  // narrowest section, of the palm's
  const double share = 0.5 * std::clamp((hardly - at.area_m2 / palm) / (hardly - clearly), 0.0, 1.0);
  return (1 - share) * expected + share * (at.along + offset);
}

/// The bend of the arm: the place E for which the straight pieces wrist–E–shoulder follow the centre line best, weighed
/// against the proportions of the arm. The centre line rounds the corner, so E may lie somewhat outside of it.
Vector3d find_elbow(const Body& body, const std::vector<Station>& line, double wrist) {
  const double arm_length = line.back().along;
  const double expected = hand_of_arm + forearm_of_arm;
  const double tolerance = 0.005 * body.stature;
  size_t first = 0;
  while (first + 1 < line.size() && line[first].along < wrist) ++first;
  const Vector3d from = line[first].p, to = line.back().p;
  LikelyPlace likely;
  for (double share = 0.48; share < 0.75; share += 0.005) {
    if (share * arm_length <= line[first].along) continue;
    const Vector3d on_line = point_along(line, share * arm_length);
    const double t = std::clamp((on_line - from).dot(to - from) / (to - from).squaredNorm(), 0.0, 1.0);
    const Vector3d bow = on_line - from - t * (to - from);
    for (const double outside : {0.0, 0.1, 0.2, 0.3, 0.4}) {
      const Vector3d elbow = on_line + outside * bow;
      double misfit = 0;
      for (size_t s = first; s < line.size(); ++s) {
        const double d =
            std::min(distance_to_segment(line[s].p, from, elbow), distance_to_segment(line[s].p, elbow, to));
        misfit += d * d;
      }
      misfit /= static_cast<double>(line.size() - first) * tolerance * tolerance;
      const double unusual = (share - expected) / 0.025;
      const double cost = misfit + unusual * unusual;
      likely.add(elbow, cost);
    }
  }
  return likely.mean().value_or(point_along(line, expected * arm_length));
}

/// The centre line continued straight to a point.
void continue_to(const Body& body, const Vector3d& to, std::vector<Station>& line) {
  const Vector3d from = line.back().p;
  const double gap = (to - from).norm(), start = line.back().along;
  const int pieces = std::max(1, static_cast<int>(std::lround(gap / (2.5 * body.voxel()))));
  for (int n = 1; n <= pieces; ++n) {
    const double t = static_cast<double>(n) / pieces;
    line.push_back({from + t * (to - from), start + t * gap, 0});
  }
}

/// Where an arm meets the trunk before its elbow, its forearm is continued to where the elbow should be.
void continue_to_elbow(const Body& body, std::vector<Station>& line) {
  const double missing = (hand_of_arm + forearm_of_arm) * arm_share * body.stature - line.back().along;
  if (missing <= 0) return;
  const Vector3d before = point_along(line, line.back().along - 0.06 * body.stature);
  const Vector3d direction = line.back().p - before;
  if (!(direction.norm() > 0)) return;
  continue_to(body, line.back().p + missing * direction.normalized(), line);
}

/// How deep the shoulder joint lies: usual for the stature, more under strong arms and thick sleeves.
double shoulder_cover(const Body& body, const std::vector<Station>& line) {
  const double usual = shoulder_cover_share * body.stature;
  std::vector<double> areas;
  for (const Station& s : line)
    if (s.along > 0.24 * body.stature && s.area_m2 > 0) areas.push_back(s.area_m2);
  if (areas.empty()) return usual;
  std::nth_element(areas.begin(), areas.begin() + static_cast<std::ptrdiff_t>(areas.size() / 2), areas.end());
  const double radius = std::sqrt(areas[areas.size() / 2] / std::numbers::pi);
  return 0.5 * usual + 0.5 * std::clamp(radius, 0.015 * body.stature, 0.055 * body.stature);
}

/// The joints along a limb, or nothing where it is too short for an arm: then it is an elbow that sticks out.
std::optional<ArmJoints> trace_arm(const Body& body, const std::vector<uint32_t>& limb,
                                   const std::vector<double>& outline, double middle, size_t side,
                                   const TrunkJoints& trunk, std::vector<std::string>& warnings) {
  std::vector<Station> line = centre_line(body, limb);
  cut_at_trunk(body, line);
  const double cover = shoulder_cover(body, line);
  const Vector3d shoulder = shoulder_joint(body, outline, cover, middle, side, trunk, std::nullopt);
  if (line.back().along + (line.back().p - shoulder).norm() < shortest_arm_share * body.stature) return std::nullopt;
  continue_to_elbow(body, line);
  ArmJoints arm;
  arm.fingers = body.interior.point(limb.front());
  std::optional<Vector3d> elbow;
  constexpr int rounds = 2;  // the shoulder's place depends on the elbow's and the other way round
  for (int round = 0; round < rounds; ++round) {
    arm.shoulder = shoulder_joint(body, outline, cover, middle, side, trunk, elbow);
    std::vector<Station> whole = line;
    continue_to(body, arm.shoulder, whole);
    if (whole.back().along > longest_arm_share * body.stature) {
      // Something is held: count the arm from the shoulder.
      const double spare = whole.back().along - arm_share * body.stature;
      if (round == 0)
        warnings.push_back(std::string("the ") + name(side) + " arm is too long; what it holds was left out");
      std::erase_if(whole, [&](const Station& s) { return s.along < spare; });
      for (Station& s : whole) s.along -= spare;
      arm.fingers = whole.front().p;
    }
    const double wrist = wrist_along(whole, whole.back().along);
    arm.wrist = point_along(whole, wrist);
    arm.elbow = find_elbow(body, whole, wrist);
    elbow = arm.elbow;
  }
  return arm;
}

/// The body's outline on one side seen from the front: how far out it goes, row by row; minus infinity where it is not.
std::vector<double> outline_aside(const Body& body, size_t side) {
  std::vector<double> out(static_cast<size_t>(body.interior.grid.size[1]), -std::numeric_limits<double>::infinity());
  for (const uint32_t v : body.interior.inside) {
    const auto [i, j, k] = body.interior.cell(v);
    double& farthest = out[static_cast<size_t>(j)];
    farthest = std::max(farthest, sign(side) * body.interior.grid.point(i, j, k).x() + 0.5 * body.voxel());
  }
  return out;
}

/// A bone that lies along the outline, seen from the front: as long as it should be, and as deep under the outline as
/// what covers it. Among the directions in which it does, the one nearest to `expected_rad` from straight down is
/// taken.
struct BoneAlongOutline {
  double length = 0, cover = 0;
  double expected_rad = 0, spread_rad = 1;
};
Vector3d end_of(const Body& body, const std::vector<double>& outline, size_t side, const Vector3d& from,
                const BoneAlongOutline& bone) {
  const double tolerance = 0.012 * body.stature;
  constexpr double inmost_rad = -1.3, outmost_rad = 1.5, step_rad = 0.02;
  constexpr std::array<double, 4> shares{0.4, 0.6, 0.8, 1.0};  // of the bone; what covers its beginning is not known
  constexpr double worst = 16;  // where it does not fit at all, by how much does not matter
  double least = std::numeric_limits<double>::infinity();
  Vector3d best = from - bone.length * Vector3d::UnitY();
  for (double angle = inmost_rad; angle < outmost_rad; angle += step_rad) {
    const Vector3d way = bone.length * Vector3d(sign(side) * std::sin(angle), -std::cos(angle), 0);
    const double unusual = (angle - bone.expected_rad) / bone.spread_rad;
    double cost = unusual * unusual;
    for (const double share : shares) {
      const Vector3d p = from + share * way;
      const double out = outline[static_cast<size_t>(body.row(p.y()))];
      const double misfit = (sign(side) * p.x() + bone.cover - out) / tolerance;
      cost += std::min(worst, misfit * misfit) / static_cast<double>(shares.size());
    }
    if (cost < least) {
      least = cost;
      best = from + way;
    }
  }
  const double near = 0.015 * body.stature;
  best.z() = centre_near(body, best, {near, near, body.stature}).z();
  return best;
}

/// An arm whose hand cannot be told from the body: it hangs beside it or the hand rests on the hip. Seen from the front
/// it makes the outline from the shoulder down, so upper arm and forearm are laid along that.
ArmJoints hidden_arm(const Body& body, const std::vector<double>& outline, double middle, size_t side,
                     const TrunkJoints& trunk) {
  const double length = arm_share * body.stature, forearm = forearm_share * body.stature;
  constexpr double elbow_cover_share = 0.024, wrist_cover_share = 0.02;  // of stature
  const std::vector<double> aside = outline_aside(body, side);
  ArmJoints arm;
  arm.shoulder = shoulder_joint(body, outline, shoulder_cover_share * body.stature, middle, side, trunk, std::nullopt);
  arm.elbow = end_of(body, aside, side, arm.shoulder,
                     {upper_arm_share * body.stature, elbow_cover_share * body.stature, 0.15, 0.6});
  arm.wrist = end_of(body, aside, side, arm.elbow, {forearm, wrist_cover_share * body.stature, 0, 0.6});
  arm.fingers = arm.wrist + hand_of_arm * length * (arm.wrist - arm.elbow).normalized();
  return arm;
}

/// A leg's centre, row by row, from the floor upwards; only rows that hold the leg's whole section, which ends where
/// the limb does.
std::vector<Vector3d> leg_rows(const Body& body, const std::vector<uint32_t>& limb, double top) {
  const size_t count = static_cast<size_t>(body.interior.grid.size[1]);
  std::vector<Centroid> rows(count);
  std::vector<bool> whole(count, true);
  std::vector<bool> member(body.interior.depth_m.size(), false);
  for (const uint32_t v : limb) member[v] = true;
  const size_t plane = body.interior.index(0, 0, 1);
  for (const uint32_t v : limb) {
    const size_t row = static_cast<size_t>(body.interior.cell(v)[1]);
    rows[row].add(body.interior.point(v), centre_weight(static_cast<double>(body.interior.depth_m[v])));
    for (const size_t next : {v - size_t{1}, v + size_t{1}, v - plane, v + plane})
      if (body.interior.depth_m[next] > 0 && !member[next]) whole[row] = false;
  }
  std::vector<Vector3d> line;
  for (size_t row = 0; row < count; ++row)
    if (rows[row].weight > 0 && whole[row] && rows[row].mean().y() < top) line.push_back(rows[row].mean());
  return line;
}

/// The straight line through the rows of a leg within some heights, at another height.
std::optional<Vector3d> extrapolate(const std::vector<Vector3d>& rows, double low, double high, double y) {
  std::vector<Vector3d> used;
  Vector3d mean = Vector3d::Zero();
  for (const Vector3d& p : rows)
    if (p.y() >= low && p.y() <= high) {
      used.push_back(p);
      mean += p;
    }
  if (used.size() < 3) return std::nullopt;
  mean /= static_cast<double>(used.size());
  double spread = 0;
  Vector3d slope = Vector3d::Zero();
  for (const Vector3d& p : used) {
    spread += (p.y() - mean.y()) * (p.y() - mean.y());
    slope += (p.y() - mean.y()) * (p - mean);
  }
  return mean + (y - mean.y()) / spread * slope;
}

/// The lowest row, upwards from the shins, in which both legs are one; that is the crotch, or the hem of a skirt.
double where_legs_meet(const Body& body, const std::vector<Vector3d>& left_rows,
                       const std::vector<Vector3d>& right_rows) {
  for (double y = body.height(0.12); y < body.height(0.6); y += body.voxel()) {
    const auto at = [&](const std::vector<Vector3d>& rows) {
      double x = rows.front().x();
      for (const Vector3d& p : rows)
        if (p.y() <= y + 0.5 * body.voxel()) x = p.x();
      return x;
    };
    const Run run = run_at(body, y, at(left_rows));
    if (!run.empty() && run.low < at(right_rows)) return y;
  }
  return body.height(0.6);
}

/// The ankle over a foot of which only the lowest part can be seen.
std::optional<Vector3d> ankle_over_foot(const Body& body, const std::vector<uint32_t>& limb, double ankle_y) {
  Centroid foot;
  for (const uint32_t v : limb)
    if (const Vector3d p = body.interior.point(v); p.y() < body.height(0.05)) foot.add(p, 1);
  if (!(foot.weight > 0)) return std::nullopt;
  constexpr double behind_middle_share = 0.025;
  return Vector3d(foot.mean().x(), ankle_y, foot.mean().z() - behind_middle_share * body.stature);
}

void add_foot(const Body& body, const std::vector<uint32_t>& limb, LegJoints& leg) {
  // The foot points from the ankle to the middle of what lies before it; the toes are as far that way as it reaches.
  Centroid foot;
  const auto flat = [&](const Vector3d& p) { return Vector3d(p.x() - leg.ankle.x(), 0, p.z() - leg.ankle.z()); };
  for (const uint32_t v : limb)
    if (const Vector3d p = body.interior.point(v); p.y() < body.height(0.05) && p.z() > leg.ankle.z())
      foot.add(flat(p), 1);
  Vector3d forwards = Vector3d::UnitZ();
  double reach = 0;
  constexpr double most_turned = 0.5;  // cosine: feet point to the front
  if (foot.weight > 0) {
    const Vector3d middle = foot.mean();
    if (middle.z() > most_turned * middle.norm()) forwards = middle.normalized();
    for (const uint32_t v : limb)
      if (const Vector3d p = body.interior.point(v); p.y() < body.height(0.05))
        reach = std::max(reach, flat(p).dot(forwards));
  }
  const double usual = 0.7 * foot_share * body.stature;
  leg.toes = leg.ankle + (reach > 0 ? reach : usual) * forwards;
  leg.toes.y() = body.height(0.012);
  leg.ball = leg.ankle + ball_of_foot * (leg.toes - leg.ankle);
  leg.ball.y() = body.height(0.018);
}

// ---- trunk ---------------------------------------------------------------------------------------------------------

struct NeckMeasure {
  double y = 0;      // of the narrowest part
  bool seen = true;  // false: covered by hair or a hood
};

double middle_of_head(const Body& body, const Ends& ends) {
  const double crown_x = body.interior.point(ends.head).x();
  const Run run = run_at(body, body.height(0.95), crown_x);
  return run.empty() ? crown_x : 0.5 * (run.low + run.high);
}

NeckMeasure find_neck(const Body& body, double x) {
  NeckMeasure neck{body.height(neck_height_share), false};
  double narrowest = std::numeric_limits<double>::infinity(), head = 0;
  // From the crown downwards; the head is the widest so far, the neck the narrowest below it.
  double head_y = body.height(1);
  for (double y = body.height(0.985); y > body.height(0.76); y -= body.voxel()) {
    const double width = run_at(body, y, x).width();
    if (width <= 0) continue;
    if (width > head && y > body.height(0.86)) {
      if (narrowest > 0.8 * head) narrowest = std::numeric_limits<double>::infinity();
      head = width;
      head_y = y;
    }
    if (width < narrowest && y < head_y) {
      narrowest = width;
      neck.y = y;
    }
    if (narrowest < 0.85 * head && width > 1.5 * narrowest) break;  // shoulders
  }
  // The narrowest part is a stretch: take its middle, rows counting the more the narrower they are.
  constexpr double still_narrow = 1.15;
  double sum = 0, weight = 0;
  for (double y = neck.y + 0.05 * body.stature; y > neck.y - 0.05 * body.stature; y -= body.voxel())
    if (const double width = run_at(body, y, x).width(); width > 0 && width < still_narrow * narrowest) {
      sum += (still_narrow * narrowest - width) * y;
      weight += still_narrow * narrowest - width;
    }
  neck.seen = narrowest < 0.85 * head && weight > 0;
  neck.y = neck.seen ? sum / weight : body.height(neck_height_share);
  return neck;
}

/// Hip joints' height from the crotch, checked against stature and the size of the head: the smaller the person, the
/// larger the head and the shorter the legs (Snyder et al., "Anthropometry of infants, children and youths", 1977:
/// heads of 0.18 and hips at 0.46 of stature at the age of three).
double hip_height(const Body& body, const NeckMeasure& neck, std::optional<double> crotch,
                  std::vector<std::string>& warnings) {
  const double head_share = neck.seen ? 1 - (neck.y - body.floor) / body.stature : adult_head_share;
  const double usual = std::clamp(hip_height_share - (head_share - adult_head_share), 0.42, 0.53);
  if (!crotch) return body.height(usual);
  const double crotch_height = *crotch - body.floor;
  const double measured = hip_of_crotch * crotch_height / body.stature;
  if (measured > 0.58) {
    warnings.emplace_back("no crotch was found; the hips were placed by proportions");
    return body.height(usual);
  }
  // Clothes and what no camera can look behind make the crotch too low, nothing makes it too high: the lower, the less
  // it says, unless the head tells nothing of the proportions.
  constexpr double measured_share = 0.7, usual_drop = 0.01;
  const double spread = neck.seen ? 0.02 : 0.05;
  const double drop = usual - measured;
  const double beyond = std::max(0.0, drop - usual_drop) / spread;
  const double share = measured_share * std::exp(-beyond * beyond);
  constexpr double doubtful_drop = 0.045;
  if (drop > doubtful_drop)
    warnings.emplace_back("the legs are one down to " + std::to_string(std::lround(100 * crotch_height)) +
                          " cm (a skirt, or too few cameras?); the hips were placed by proportions");
  return body.height(share * measured + (1 - share) * usual);
}

TrunkJoints place_trunk(const Body& body, const Ends& ends, const NeckMeasure& neck, double head_x, double hip_y,
                        double hip_x) {
  const double h = body.stature;
  const double head_height = body.height(1) - neck.y;
  TrunkJoints trunk;

  Vector3d skull =
      centre_near(body, {head_x, body.height(1) - 0.4 * head_height, 0.5 * (body.interior.point(ends.head).z())},
                  {0.08 * h, 0.25 * head_height, h});
  // Hair hides where the head ends behind, not where the face is.
  const Run head = depth_run(body, head_x, skull.y(), 0.02 * h, 0.02 * h);
  if (head.width() > longest_head_share * h) skull.z() = head.high - head_front_share * h;
  const auto spine_at = [&](double y, double x, double of_depth) {
    const Run run = depth_run(body, x, y, 0.02 * h, 0.015 * h);
    const double depth = std::min(run.width(), deepest_trunk_share * h);
    const double z = run.empty() ? skull.z() : 0.5 * (run.low + run.high) - (0.5 - of_depth) * depth;
    return Vector3d(x, y, z);
  };
  const double neck_y = neck.y - 0.25 * head_height;
  const auto x_at = [&](double y) { return hip_x + (skull.x() - hip_x) * (y - hip_y) / (skull.y() - hip_y); };
  const auto trunk_at = [&](double share, double of_depth = spine_of_trunk_depth) {
    const double y = hip_y + share * (neck_y - hip_y);
    return spine_at(y, x_at(y), of_depth);
  };
  trunk.pelvis = trunk_at(0);
  trunk.hips = trunk_at(0, sacrum_of_trunk_depth);
  trunk.spine = trunk_at(0.06);
  trunk.spine1 = trunk_at(0.30);
  trunk.spine2 = trunk_at(0.62);
  trunk.head = {skull.x(), neck.y + 0.22 * head_height, skull.z() - 0.01 * h};
  Vector3d throat = centre_near(body, {x_at(neck_y), neck_y, skull.z()}, {0.03 * h, 0.015 * h, h});
  if (!neck.seen) throat.z() = std::max(throat.z(), skull.z() - 0.02 * h);
  trunk.neck = {0.5 * (throat.x() + x_at(neck_y)), neck_y,
                0.5 * throat.z() + 0.25 * (trunk.spine2.z() + trunk.head.z())};
  trunk.crown = {skull.x(), body.height(1) - 0.01 * h, skull.z()};
  return trunk;
}

// ---- the joint tree ------------------------------------------------------------------------------------------------

/// A frame at `at` with +Y along `along` and +Z as near to `ahead` as that leaves it.
Eigen::Isometry3d bone_frame(const Vector3d& at, const Vector3d& along, const Vector3d& ahead) {
  Vector3d y = along.normalized();
  if (!(along.norm() > 1e-9)) y = Vector3d::UnitY();
  Vector3d reference = ahead;
  constexpr double nearly_parallel = 0.95;
  if (std::abs(y.dot(reference)) > nearly_parallel)
    reference = std::abs(ahead.y()) > 0.5 ? Vector3d::UnitZ() : Vector3d::UnitY();
  const Vector3d z = (reference - reference.dot(y) * y).normalized();
  Eigen::Isometry3d frame = Eigen::Isometry3d::Identity();
  frame.linear().col(0) = y.cross(z);
  frame.linear().col(1) = y;
  frame.linear().col(2) = z;
  frame.translation() = at;
  return frame;
}

class SkeletonBuilder {
 public:
  /// Adds a joint at `at` whose bone ends at `to`.
  int add(const std::string& joint, int parent, const Vector3d& at, const Vector3d& to, const Vector3d& ahead) {
    world_.push_back(bone_frame(at, to - at, ahead));
    const Eigen::Isometry3d& world = world_.back();
    skeleton_.joints.push_back(
        {joint, parent, parent < 0 ? world : world_[static_cast<size_t>(parent)].inverse() * world});
    return static_cast<int>(world_.size()) - 1;
  }
  Skeleton take() { return std::move(skeleton_); }

 private:
  Skeleton skeleton_;
  std::vector<Eigen::Isometry3d> world_;
};

Skeleton build(const BodyJoints& body) {
  const auto& [trunk, arms, legs] = body;
  const Vector3d forward = Vector3d::UnitZ(), up = Vector3d::UnitY();
  SkeletonBuilder tree;
  const int hips = tree.add("Hips", -1, trunk.hips, trunk.spine, forward);
  const int spine = tree.add("Spine", hips, trunk.spine, trunk.spine1, forward);
  const int spine1 = tree.add("Spine1", spine, trunk.spine1, trunk.spine2, forward);
  const int spine2 = tree.add("Spine2", spine1, trunk.spine2, trunk.neck, forward);
  const int neck = tree.add("Neck", spine2, trunk.neck, trunk.head, forward);
  const int head = tree.add("Head", neck, trunk.head, trunk.crown, forward);
  tree.add("HeadTop_End", head, trunk.crown, trunk.crown + (trunk.crown - trunk.head), forward);
  for (const size_t side : {left, right}) {
    const std::string prefix = side == left ? "Left" : "Right";
    const ArmJoints& arm = arms[side];
    const int clavicle = tree.add(prefix + "Shoulder", spine2, arm.clavicle, arm.shoulder, forward);
    const int upper = tree.add(prefix + "Arm", clavicle, arm.shoulder, arm.elbow, forward);
    const int lower = tree.add(prefix + "ForeArm", upper, arm.elbow, arm.wrist, forward);
    tree.add(prefix + "Hand", lower, arm.wrist, arm.fingers, forward);
  }
  for (const size_t side : {left, right}) {
    const std::string prefix = side == left ? "Left" : "Right";
    const LegJoints& leg = legs[side];
    const int upper = tree.add(prefix + "UpLeg", hips, leg.hip, leg.knee, forward);
    const int lower = tree.add(prefix + "Leg", upper, leg.knee, leg.ankle, forward);
    const int foot = tree.add(prefix + "Foot", lower, leg.ankle, leg.ball, up);
    tree.add(prefix + "ToeBase", foot, leg.ball, leg.toes, up);
  }
  return tree.take();
}

// ---- the whole ----------------------------------------------------------------------------------------------------

struct Subject {
  Body body;
  Ends ends;
};

Result<Subject> find_subject(const Mesh& mesh, const SkeletonOptions& options) {
  auto measured = measure(mesh, options);
  if (!measured) return measured.error();
  Subject subject{std::move(measured).value(), {}};
  Body& body = subject.body;
  const auto core = find_core(body);
  if (!core) return not_riggable("the shape is empty at the height of a trunk");
  body.from_core = geodesics_from(body.interior, std::array{GeodesicSource{*core, 0}});
  constexpr double least_prominence = 0.04;  // of stature
  const auto ends =
      classify(body, find_extremities(body.interior, body.from_core,
                                      static_cast<uint32_t>(10 * least_prominence * body.stature / body.voxel())));
  if (!ends) return ends.error();
  subject.ends = *ends;
  if (!(subject.ends.hand[left] && subject.ends.hand[right]) && !subject.ends.foot[left])
    return not_riggable("neither two arms nor two legs stand out from the shape");
  return subject;
}

std::array<LegJoints, 2> place_legs(const Body& body, const std::array<std::vector<Vector3d>, 2>& rows,
                                    const std::array<std::vector<uint32_t>, 2>& limbs, const TrunkJoints& trunk,
                                    std::vector<std::string>& warnings) {
  if (limbs[left].empty())
    warnings.emplace_back("the legs cannot be told apart (a long skirt?); they were placed by proportions");
  std::array<LegJoints, 2> legs;
  const double hip_y = trunk.pelvis.y(), ankle_y = body.height(ankle_height_share);
  const double knee_y = ankle_y + knee_of_leg * (hip_y - ankle_y);
  const double near = 0.02 * body.stature;
  for (const size_t side : {left, right}) {
    LegJoints& leg = legs[side];
    const Vector3d usual_hip = trunk.pelvis + Vector3d(sign(side) * hip_half_share * body.stature, 0, 0);
    const auto ankle = extrapolate(rows[side], body.height(0.08), body.height(0.14), ankle_y);
    leg.ankle = ankle.value_or(
        ankle_over_foot(body, limbs[side], ankle_y).value_or(Vector3d(usual_hip.x(), ankle_y, usual_hip.z())));
    leg.hip = usual_hip;
    constexpr double usual_breadth = 0.7;  // where the thighs widen, their middles say little of the joints
    if (const auto axis = extrapolate(rows[side], knee_y, body.height(1), hip_y))
      leg.hip.x() = usual_breadth * usual_hip.x() + (1 - usual_breadth) * axis->x();
    leg.hip.z() = 0.7 * trunk.pelvis.z() + 0.3 * leg.ankle.z();
    const auto knee = extrapolate(rows[side], knee_y - near, knee_y + near, knee_y);
    leg.knee = knee.value_or(leg.ankle + knee_of_leg * (leg.hip - leg.ankle));
    add_foot(body, limbs[side], leg);
  }
  return legs;
}

std::array<ArmJoints, 2> place_arms(const Body& body, const std::array<std::vector<uint32_t>, 2>& limbs,
                                    const TrunkJoints& trunk, std::vector<std::string>& warnings) {
  std::array<ArmJoints, 2> arms;
  const std::vector<double> outline = outline_from_above(body);
  const double middle = trunk.neck.x();
  for (const size_t side : {left, right}) {
    ArmJoints& arm = arms[side];
    std::optional<ArmJoints> traced;
    if (!limbs[side].empty()) traced = trace_arm(body, limbs[side], outline, middle, side, trunk, warnings);
    arm = traced ? *traced : hidden_arm(body, outline, middle, side, trunk);
    if (!traced)
      warnings.push_back(std::string("the ") + name(side) +
                         " hand cannot be told from the body; the arm was placed by outline and proportions");
    arm.clavicle = {middle + sign(side) * 0.018 * body.stature,
                    arm.shoulder.y() + 0.3 * (trunk.neck.y() - arm.shoulder.y()),
                    0.5 * (trunk.neck.z() + arm.shoulder.z())};
  }
  return arms;
}

struct PlacedJoints : BodyJoints {
  std::vector<std::string> warnings;  // what could not be seen
};

/// Moves a joint along its bone until that has the length, and what hangs from it too.
void set_length(const Vector3d& from, double length, Vector3d& joint, std::initializer_list<Vector3d*> below) {
  const Vector3d bone = joint - from;
  if (!(bone.norm() > 0)) return;
  const Vector3d step = (length / bone.norm() - 1) * bone;
  joint += step;
  for (Vector3d* p : below) *p += step;
}

/// The length that both sides' bones are given: people are symmetric, so the sides' mean; where they differ a lot, the
/// one that is nearer to the usual, as the other was hidden or mistaken.
double agreed_length(double left_m, double right_m, double usual_m) {
  constexpr double similar = 0.12;
  if (std::abs(left_m - right_m) < similar * (left_m + right_m) / 2) return 0.5 * (left_m + right_m);
  return std::abs(left_m - usual_m) < std::abs(right_m - usual_m) ? left_m : right_m;
}

void make_symmetric(const Body& body, PlacedJoints& joints) {
  const double h = body.stature;
  std::array<ArmJoints, 2>& arms = joints.arms;
  const auto length = [](const Vector3d& a, const Vector3d& b) { return (a - b).norm(); };
  const double upper = agreed_length(length(arms[left].shoulder, arms[left].elbow),
                                     length(arms[right].shoulder, arms[right].elbow), upper_arm_share * h);
  const double lower = agreed_length(length(arms[left].elbow, arms[left].wrist),
                                     length(arms[right].elbow, arms[right].wrist), forearm_share * h);
  for (ArmJoints& arm : arms) {
    set_length(arm.shoulder, upper, arm.elbow, {&arm.wrist, &arm.fingers});
    set_length(arm.elbow, lower, arm.wrist, {&arm.fingers});
  }
  std::array<LegJoints, 2>& legs = joints.legs;
  const double leg_share = 0.5 * (hip_height_share - ankle_height_share);
  const double thigh =
      agreed_length(length(legs[left].hip, legs[left].knee), length(legs[right].hip, legs[right].knee), leg_share * h);
  const double shin = agreed_length(length(legs[left].knee, legs[left].ankle),
                                    length(legs[right].knee, legs[right].ankle), leg_share * h);
  for (LegJoints& leg : legs) {
    // From the ankle upwards: the feet stand where they stand.
    const Vector3d knee = leg.knee;
    set_length(leg.ankle, shin, leg.knee, {});
    leg.hip += leg.knee - knee;
    set_length(leg.knee, thigh, leg.hip, {});
  }
}

PlacedJoints place_joints(const Subject& subject) {
  const Body& body = subject.body;
  const Ends& ends = subject.ends;
  PlacedJoints result;

  std::vector<size_t> tips{ends.head};
  for (const auto& pair : {ends.hand, ends.foot})
    for (const auto& tip : pair)
      if (tip) tips.push_back(*tip);
  std::vector<std::vector<uint32_t>> limbs = limbs_of(body.interior, body.from_core, tips);
  std::array<std::vector<uint32_t>, 2> arm_limbs, leg_limbs;
  size_t next = 1;
  for (const size_t side : {left, right})
    if (ends.hand[side]) arm_limbs[side] = std::move(limbs[next++]);
  for (const size_t side : {left, right})
    if (ends.foot[side]) leg_limbs[side] = std::move(limbs[next++]);

  // Legs up to the crotch, and with it the height of the hips.
  std::array<std::vector<Vector3d>, 2> rows;
  for (const size_t side : {left, right}) rows[side] = leg_rows(body, leg_limbs[side], body.height(0.6));
  std::optional<double> crotch;
  if (!rows[left].empty() && !rows[right].empty()) {
    crotch = where_legs_meet(body, rows[left], rows[right]);
    for (auto& side : rows)
      std::erase_if(side, [&](const Vector3d& p) { return p.y() > *crotch - 0.02 * body.stature; });
  }
  const double head_x = middle_of_head(body, ends);
  const NeckMeasure neck = find_neck(body, head_x);
  if (!neck.seen) result.warnings.emplace_back("no neck was seen (long hair or a hood?); it was placed by proportions");
  const double hip_y = hip_height(body, neck, crotch, result.warnings);
  double hip_x = head_x;
  if (const Run run = run_at(body, hip_y, head_x); !run.empty()) {
    // The trunk's middle; arms that touch it there are cut off at what hips measure.
    const double half = 0.14 * body.stature;
    hip_x = 0.5 * (std::max(run.low, head_x - half) + std::min(run.high, head_x + half));
  }

  TrunkJoints& trunk = result.trunk;
  trunk = place_trunk(body, ends, neck, head_x, hip_y, hip_x);
  result.legs = place_legs(body, rows, leg_limbs, trunk, result.warnings);
  result.arms = place_arms(body, arm_limbs, trunk, result.warnings);
  make_symmetric(body, result);

  for (Vector3d* p : {&trunk.hips, &trunk.spine, &trunk.spine1, &trunk.spine2, &trunk.neck, &trunk.head, &trunk.crown})
    *p = pulled_inside(body, *p);
  for (const size_t side : {left, right}) {
    ArmJoints& arm = result.arms[side];
    LegJoints& leg = result.legs[side];
    for (Vector3d* p :
         {&arm.clavicle, &arm.shoulder, &arm.elbow, &arm.wrist, &leg.hip, &leg.knee, &leg.ankle, &leg.ball})
      *p = pulled_inside(body, *p);
  }
  return result;
}

// ---- the person's own axes -----------------------------------------------------------------------------------------

/// The rotation to axes of which y runs along `up` and x as near to `across` as that leaves it.
Eigen::Matrix3d facing_from_world(const Vector3d& up, const Vector3d& across) {
  Eigen::Matrix3d rotation;
  rotation.row(1) = up.normalized();
  rotation.row(0) = (across - across.dot(rotation.row(1)) * rotation.row(1).transpose()).normalized();
  rotation.row(2) = rotation.row(0).cross(rotation.row(1));
  return rotation;
}

/// Whether these may be the axes of a person who stands facing about +Z.
bool plausible(const Eigen::Matrix3d& rotation) {
  constexpr double largest_tilt_rad = 0.3, largest_turn_rad = 0.9;
  return rotation(1, 1) > std::cos(largest_tilt_rad) && rotation(0, 0) > std::cos(largest_turn_rad);
}

/// The axes of the mass: a standing person is tallest along the first and, arms included, broadest along the second.
/// They turn exactly as the body does, however it stands.
Eigen::Matrix3d axes_of_mass(const Mesh& mesh) {
  Vector3d origin = Vector3d::Zero();
  for (const auto& p : mesh.positions) origin += p.cast<double>() / static_cast<double>(mesh.positions.size());
  double volume = 0;
  Vector3d first = Vector3d::Zero();
  Eigen::Matrix3d second = Eigen::Matrix3d::Zero();
  for (const auto& t : mesh.triangles) {
    const Vector3d a = mesh.positions[t[0]].cast<double>() - origin, b = mesh.positions[t[1]].cast<double>() - origin,
                   c = mesh.positions[t[2]].cast<double>() - origin;
    const double six_volumes = a.dot(b.cross(c));
    const Vector3d sum = a + b + c;
    volume += six_volumes / 6;
    first += six_volumes / 24 * sum;
    second += six_volumes / 120 * (a * a.transpose() + b * b.transpose() + c * c.transpose() + sum * sum.transpose());
  }
  if (!(volume > 0)) return Eigen::Matrix3d::Identity();
  const Eigen::Matrix3d covariance = second / volume - first * first.transpose() / (volume * volume);
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> axes(covariance);  // ascending
  constexpr double clearly = 1.4;  // ratio of the variances, below which an axis is not to be told from the next
  Vector3d up = Vector3d::UnitY(), across = Vector3d::UnitX();
  if (axes.eigenvalues()[2] > clearly * axes.eigenvalues()[1]) up = axes.eigenvectors().col(2);
  if (axes.eigenvalues()[1] > clearly * axes.eigenvalues()[0]) across = axes.eigenvectors().col(1);
  if (up.y() < 0) up = -up;
  if (across.x() < 0) across = -across;
  const Eigen::Matrix3d rotation = facing_from_world(up, across);
  return plausible(rotation) ? rotation : Eigen::Matrix3d::Identity();
}

/// The person's own axes from the joints: up from the ankles to the neck, across as hands, feet and shoulders have it
/// in their majority, as a step or a raised arm turns one of them alone.
Eigen::Matrix3d axes_of_joints(const PlacedJoints& joints, const Ends& ends) {
  const auto turn = [](const Vector3d& of_left, const Vector3d& of_right) {
    const Vector3d across = of_left - of_right;
    return std::atan2(-across.z(), across.x());
  };
  std::vector<double> turns{turn(joints.arms[left].shoulder, joints.arms[right].shoulder)};
  if (ends.hand[left] && ends.hand[right]) turns.push_back(turn(joints.arms[left].wrist, joints.arms[right].wrist));
  if (ends.foot[left]) turns.push_back(turn(joints.legs[left].ankle, joints.legs[right].ankle));
  std::sort(turns.begin(), turns.end());
  const double middle = turns.size() == 2 ? 0.5 * (turns[0] + turns[1]) : turns[turns.size() / 2];
  const Vector3d up = joints.trunk.neck - 0.5 * (joints.legs[left].ankle + joints.legs[right].ankle);
  const Eigen::Matrix3d rotation = facing_from_world(up, {std::cos(middle), 0, -std::sin(middle)});
  return plausible(rotation) ? rotation : Eigen::Matrix3d::Identity();
}

Mesh turned(const Mesh& mesh, const Eigen::Matrix3d& rotation) {
  Mesh result = mesh;
  for (auto& p : result.positions) p = (rotation * p.cast<double>()).cast<float>();
  return result;
}

}  // namespace

Result<FittedSkeleton> fit_skeleton(const Mesh& mesh, const SkeletonOptions& options, const Work& work) {
  if (options.cells < 100 || options.cells > 400)
    return Error{ErrorCode::invalid_argument,
                 "skeleton.cells: " + std::to_string(options.cells) + ", expected 100 … 400"};
  if (const auto checked = check(mesh); !checked) return checked.error();

  if (options.method == SkeletonMethod::embedding) {
    auto embedded = embed_skeleton(sample_interior(mesh, options.cells));
    if (!embedded) return not_riggable(embedded.error().message);
    work.report(1);
    return FittedSkeleton{build(*embedded), {}};
  }

  // First coarsely along the axes of the mass, which gives the person's own axes; then finely along these.
  Eigen::Matrix3d rotation = axes_of_mass(mesh);
  constexpr int coarse_cells = 100;
  const auto coarse = find_subject(turned(mesh, rotation), {.cells = coarse_cells, .method = options.method});
  if (work.stopped()) return Work::cancelled();
  rotation = coarse ? (axes_of_joints(place_joints(*coarse), coarse->ends) * rotation).eval()
                    : Eigen::Matrix3d::Identity().eval();
  work.report(0.2);
  const auto subject = find_subject(turned(mesh, rotation), options);
  if (!subject) return subject.error();
  if (work.stopped()) return Work::cancelled();
  PlacedJoints joints = place_joints(*subject);

  FittedSkeleton result{build(joints), std::move(joints.warnings)};
  Joint& root = result.skeleton.joints.front();
  root.parent_from_joint = Eigen::Isometry3d(Eigen::Quaterniond(rotation.transpose())) * root.parent_from_joint;
  work.report(1);
  return result;
}

}  // namespace booth
