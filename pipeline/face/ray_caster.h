#pragma once

#include <Eigen/Core>
#include <memory>
#include <optional>

#include "pipeline/types/mesh.h"

namespace booth {

/// Casts rays at a mesh, which must outlive it. Safe for several threads.
class RayCaster {
 public:
  explicit RayCaster(const Mesh& mesh);
  ~RayCaster();
  RayCaster(const RayCaster&) = delete;
  RayCaster& operator=(const RayCaster&) = delete;

  struct Hit {
    float distance_m = 0;
    uint32_t triangle = 0;
  };
  /// The first triangle, of either side, that a ray from `origin` along the unit `direction` meets within
  /// [nearest, farthest] metres.
  std::optional<Hit> cast(const Eigen::Vector3f& origin, const Eigen::Vector3f& direction, float nearest_m,
                          float farthest_m) const;

 private:
  struct Scene;
  std::unique_ptr<Scene> scene_;
};

}  // namespace booth
