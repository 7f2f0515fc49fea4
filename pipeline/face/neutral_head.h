#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "pipeline/types/mesh.h"
#include "pipeline/types/result.h"

namespace booth {

/// What a vertex of the neutral head belongs to.
enum class HeadPart : uint8_t { face, eye, lips, nose, ear, scalp, neck };

/// A facial landmark on the neutral head's surface.
struct HeadLandmark {
  uint32_t triangle = 0;
  Eigen::Vector3f weights = Eigen::Vector3f::Zero();  ///< barycentric, by the triangle's corners
  uint32_t mirror = 0;                                ///< the landmark at the mirrored place
  bool contour = false;  ///< on the jaw line: where the outline seen from the front touches the head
};

/// A facial expression at its full strength: how far vertices move, ascending by vertex.
struct Expression {
  std::string name;  ///< as ARKit names it: "eyeBlinkLeft"
  std::vector<uint32_t> vertices;
  std::vector<Eigen::Vector3f> offsets;  ///< metres
};

/// An average adult head with its mouth closed and its eyes open. One surface, a disk whose border is the neck's cut.
/// Metres, +Y up, facing +Z, the subject's left towards +X, x = 0 its mirror plane, origin at the surface's barycentre.
struct NeutralHead {
  static constexpr size_t landmark_count = 68;

  Mesh mesh;
  std::array<HeadLandmark, landmark_count> landmarks;  ///< iBUG's 68 in their order
  std::vector<uint32_t> mirror;                        ///< per vertex: the one at the mirrored place
  std::vector<HeadPart> part;                          ///< per vertex
  std::vector<uint8_t> face_front;                     ///< per vertex: 1 from hairline to chin and before the ears
  std::vector<uint32_t> face_front_loop;               ///< its border in order
  std::vector<uint8_t> eyeball;                        ///< per vertex: 1 between the lids
  std::vector<Expression> expressions;

  /// A landmark's place when the vertices are at `positions`.
  Eigen::Vector3f landmark(size_t index, const std::vector<Eigen::Vector3f>& positions) const {
    const auto& [a, b, c] = mesh.triangles[landmarks[index].triangle];
    const Eigen::Vector3f& w = landmarks[index].weights;
    return w.x() * positions[a] + w.y() * positions[b] + w.z() * positions[c];
  }
};

/// The texts of the files that a neutral head is read from.
struct NeutralHeadFiles {
  std::string_view mesh;         ///< head.obj: vertices and triangles alone
  std::string_view landmarks;    ///< landmarks.json
  std::string_view regions;      ///< regions.json
  std::string_view symmetry;     ///< symmetry.json
  std::string_view expressions;  ///< expressions.json
};

/// The files of the head that the program carries. They live as long as the program.
NeutralHeadFiles built_in_neutral_head();

/// Reads a neutral head and checks all of it: indices, weights, that the mesh is one manifold disk, that landmarks lie
/// where the mesh has them, that mirroring twice leads back, that the face's border runs along edges.
///
/// @error invalid_file  names the file, the place in it and what is wrong with it
Result<NeutralHead> parse_neutral_head(const NeutralHeadFiles& files);

}  // namespace booth
