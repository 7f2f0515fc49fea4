#pragma once

#include <Eigen/Geometry>
#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "pipeline/types/image.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/result.h"

namespace booth {

/// One texture for the whole mesh. A uv belongs to a triangle's corner, so the mesh stays closed while the atlas
/// is cut into charts. uv is in 0 … 1 with (0,0) at the outer corner of the image's top-left texel and (1,1) at
/// the outer corner of the bottom-right one: the centre of texel (i, j) is ((i + 0.5) / width, (j + 0.5) / height).
/// Formats that count v upwards get it flipped by their exporter.
struct Atlas {
  Image image;                                     ///< 3 channels, sRGB
  std::vector<std::array<Eigen::Vector2f, 3>> uv;  ///< one entry a triangle, in the order of its corners
};

struct Joint {
  std::string name;  ///< Mixamo's, without prefix: "LeftForeArm"
  int parent = -1;   ///< index into Skeleton::joints, always smaller than this joint's own; -1 for the root
  Eigen::Isometry3d parent_from_joint = Eigen::Isometry3d::Identity();  ///< at rest; the root's parent is the world
};

/// The joint tree at rest, which is the captured pose. World frame, metres.
struct Skeleton {
  std::vector<Joint> joints;

  /// The index of the joint of that name, or -1.
  int find(const std::string& name) const;
};

/// The rest pose of every joint in the world frame.
std::vector<Eigen::Isometry3d> world_from_joints(const Skeleton& skeleton);

/// One root, parents before children, unique names, rotations orthonormal.
Result<void> check(const Skeleton& skeleton);

/// Up to four joints a vertex, largest weight first; unused places have joint 0 and weight 0.
struct JointInfluences {
  std::array<uint16_t, 4> joint{0, 0, 0, 0};
  std::array<float, 4> weight{0, 0, 0, 0};
};

/// One entry a vertex of the mesh.
struct Skin {
  std::vector<JointInfluences> influences;
};

/// Weights in 0 … 1 with sum 1 (to 1e-4), largest first, joints in range and not repeated with weight.
Result<void> check(const Skin& skin, size_t vertices, size_t joints);

/// Another shape of the mesh at rest, such as a facial expression: how far vertices move at its full strength.
struct MorphTarget {
  std::string name;                      ///< ARKit's where it has one: "mouthSmileLeft"
  std::vector<uint32_t> vertices;        ///< of the mesh, ascending
  std::vector<Eigen::Vector3f> offsets;  ///< one entry for each of them, metres
};

/// Unique names, ascending vertices in range, an offset for each, all finite.
Result<void> check(const std::vector<MorphTarget>& morphs, size_t vertices);

/// What COLLADA and glTF are written from. Without joints it is an unrigged, textured mesh and `skin` is empty.
struct Avatar {
  Mesh mesh;
  Atlas atlas;
  Skeleton skeleton;
  Skin skin;
  std::vector<MorphTarget> morphs;
};

/// The checks of the parts, and that they fit together.
Result<void> check(const Avatar& avatar);

}  // namespace booth
