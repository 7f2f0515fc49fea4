#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "pipeline/refine/hull_samples.h"
#include "pipeline/types/field.h"
#include "pipeline/types/work.h"

namespace booth {

struct SmoothDistanceOptions {
  double cell_m = 0.02;  ///< between the nodes
  /// The weight of bending against the samples', for second differences over 20 mm.
  double stiffness = 0.01;
  int iterations = 60;
};

/// A distance-like function, negative inside, that at each sample has its slack as value (the true surface is expected
/// so far inside) and its normal as gradient, as far as the sample's weight says, and bends as little as possible: a
/// quadratic B-spline over a grid that covers the inside of the hull and a little around it.
/// Source: F. Calakli, G. Taubin, "SSD: Smooth signed distance surface reconstruction", Computer Graphics Forum 30(7),
/// 2011; conjugate gradients coarse to fine instead of an octree.
class SmoothDistance {
 public:
  /// @param hull     says where the inside is
  /// @param samples  of its surface, at least one; they say where the function is wanted
  SmoothDistance(const Field& hull, std::span<const HullSample> samples, const SmoothDistanceOptions& options);

  /// @param samples  that hold the function
  /// @param weights  by sample, 0 … 1
  /// @param coarser  where to start from, or nullptr for what the function is: at first the distance to the hull
  void solve(std::span<const HullSample> samples, std::span<const float> weights, const SmoothDistance* coarser,
             const Work& work);

  /// Metres, at a point inside the hull or near it.
  float at(const Eigen::Vector3f& p) const;
  /// Its gradient there; zero farther away.
  Eigen::Vector3f slope(const Eigen::Vector3f& p) const;
  /// A quantity of the constructor's samples, spread to the nodes that they are nearest to.
  std::vector<float> spread(std::span<const float> by_sample) const;
  /// The same less a quantity of the nodes.
  float at(const Eigen::Vector3f& p, const std::vector<float>& less) const;

 private:
  static constexpr size_t support = 27;
  /// How the function depends on the nodes around a sample.
  struct Row {
    float weight, wanted;  ///< wanted: the function's value
    Eigen::Vector3f normal;
    std::array<int32_t, support> node;
    std::array<float, support> value;
    std::array<std::array<float, support>, 3> slope;
  };

  size_t index(int i, int j, int k) const {
    return (static_cast<size_t>(k) * static_cast<size_t>(size_[1]) + static_cast<size_t>(j)) *
               static_cast<size_t>(size_[0]) +
           static_cast<size_t>(i);
  }
  int32_t node(int i, int j, int k) const {
    const bool in = i >= 0 && j >= 0 && k >= 0 && i < size_[0] && j < size_[1] && k < size_[2];
    return in ? node_of_[index(i, j, k)] : -1;
  }
  template <class Value>
  float interpolate(const Eigen::Vector3f& p, const Value& value_of) const;
  Eigen::Vector3f in_cells(const Eigen::Vector3f& p) const { return (p - origin_) / cell_m_; }
  void find_nodes(const Field& hull, std::span<const HullSample> samples);
  void make_rows(std::span<const HullSample> samples, std::span<const float> weights);
  void multiply(const std::vector<float>& x, std::vector<float>& y) const;

  Eigen::Vector3f origin_;
  float cell_m_;
  float stiffness_;
  int iterations_;
  std::array<int, 3> size_{};
  std::vector<int32_t> node_of_;                  ///< by place in the grid
  std::vector<int32_t> nearest_;                  ///< by node: a sample
  std::vector<float> start_;                      ///< by node: distance to the nearest sample, signed
  std::vector<float> values_;                     ///< by node
  std::vector<std::array<int, 3>> places_;        ///< by node
  std::vector<std::array<int32_t, 6>> beside_;    ///< by node: towards −x, +x, −y, +y, −z, +z
  std::vector<std::array<int32_t, 3>> diagonal_;  ///< by node: towards +x +y, +x +z, +y +z
  std::vector<Row> rows_;                         ///< of the samples that hold it and have all their nodes
};

}  // namespace booth
