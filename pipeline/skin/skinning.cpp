#include "pipeline/skin/skinning.h"

#include <Eigen/Geometry>
#include <Eigen/Sparse>
#include <Eigen/SparseCholesky>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <functional>
#include <limits>
#include <optional>
#include <queue>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/geometry/interior.h"

namespace booth {
namespace {

using Eigen::Vector3d;

/// What moves with a joint: a straight piece of the body's inside.
struct Bone {
  Vector3d from, to;
  size_t joint = 0;
};

bool ends_with(const std::string& text, const std::string& end) {
  return text.size() >= end.size() && text.compare(text.size() - end.size(), end.size(), end) == 0;
}

/// How far the inside reaches from a joint along its +Y.
double reach_inside(const Interior& interior, const Eigen::Isometry3d& joint) {
  const double step = interior.grid.voxel_m;
  double length = 0;
  while (interior.depth(joint.translation() + (length + step) * joint.linear().col(1)) > 0) length += step;
  return length;
}

std::vector<Bone> bones_of(const Skeleton& skeleton, const std::vector<Eigen::Isometry3d>& world,
                           const Interior& interior) {
  std::vector<Bone> bones;
  std::vector<bool> has_child(skeleton.joints.size(), false);
  for (size_t j = 0; j < skeleton.joints.size(); ++j) {
    if (skeleton.joints[j].parent < 0) continue;
    const size_t parent = static_cast<size_t>(skeleton.joints[j].parent);
    has_child[parent] = true;
    bones.push_back({world[parent].translation(), world[j].translation(), parent});
  }
  for (size_t j = 0; j < skeleton.joints.size(); ++j) {
    if (has_child[j] || ends_with(skeleton.joints[j].name, "_End")) continue;
    const Vector3d at = world[j].translation();
    bones.push_back({at, at + reach_inside(interior, world[j]) * world[j].linear().col(1), j});
  }
  return bones;
}

/// Where the trunk and the arms divide the chest: the ribs are wider than deep, so the bones of the trunk get a copy
/// to either side, as far out as hips and ribs go; and what lies over the inner half of a clavicle goes with them.
void shape_trunk(const Skeleton& skeleton, const std::vector<Eigen::Isometry3d>& world, std::vector<Bone>& bones) {
  constexpr double of_hips = 0.8, of_shoulders = 0.62;  // breadth of the column of bones, of that between the joints
  constexpr double inner_clavicle = 0.5;
  const auto joint_of = [&](const char* name) -> std::optional<Vector3d> {
    const int joint = skeleton.find(name);
    if (joint < 0) return std::nullopt;
    return world[static_cast<size_t>(joint)].translation();
  };
  const auto hips = joint_of("Hips"), neck = joint_of("Neck"), left_hip = joint_of("LeftUpLeg"),
             right_hip = joint_of("RightUpLeg"), left_arm = joint_of("LeftArm"), right_arm = joint_of("RightArm");
  if (!hips || !neck || !left_hip || !right_hip || !left_arm || !right_arm) return;
  const Vector3d up = *neck - *hips;
  const auto aside = [&](const Vector3d& p) -> Vector3d {
    const double t = std::clamp((p - *hips).dot(up) / up.squaredNorm(), 0.0, 1.0);
    return 0.5 * ((1 - t) * of_hips * (*left_hip - *right_hip) + t * of_shoulders * (*left_arm - *right_arm));
  };
  std::vector<Bone> ribs;
  for (const char* name : {"Hips", "Spine", "Spine1", "Spine2"})
    for (const Bone& bone : bones) {
      const Vector3d along = bone.to - bone.from;
      constexpr double upright = 0.5;
      if (static_cast<int>(bone.joint) != skeleton.find(name) || along.dot(up) < upright * along.norm() * up.norm())
        continue;
      // Below the neck the ribs close in under the shoulders.
      const Vector3d to = bone.to == *neck ? Vector3d(0.5 * (bone.from + bone.to)) : bone.to;
      for (const double side : {1.0, -1.0})
        ribs.push_back({bone.from + side * aside(bone.from), to + side * aside(to), bone.joint});
    }
  bones.insert(bones.end(), ribs.begin(), ribs.end());
  for (Bone& bone : bones)
    for (const char* name : {"LeftShoulder", "RightShoulder"})
      if (static_cast<int>(bone.joint) == skeleton.find(name)) bone.from += inner_clavicle * (bone.to - bone.from);
}

/// The face goes with the head, chin included, which lies beside the neck: a second bone runs from the skull's base
/// towards the chin.
void add_jaw(const Skeleton& skeleton, const std::vector<Eigen::Isometry3d>& world, std::vector<Bone>& bones) {
  constexpr double forward = 0.6, down = 0.25;  // of the length of the skull
  const int head = skeleton.find("Head"), top = skeleton.find("HeadTop_End");
  if (head < 0 || top < 0) return;
  const Eigen::Isometry3d& base = world[static_cast<size_t>(head)];
  const double length = (world[static_cast<size_t>(top)].translation() - base.translation()).norm();
  bones.push_back(
      {base.translation(), base * Vector3d(0, -down * length, forward * length), static_cast<size_t>(head)});
}

/// The heel goes with the foot, though it lies below the end of the shin: a second bone of the foot runs down to it.
void add_heels(const Skeleton& skeleton, const std::vector<Eigen::Isometry3d>& world, std::vector<Bone>& bones) {
  constexpr double backwards = 0.45;  // of the way from the ankle forwards to the ball of the foot
  for (const std::string side : {"Left", "Right"}) {
    const int shin = skeleton.find(side + "Leg"), foot = skeleton.find(side + "Foot"),
              ball = skeleton.find(side + "ToeBase");
    if (shin < 0 || foot < 0 || ball < 0) continue;
    const Vector3d ankle = world[static_cast<size_t>(foot)].translation();
    const Vector3d down = (ankle - world[static_cast<size_t>(shin)].translation()).normalized();
    const Vector3d way = world[static_cast<size_t>(ball)].translation() - ankle;
    const Vector3d forwards = way - way.dot(down) * down;
    bones.push_back({ankle, ankle + way.dot(down) * down - backwards * forwards, static_cast<size_t>(foot)});
  }
}

/// A vertex's bone and how far away that is.
struct Attachment {
  size_t joint = 0;
  double distance_m = 0;
};

double distance_to_bone(const Bone& bone, const Vector3d& p) {
  const Vector3d along = bone.to - bone.from;
  const double length2 = along.squaredNorm();
  const double t = length2 > 0 ? std::clamp((p - bone.from).dot(along) / length2, 0.0, 1.0) : 0;
  return (p - bone.from - t * along).norm();
}

/// The voxel inside that is nearest to a point of the surface, at most two voxels away.
std::optional<size_t> voxel_near(const Interior& interior, const Geodesics& geodesics, const Vector3d& p) {
  const Grid& grid = interior.grid;
  const Vector3d at = (p - grid.origin) / grid.voxel_m;
  std::optional<size_t> best;
  double nearest = std::numeric_limits<double>::infinity();
  constexpr int reach = 2;
  std::array<int, 3> low{}, high{};
  for (size_t axis = 0; axis < 3; ++axis) {
    const int middle =
        static_cast<int>(std::lround(std::clamp(at[static_cast<int>(axis)], -10.0, grid.size[axis] + 10.0)));
    low[axis] = std::max(0, middle - reach);
    high[axis] = std::min(grid.size[axis] - 1, middle + reach);
  }
  for (int k = low[2]; k <= high[2]; ++k)
    for (int j = low[1]; j <= high[1]; ++j)
      for (int i = low[0]; i <= high[0]; ++i) {
        const size_t voxel = interior.index(i, j, k);
        const double distance = (Vector3d(i, j, k) - at).squaredNorm();
        if (geodesics.steps[voxel] == Geodesics::unreached || distance >= nearest) continue;
        nearest = distance;
        best = voxel;
      }
  return best;
}

std::vector<Attachment> attach(const Mesh& mesh, const Interior& interior, const std::vector<Bone>& bones,
                               const Work& work) {
  // Ways start on the bones; where the limb is thick they have a lead, so that a thin limb beside a thick one does
  // not win its skin.
  std::vector<GeodesicSource> sources;
  std::vector<size_t> bone_of;
  const double voxel = interior.grid.voxel_m;
  double deepest = 0;
  std::vector<double> depth;
  for (size_t b = 0; b < bones.size(); ++b) {
    const double length = (bones[b].to - bones[b].from).norm();
    const int pieces = std::max(1, static_cast<int>(std::ceil(length / voxel)));
    for (int n = 0; n <= pieces; ++n) {
      const Vector3d p = bones[b].from + static_cast<double>(n) / pieces * (bones[b].to - bones[b].from);
      const Vector3d cell = (p - interior.grid.origin) / voxel;
      const std::array<int, 3> at{static_cast<int>(std::lround(cell.x())), static_cast<int>(std::lround(cell.y())),
                                  static_cast<int>(std::lround(cell.z()))};
      bool on_grid = true;
      for (size_t axis = 0; axis < 3; ++axis) on_grid = on_grid && at[axis] >= 0 && at[axis] < interior.grid.size[axis];
      if (!on_grid) continue;
      const size_t index = interior.index(at[0], at[1], at[2]);
      sources.push_back({index, 0});
      bone_of.push_back(b);
      depth.push_back(static_cast<double>(interior.depth_m[index]));
      deepest = std::max(deepest, depth.back());
    }
  }
  for (size_t s = 0; s < sources.size(); ++s)
    sources[s].start = static_cast<uint32_t>(std::lround(10 * (deepest - depth[s]) / voxel));
  const Geodesics geodesics = geodesics_from(interior, sources);

  std::vector<Attachment> attachments(mesh.positions.size());
  work.parallel_for(attachments.size(), 1024, [&](size_t begin, size_t end) {
    for (size_t v = begin; v < end; ++v) {
      const Vector3d p = mesh.positions[v].cast<double>();
      if (const auto at = voxel_near(interior, geodesics, p)) {
        const size_t source = geodesics.origin[*at];
        const double way = (geodesics.steps[*at] - sources[source].start) * voxel / 10;
        attachments[v] = {bones[bone_of[source]].joint,
                          std::max(way, (p - interior.point(sources[source].voxel)).norm())};
        continue;
      }
      // A part of the mesh beside the body: the nearest bone as the crow flies.
      double nearest = std::numeric_limits<double>::infinity();
      for (const Bone& bone : bones)
        if (const double distance = distance_to_bone(bone, p); distance < nearest) {
          nearest = distance;
          attachments[v] = {bone.joint, distance};
        }
    }
  });
  return attachments;
}

/// The stiffness matrix of the surface (cotangent weights, none negative) and the area around each vertex.
struct Laplacian {
  std::vector<Eigen::Triplet<double>> stiffness;
  Eigen::VectorXd area;
};

Laplacian laplacian(const Mesh& mesh) {
  Laplacian result;
  result.area = Eigen::VectorXd::Zero(static_cast<Eigen::Index>(mesh.positions.size()));
  result.stiffness.reserve(12 * mesh.triangles.size());
  for (const auto& t : mesh.triangles) {
    std::array<Vector3d, 3> p;
    for (size_t c = 0; c < 3; ++c) p[c] = mesh.positions[t[c]].cast<double>();
    const double twice_area = (p[1] - p[0]).cross(p[2] - p[0]).norm();
    for (size_t c = 0; c < 3; ++c) {
      const int a = static_cast<int>(t[(c + 1) % 3]), b = static_cast<int>(t[(c + 2) % 3]);
      result.area[static_cast<int>(t[c])] += twice_area / 6;
      // An obtuse corner would push heat from cold to warm, and weights out of 0 … 1.
      constexpr double largest_cotangent = 50;
      const double cotangent = std::clamp(
          (p[(c + 1) % 3] - p[c]).dot(p[(c + 2) % 3] - p[c]) / std::max(twice_area, 1e-12), 0.0, largest_cotangent);
      const double w = 0.5 * cotangent;
      result.stiffness.emplace_back(a, a, w);
      result.stiffness.emplace_back(b, b, w);
      result.stiffness.emplace_back(a, b, -w);
      result.stiffness.emplace_back(b, a, -w);
    }
  }
  return result;
}

/// What a joint weighs at each vertex, before only the strongest are kept; empty for a joint without vertices.
using Shares = std::vector<Eigen::VectorXd>;

Result<Shares> heat_shares(const Mesh& mesh, const std::vector<Attachment>& attachments, size_t joints,
                           double stiffness, const Work& work) {
  // (−Δ + H) w = H p, with H = stiffness / distance² and p one where the joint is the vertex's own.
  const Eigen::Index vertices = static_cast<Eigen::Index>(mesh.positions.size());
  Laplacian heat = laplacian(mesh);
  Eigen::VectorXd warmth(vertices);
  constexpr double least_distance_m = 0.005;
  constexpr double least_area_m2 = 1e-9;  // a vertex without triangles keeps its own joint
  for (Eigen::Index v = 0; v < vertices; ++v) {
    const double d = std::max(attachments[static_cast<size_t>(v)].distance_m, least_distance_m);
    warmth[v] = stiffness * std::max(heat.area[v], least_area_m2) / (d * d);
    heat.stiffness.emplace_back(static_cast<int>(v), static_cast<int>(v), warmth[v]);
  }
  Eigen::SparseMatrix<double> matrix(vertices, vertices);
  matrix.setFromTriplets(heat.stiffness.begin(), heat.stiffness.end());
  const Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>> solver(matrix);
  if (solver.info() != Eigen::Success) return Error{ErrorCode::internal, "skin: the heat equation could not be solved"};
  if (work.stopped()) return Work::cancelled();
  work.report(0.6);

  std::vector<Eigen::VectorXd> shares(joints);
  work.parallel_for(shares.size(), 1, [&](size_t begin, size_t end) {
    for (size_t j = begin; j < end; ++j) {
      Eigen::VectorXd source = Eigen::VectorXd::Zero(vertices);
      for (Eigen::Index v = 0; v < vertices; ++v)
        if (attachments[static_cast<size_t>(v)].joint == j) source[v] = warmth[v];
      if (source.any()) shares[j] = solver.solve(source);
    }
  });
  return shares;
}

/// Each vertex's neighbours along edges, with the edges' lengths.
std::vector<std::vector<std::pair<uint32_t, double>>> edges_of(const Mesh& mesh) {
  std::vector<std::vector<std::pair<uint32_t, double>>> edges(mesh.positions.size());
  for (const auto& t : mesh.triangles)
    for (size_t c = 0; c < 3; ++c) {
      const uint32_t a = t[c], b = t[(c + 1) % 3];
      edges[a].emplace_back(b, static_cast<double>((mesh.positions[a] - mesh.positions[b]).norm()));
    }
  return edges;
}

/// The way along edges from each vertex to the border of a joint's region, which runs across the middles of edges;
/// infinite beyond `limit_m`.
std::vector<double> ways_to_border(const std::vector<std::vector<std::pair<uint32_t, double>>>& edges,
                                   const std::vector<Attachment>& attachments, size_t joint, double limit_m) {
  std::vector<double> ways(edges.size(), std::numeric_limits<double>::infinity());
  using Entry = std::pair<double, uint32_t>;
  std::priority_queue<Entry, std::vector<Entry>, std::greater<>> front;
  const auto reach = [&](uint32_t vertex, double way) {
    if (way > limit_m || way >= ways[vertex]) return;
    ways[vertex] = way;
    front.emplace(way, vertex);
  };
  for (uint32_t a = 0; a < edges.size(); ++a)
    for (const auto& [b, length] : edges[a])
      if ((attachments[a].joint == joint) != (attachments[b].joint == joint)) reach(a, length / 2);
  while (!front.empty()) {
    const auto [way, vertex] = front.top();
    front.pop();
    if (way > ways[vertex]) continue;
    for (const auto& [next, length] : edges[vertex]) reach(next, way + length);
  }
  return ways;
}

Result<Shares> region_shares(const Mesh& mesh, const std::vector<Attachment>& attachments, size_t joints,
                             double overlap, const Work& work) {
  constexpr double least_width_m = 0.005;
  const auto edges = edges_of(mesh);
  double widest = least_width_m;
  for (const Attachment& own : attachments) widest = std::max(widest, overlap * own.distance_m);
  std::vector<bool> used(joints, false);
  for (const Attachment& own : attachments) used[own.joint] = true;
  Shares shares(joints);
  work.parallel_for(joints, 1, [&](size_t begin, size_t end) {
    for (size_t j = begin; j < end; ++j) {
      if (!used[j] || work.stopped()) continue;
      const std::vector<double> ways = ways_to_border(edges, attachments, j, widest);
      shares[j] = Eigen::VectorXd::Zero(static_cast<Eigen::Index>(ways.size()));
      for (size_t v = 0; v < ways.size(); ++v) {
        const double width = std::max(overlap * attachments[v].distance_m, least_width_m);
        const double depth = (attachments[v].joint == j ? 1 : -1) * std::min(ways[v] / width, 1.0);
        // The cubic from 0 to 1 with level ends.
        const double t = 0.5 * (1 + depth);
        shares[j][static_cast<Eigen::Index>(v)] = t * t * (3 - 2 * t);
      }
    }
  });
  if (work.stopped()) return Work::cancelled();
  return shares;
}

/// The four largest of a vertex's weights, without traces, as shares of their sum.
JointInfluences strongest(const std::vector<float>& weights) {
  constexpr float trace = 0.01F;
  JointInfluences result;
  std::array<std::pair<float, uint16_t>, 4> best{};
  for (size_t j = 0; j < weights.size(); ++j) {
    std::pair<float, uint16_t> entry(weights[j], static_cast<uint16_t>(j));
    for (auto& place : best)
      if (entry.first > place.first) std::swap(entry, place);
  }
  float sum = 0;
  for (const auto& [weight, joint] : best)
    if (weight >= trace * best[0].first) sum += weight;
  for (size_t k = 0; k < best.size(); ++k) {
    if (best[k].first < trace * best[0].first || !(best[k].first > 0)) continue;
    result.joint[k] = best[k].second;
    result.weight[k] = best[k].first / sum;
  }
  return result;
}

}  // namespace

Result<Skin> compute_skin(const Mesh& mesh, const Skeleton& skeleton, const SkinningOptions& options,
                          const Work& work) {
  if (!(options.stiffness >= 0.1 && options.stiffness <= 10))
    return Error{ErrorCode::invalid_argument,
                 "skin.stiffness: " + std::to_string(options.stiffness) + ", expected 0.1 … 10"};
  if (!(options.overlap >= 0.1 && options.overlap <= 3))
    return Error{ErrorCode::invalid_argument,
                 "skin.overlap: " + std::to_string(options.overlap) + ", expected 0.1 … 3"};
  if (options.cells < 60 || options.cells > 400)
    return Error{ErrorCode::invalid_argument, "skin.cells: " + std::to_string(options.cells) + ", expected 60 … 400"};
  if (const auto checked = check(mesh); !checked) return checked.error();
  if (const auto checked = check(skeleton); !checked) return checked.error();
  if (mesh.triangles.empty()) return Error{ErrorCode::invalid_argument, "skin: the mesh is empty"};
  if (skeleton.joints.size() > std::numeric_limits<uint16_t>::max())
    return Error{ErrorCode::invalid_argument, "skin: too many joints"};

  const std::vector<Eigen::Isometry3d> world = world_from_joints(skeleton);
  const Interior interior = sample_interior(mesh, options.cells);
  std::vector<Bone> bones = bones_of(skeleton, world, interior);
  if (bones.empty()) return Error{ErrorCode::invalid_argument, "skin: the skeleton has no bones"};
  shape_trunk(skeleton, world, bones);
  add_jaw(skeleton, world, bones);
  add_heels(skeleton, world, bones);
  const std::vector<Attachment> attachments = attach(mesh, interior, bones, work);
  if (work.stopped()) return Work::cancelled();
  work.report(0.3);

  auto shares = options.method == SkinningMethod::heat
                    ? heat_shares(mesh, attachments, skeleton.joints.size(), options.stiffness, work)
                    : region_shares(mesh, attachments, skeleton.joints.size(), options.overlap, work);
  if (!shares) return shares.error();
  if (work.stopped()) return Work::cancelled();
  work.report(0.9);

  Skin skin;
  skin.influences.resize(mesh.positions.size());
  work.parallel_for(skin.influences.size(), 1024, [&](size_t begin, size_t end) {
    std::vector<float> weights(skeleton.joints.size());
    for (size_t v = begin; v < end; ++v) {
      for (size_t j = 0; j < weights.size(); ++j)
        weights[j] = (*shares)[j].size() > 0 ? static_cast<float>((*shares)[j][static_cast<Eigen::Index>(v)]) : 0.0F;
      skin.influences[v] = strongest(weights);
    }
  });
  work.report(1);
  return skin;
}

}  // namespace booth
