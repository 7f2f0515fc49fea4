#pragma once

#include <Eigen/Core>
#include <memory>

#include "pipeline/types/mesh.h"

namespace booth {

/// The surface as something that rays are cast against (Embree). Rays may be cast from several threads.
class Occluder {
 public:
  explicit Occluder(const Mesh& mesh);
  ~Occluder();
  Occluder(const Occluder&) = delete;
  Occluder& operator=(const Occluder&) = delete;

  /// Whether the surface lies between the points; the first `skip` (a share of the way) does not count.
  bool between(const Eigen::Vector3f& from, const Eigen::Vector3f& to, float skip) const;

 private:
  struct Scene;
  std::unique_ptr<Scene> scene_;
};

}  // namespace booth
