#include "pipeline/face/head_fit.h"

#include <Eigen/Dense>
#include <Eigen/Geometry>
#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>
#include <algorithm>
#include <cmath>
#include <numeric>
#include <optional>

#include "pipeline/face/surface_matching.h"
#include "pipeline/face/transformation_pyramids.h"

namespace booth {
namespace {

constexpr size_t landmarks = NeutralHead::landmark_count;
using Positions = Eigen::Matrix<double, Eigen::Dynamic, 3>;  ///< a row a vertex
using Sparse = Eigen::SparseMatrix<double>;

/// Of the weights that residuals beyond `scale` lose. Source: S. Geman, D. McClure, 1987.
double geman_mcclure(double residual, double scale) {
  const double s = scale * scale / (scale * scale + residual * residual);
  return s * s;
}

double median(std::vector<double> values) {
  if (values.empty()) return 0;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// p_world = scale · rotation · p + translation.
struct Similarity {
  double scale = 1;
  Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();
  Eigen::Vector3d translation = Eigen::Vector3d::Zero();
  Eigen::Vector3d operator*(const Eigen::Vector3d& p) const { return scale * (rotation * p) + translation; }
};

/// How far what a predictor calls a landmark may be from the place on the neutral head, metres: along the surface, and
/// along its normal. Predictors learned faces seen from the front. In views from the side they are off towards what the
/// front shows, alike for neighbours, which triangulation takes for depth; brows, drawn differently on every face,
/// suffer most, and the jaw's are no features at all.
struct Vagueness {
  double along_m, across_m;
};
Vagueness vagueness_of(size_t landmark) {
  constexpr Vagueness jaw{0.006, 0.012}, brow{0.004, 0.012}, other{0.002, 0.006};
  if (is_contour_landmark(landmark)) return jaw;
  constexpr size_t last_brow = 26;
  return landmark <= last_brow ? brow : other;
}

struct Target {
  size_t landmark;
  Eigen::Vector3d position;
  Eigen::Matrix3d covariance;  ///< its own and the landmark's vagueness
};

/// @param normals   of the landmarks on the head, world frame
/// @param contours  whether the jaw's are taken, too
std::vector<Target> targets_of(const FaceControlPoints& controls, const std::vector<Eigen::Vector3d>& normals,
                               bool contours) {
  std::vector<Target> targets;
  for (size_t i = 0; i < landmarks; ++i)
    if (const auto& point = controls.points[i]; point && (contours || !is_contour_landmark(i))) {
      const auto [along, across] = vagueness_of(i);
      const Eigen::Matrix3d over = normals[i] * normals[i].transpose();
      targets.push_back(
          {i, point->position,
           point->covariance + along * along * (Eigen::Matrix3d::Identity() - over) + across * across * over});
    }
  return targets;
}

/// The weighted least-squares similarity, reweighted until wrong points have lost their say.
Similarity align(const std::vector<Eigen::Vector3d>& from, const std::vector<Target>& targets) {
  Similarity best;
  std::vector<double> robust(targets.size(), 1);
  constexpr int rounds = 10;
  for (int round = 0; round < rounds; ++round) {
    double sum = 0;
    Eigen::Vector3d from_mean = Eigen::Vector3d::Zero(), to_mean = Eigen::Vector3d::Zero();
    std::vector<double> weight(targets.size());
    for (size_t i = 0; i < targets.size(); ++i) {
      weight[i] = robust[i] / targets[i].covariance.trace();
      sum += weight[i];
      from_mean += weight[i] * from[targets[i].landmark];
      to_mean += weight[i] * targets[i].position;
    }
    from_mean /= sum, to_mean /= sum;
    Eigen::Matrix3d mixed = Eigen::Matrix3d::Zero();
    double spread = 0;
    for (size_t i = 0; i < targets.size(); ++i) {
      const Eigen::Vector3d a = from[targets[i].landmark] - from_mean, b = targets[i].position - to_mean;
      mixed += weight[i] * b * a.transpose();
      spread += weight[i] * a.squaredNorm();
    }
    const Eigen::JacobiSVD<Eigen::Matrix3d> svd(mixed, Eigen::ComputeFullU | Eigen::ComputeFullV);
    Eigen::Vector3d sign = Eigen::Vector3d::Ones();
    if (svd.matrixU().determinant() * svd.matrixV().determinant() < 0) sign.z() = -1;
    best.rotation = svd.matrixU() * sign.asDiagonal() * svd.matrixV().transpose();
    best.scale = (best.rotation.transpose() * mixed).trace() / spread;
    best.translation = to_mean - best.scale * (best.rotation * from_mean);
    constexpr double scale_m = 0.01;
    for (size_t i = 0; i < targets.size(); ++i)
      robust[i] = geman_mcclure((best * from[targets[i].landmark] - targets[i].position).norm(), scale_m);
  }
  return best;
}

/// A control point for every landmark.
std::vector<Eigen::Vector3d> complete(const NeutralHead& neutral, const std::vector<Eigen::Vector3d>& from,
                                      const Similarity& similarity, const std::vector<Target>& targets) {
  // Deviations from the similarity in the head's own frame, where mirroring is a change of sign.
  std::vector<std::optional<Eigen::Vector3d>> known(landmarks);
  for (const Target& t : targets)
    known[t.landmark] = similarity.rotation.transpose() * (t.position - similarity * from[t.landmark]);
  std::vector<Eigen::Vector3d> all;
  for (size_t i = 0; i < landmarks; ++i) {
    Eigen::Vector3d deviation = Eigen::Vector3d::Zero();
    if (known[i]) {
      deviation = *known[i];
    } else if (const auto& mirrored = known[neutral.landmarks[i].mirror]) {
      deviation = mirrored->cwiseProduct(Eigen::Vector3d(-1, 1, 1));
    } else {
      double sum = 0;
      for (size_t k = 0; k < landmarks; ++k)
        if (known[k]) {
          const double weight = 1 / (from[k] - from[i]).squaredNorm();
          deviation += weight * *known[k];
          sum += weight;
        }
      deviation /= sum;
    }
    all.push_back(similarity * from[i] + similarity.rotation * deviation);
  }
  return all;
}

/// Twice the thin-plate energy of a function on the mesh, as its matrix: Lᵀ M⁻¹ L with the cotangent Laplacian L and
/// the vertices' areas M. Source: M. Meyer et al., "Discrete differential-geometry operators for triangulated
/// 2-manifolds", 2003.
Sparse thin_plate(const Mesh& mesh, std::vector<double>* areas) {
  const auto count = static_cast<Eigen::Index>(mesh.positions.size());
  std::vector<Eigen::Triplet<double>> entries;
  areas->assign(mesh.positions.size(), 0);
  for (const auto& t : mesh.triangles)
    for (size_t k = 0; k < 3; ++k) {
      const uint32_t a = t[k], b = t[(k + 1) % 3], c = t[(k + 2) % 3];
      const Eigen::Vector3d ca = (mesh.positions[a] - mesh.positions[c]).cast<double>();
      const Eigen::Vector3d cb = (mesh.positions[b] - mesh.positions[c]).cast<double>();
      const double twice_area = ca.cross(cb).norm();
      (*areas)[a] += twice_area / 6;
      // Slivers and obtuse corners would make the operator indefinite or stiff.
      constexpr double least = 0.02, most = 5;
      const double weight = std::clamp(ca.dot(cb) / twice_area, least, most) / 2;
      entries.emplace_back(a, b, -weight);
      entries.emplace_back(b, a, -weight);
      entries.emplace_back(a, a, weight);
      entries.emplace_back(b, b, weight);
    }
  Sparse laplacian(count, count);
  laplacian.setFromTriplets(entries.begin(), entries.end());
  Eigen::VectorXd per_area(count);
  for (Eigen::Index i = 0; i < count; ++i) per_area[i] = 1 / (*areas)[static_cast<size_t>(i)];
  return laplacian.transpose() * per_area.asDiagonal() * laplacian;
}

/// One thing known about a place of the surface (three vertices with weights): information · (displacement − wanted) is
/// what it pulls with.
struct Pull {
  std::array<uint32_t, 3> vertex{};
  Eigen::Vector3d weight = Eigen::Vector3d::Zero();
  Eigen::Matrix3d information = Eigen::Matrix3d::Zero();  ///< 1 / m²
  Eigen::Vector3d wanted = Eigen::Vector3d::Zero();       ///< displacement from the aligned head, metres
};

/// The displacements with the least energy plus squared pulls. Pulls couple x, y and z, the energy does not: conjugate
/// gradients over all, preconditioned by a factorization that takes every pull for isotropic.
class DisplacementSolver {
 public:
  /// @param energy  with an entry for every two corners of a triangle, which is where pulls add theirs
  explicit DisplacementSolver(Sparse energy) : energy_(std::move(energy)) { factor_.analyzePattern(energy_); }

  /// Prepares for pulls much like these.
  void precondition(const std::vector<Pull>& pulls) {
    std::vector<Eigen::Triplet<double>> entries;
    for (const Pull& pull : pulls) {
      const double isotropic = pull.information.trace() / 3;
      for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
          entries.emplace_back(pull.vertex[static_cast<size_t>(i)], pull.vertex[static_cast<size_t>(k)],
                               isotropic * pull.weight[i] * pull.weight[k]);
    }
    Sparse pulled(energy_.rows(), energy_.cols());
    pulled.setFromTriplets(entries.begin(), entries.end());
    factor_.factorize(energy_ + pulled);
  }

  /// @param precision  of the forces that are left, as a share of the pulls
  void solve(const std::vector<Pull>& pulls, double precision, Positions* displacement) const {
    Positions right = Positions::Zero(energy_.rows(), 3);
    for (const Pull& pull : pulls) add(pull, pull.information * pull.wanted, &right);
    Positions residual = right - apply(pulls, *displacement);
    const double enough = precision * right.norm();
    Positions improved = solve_factored(residual), direction = improved;
    double progress = residual.cwiseProduct(improved).sum();
    constexpr int most_steps = 15;
    for (int step = 0; step < most_steps && residual.norm() > enough; ++step) {
      const Positions image = apply(pulls, direction);
      const double length = progress / direction.cwiseProduct(image).sum();
      *displacement += length * direction;
      residual -= length * image;
      improved = solve_factored(residual);
      const double next = residual.cwiseProduct(improved).sum();
      direction = improved + (next / progress) * direction;
      progress = next;
    }
  }

 private:
  static void add(const Pull& pull, const Eigen::Vector3d& force, Positions* to) {
    for (int i = 0; i < 3; ++i) to->row(pull.vertex[static_cast<size_t>(i)]) += pull.weight[i] * force.transpose();
  }
  Positions apply(const std::vector<Pull>& pulls, const Positions& x) const {
    Positions result = energy_ * x;
    for (const Pull& pull : pulls) {
      Eigen::Vector3d at = Eigen::Vector3d::Zero();
      for (int i = 0; i < 3; ++i) at += pull.weight[i] * x.row(pull.vertex[static_cast<size_t>(i)]).transpose();
      add(pull, pull.information * at, &result);
    }
    return result;
  }

  /// What factor_.solve(right) is, with x, y and z side by side: the factor is read once for all three.
  Positions solve_factored(const Positions& right) const {
    using Row = Eigen::Array4d;  // and a lane that is left 0
    const auto& lower = factor_.matrixL().nestedExpression();
    const auto& place = factor_.permutationP().indices();
    const Eigen::VectorXd diagonal = factor_.vectorD();
    const auto count = static_cast<int>(right.rows());
    std::vector<Row> x(static_cast<size_t>(count));
    for (int i = 0; i < count; ++i) x[static_cast<size_t>(place[i])] << right.row(i).transpose().array(), 0;
    const int *begin = lower.outerIndexPtr(), *row = lower.innerIndexPtr();
    const double* value = lower.valuePtr();
    for (int j = 0; j < count; ++j) {
      const Row known = x[static_cast<size_t>(j)];
      for (int k = begin[j]; k < begin[j + 1]; ++k) x[static_cast<size_t>(row[k])] -= value[k] * known;
    }
    for (int j = count - 1; j >= 0; --j) {
      Row unknown = x[static_cast<size_t>(j)] / diagonal[j];
      for (int k = begin[j]; k < begin[j + 1]; ++k) unknown -= value[k] * x[static_cast<size_t>(row[k])];
      x[static_cast<size_t>(j)] = unknown;
    }
    Positions solved(count, 3);
    for (int i = 0; i < count; ++i) solved.row(i) = x[static_cast<size_t>(place[i])].head<3>().transpose();
    return solved;
  }

  Sparse energy_;
  Eigen::SimplicialLDLT<Sparse> factor_;
};

/// A head seen by one camera: where its own outline is.
class HeadOutline {
 public:
  HeadOutline(const SilhouetteView& view, const Mesh& head) : view_(view), pixels_(head.positions.size()) {
    Eigen::AlignedBox2f box;
    for (size_t i = 0; i < pixels_.size(); ++i) {
      const Eigen::Vector3f& p = head.positions[i];
      float depth = 0, within = 0;
      view.project(p.x(), p.y(), p.z(), pixels_[i].x(), pixels_[i].y(), depth, within);
      if (within < 0) return;  // partly outside: nobody knows what is its outline
      box.extend(pixels_[i]);
    }
    constexpr float cells_across = 160, margin = 2;
    cell_px_ = box.sizes().maxCoeff() / cells_across;
    if (!(cell_px_ > 0)) return;
    low_ = box.min() - Eigen::Vector2f::Constant(margin * cell_px_);
    width_ = static_cast<int>(box.sizes().x() / cell_px_ + 2 * margin) + 1;
    height_ = static_cast<int>(box.sizes().y() / cell_px_ + 2 * margin) + 1;
    covered_.assign(static_cast<size_t>(width_) * static_cast<size_t>(height_), 0);
    for (const auto& [a, b, c] : head.triangles) cover(cell(pixels_[a]), cell(pixels_[b]), cell(pixels_[c]));
    whole_ = true;
  }

  /// Whether the camera sees all of the head.
  bool whole() const { return whole_; }
  const SilhouetteView& view() const { return view_; }

  /// Whether the head covers the place where the camera sees a point; true where it does not see it.
  bool covers(const Eigen::Vector3f& p) const {
    Eigen::Vector2f pixel;
    float depth = 0, within = 0;
    view_.project(p.x(), p.y(), p.z(), pixel.x(), pixel.y(), depth, within);
    if (within < 0) return true;
    const Eigen::Vector2f at = cell(pixel);
    const int x = static_cast<int>(std::floor(at.x())), y = static_cast<int>(std::floor(at.y()));
    return x >= 0 && y >= 0 && x < width_ && y < height_ && covered_[index(x, y)] != 0;
  }

  /// Whether nothing of the head lies beyond a point of the surface, outwards along its normal as the camera sees it.
  bool on_outline(size_t vertex, const Eigen::Vector3f& p, const Eigen::Vector3f& normal) const {
    constexpr float ahead_m = 0.002F;
    const Eigen::Vector3f beyond = p + ahead_m * normal;
    Eigen::Vector2f there;
    float depth = 0, within = 0;
    view_.project(beyond.x(), beyond.y(), beyond.z(), there.x(), there.y(), depth, within);
    const Eigen::Vector2f outwards = (there - pixels_[vertex]).normalized();
    if (!outwards.allFinite()) return false;
    constexpr float first_cell = 2;
    for (float step = first_cell;; ++step) {
      const Eigen::Vector2f at = cell(pixels_[vertex] + step * cell_px_ * outwards);
      const int x = static_cast<int>(std::floor(at.x())), y = static_cast<int>(std::floor(at.y()));
      if (x < 0 || y < 0 || x >= width_ || y >= height_) return true;
      if (covered_[index(x, y)] != 0) return false;
    }
  }

 private:
  Eigen::Vector2f cell(const Eigen::Vector2f& pixel) const { return (pixel - low_) / cell_px_; }
  size_t index(int x, int y) const {
    return static_cast<size_t>(y) * static_cast<size_t>(width_) + static_cast<size_t>(x);
  }
  /// Marks the cells whose centres a triangle covers that faces the camera, and those of its corners.
  void cover(const Eigen::Vector2f& a, const Eigen::Vector2f& b, const Eigen::Vector2f& c) {
    const auto side = [](const Eigen::Vector2f& p, const Eigen::Vector2f& q, float x, float y) {
      return (q.x() - p.x()) * (y - p.y()) - (q.y() - p.y()) * (x - p.x());
    };
    if (side(a, b, c.x(), c.y()) > 0) return;  // counter-clockwise from outside, and rows run down
    for (const Eigen::Vector2f& p : {a, b, c}) covered_[index(static_cast<int>(p.x()), static_cast<int>(p.y()))] = 1;
    const Eigen::Vector2f low = a.cwiseMin(b).cwiseMin(c), high = a.cwiseMax(b).cwiseMax(c);
    for (int y = static_cast<int>(low.y()); y <= static_cast<int>(high.y()); ++y)
      for (int x = static_cast<int>(low.x()); x <= static_cast<int>(high.x()); ++x) {
        constexpr float centre = 0.5F;
        const float px = static_cast<float>(x) + centre, py = static_cast<float>(y) + centre;
        const float s = side(a, b, px, py), t = side(b, c, px, py), u = side(c, a, px, py);
        if (s <= 0 && t <= 0 && u <= 0) covered_[index(x, y)] = 1;
      }
  }

  const SilhouetteView& view_;
  std::vector<Eigen::Vector2f> pixels_;
  std::vector<uint8_t> covered_;
  Eigen::Vector2f low_ = Eigen::Vector2f::Zero();
  float cell_px_ = 0;
  int width_ = 0, height_ = 0;
  bool whole_ = false;
};

/// The head in all views that see the whole of it.
std::vector<HeadOutline> head_outlines(const SilhouetteViews& views, const Mesh& head, const Work& work) {
  std::vector<std::optional<HeadOutline>> seen(views.size());
  work.parallel_for(views.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) seen[i].emplace(*views[i], head);
  });
  std::vector<HeadOutline> outlines;
  for (auto& outline : seen)
    if (outline->whole()) outlines.push_back(std::move(*outline));
  return outlines;
}

/// The hull's distance at a point, trilinear; nothing away from its surface.
std::optional<double> distance_at(const Field& hull, const Eigen::Vector3d& p) {
  const Grid& grid = hull.grid();
  const Eigen::Vector3d at = (p - grid.origin) / grid.voxel_m;
  const Eigen::Vector3i low = at.array().floor().cast<int>();
  const Eigen::Vector3d part = at - low.cast<double>();
  for (int axis = 0; axis < 3; ++axis)
    if (low[axis] < 0 || low[axis] + 1 >= grid.size[static_cast<size_t>(axis)]) return std::nullopt;
  double sum = 0;
  for (int corner = 0; corner < 8; ++corner) {
    const Eigen::Vector3i offset(corner & 1, corner >> 1 & 1, corner >> 2);
    const float value = hull.at(low.x() + offset.x(), low.y() + offset.y(), low.z() + offset.z());
    constexpr float not_stored = 1;
    if (std::abs(value) >= not_stored) return std::nullopt;
    double weight = 1;
    for (int axis = 0; axis < 3; ++axis) weight *= offset[axis] != 0 ? part[axis] : 1 - part[axis];
    sum += weight * static_cast<double>(value);
  }
  return sum;
}

/// How far a hull is from every vertex of the face along its normal, metres: the last step that is inside it.
/// @param inside  whether a point is
template <class Inside>
std::vector<float> gaps_along_normals(const NeutralHead& neutral, const Mesh& head,
                                      const std::vector<Eigen::Vector3f>& normals, const Work& work, Inside&& inside) {
  std::vector<float> gaps(head.positions.size(), 0);
  constexpr float first_m = 0.001F, farthest_m = 0.03F, growth = 1.25F;
  constexpr size_t at_once = 256;
  work.parallel_for(gaps.size(), at_once, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) {
      if (neutral.face_front[i] == 0) continue;
      for (float step = first_m; step < farthest_m && inside(head.positions[i] + step * normals[i]); step *= growth)
        gaps[i] = step;
    }
  });
  return gaps;
}

/// How far the visual hull of a head by itself is from it: what its cameras cannot see of its hollows.
std::vector<float> own_hull_gaps(const NeutralHead& neutral, const std::vector<HeadOutline>& outlines, const Mesh& head,
                                 const std::vector<Eigen::Vector3f>& normals, const Work& work) {
  return gaps_along_normals(neutral, head, normals, work, [&](const Eigen::Vector3f& p) {
    return std::all_of(outlines.begin(), outlines.end(), [&](const HeadOutline& o) { return o.covers(p); });
  });
}

/// How much farther out than it would be if the head were bare the hull is: hair, glasses, a hand. In 0 … 1, 1 = bare.
std::vector<float> bareness(const NeutralHead& neutral, const SilhouetteViews& views, const Mesh& aligned,
                            const Field& hull, const Mesh& head, const Work& work) {
  const std::vector<Eigen::Vector3f> normals = vertex_normals(head);
  // Of the head before it was bent: where it was drawn towards hair it has hollows that no face has.
  const std::vector<float> expected =
      own_hull_gaps(neutral, head_outlines(views, aligned, work), aligned, vertex_normals(aligned), work);
  const std::vector<float> found = gaps_along_normals(neutral, head, normals, work, [&](const Eigen::Vector3f& p) {
    const Grid& grid = hull.grid();
    const Eigen::Vector3f at = (p - grid.origin.cast<float>()) / static_cast<float>(grid.voxel_m);
    const Eigen::Vector3i near = at.array().round().cast<int>();
    for (int axis = 0; axis < 3; ++axis)
      if (near[axis] < 0 || near[axis] >= grid.size[static_cast<size_t>(axis)]) return false;
    return distance_at(hull, p.cast<double>()).value_or(static_cast<double>(hull.at(near.x(), near.y(), near.z()))) < 0;
  });
  std::vector<float> bare(head.positions.size(), 0);
  constexpr float skin_m = 0.004F, hair_m = 0.008F;
  for (size_t i = 0; i < bare.size(); ++i)
    if (neutral.face_front[i] != 0)
      bare[i] = std::clamp((hair_m - (found[i] - expected[i])) / (hair_m - skin_m), 0.0F, 1.0F);
  return bare;
}

/// Where outlines hold or stop the head.
class OutlinePulls {
 public:
  OutlinePulls(const NeutralHead& neutral, const std::vector<double>& areas, double scale)
      : neutral_(neutral), areas_(areas), scale_(scale) {}

  /// @param aligned  where the displacements begin
  /// @return how many hold (the others only stop)
  size_t add(const Positions& aligned, const Mesh& head, const std::vector<HeadOutline>& outlines,
             const std::vector<Eigen::Vector3f>& normals, const Work& work, std::vector<Pull>* pulls) const {
    struct OfView {
      size_t held = 0;
      std::vector<Pull> pulls;
    };
    std::vector<OfView> of_views(outlines.size());
    work.parallel_for(outlines.size(), 1, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i)
        of_views[i].held = add_view(aligned, head, outlines[i], normals, &of_views[i].pulls);
    });
    size_t held = 0;
    for (const OfView& of_view : of_views) {
      held += of_view.held;
      pulls->insert(pulls->end(), of_view.pulls.begin(), of_view.pulls.end());
    }
    return held;
  }

 private:
  size_t add_view(const Positions& aligned, const Mesh& head, const HeadOutline& outline,
                  const std::vector<Eigen::Vector3f>& normals, std::vector<Pull>* pulls) const {
    size_t held = 0;
    const SilhouetteView& view = outline.view();
    const std::vector<uint8_t> rim = rim_vertices(view.camera().center().cast<float>(), head);
    for (size_t i = 0; i < head.positions.size(); ++i) {
      if (!shows_skin(i)) continue;
      const Eigen::Vector3f& p = head.positions[i];
      const float outside = view.distance_m(p);
      if (std::isnan(outside)) continue;
      const bool holds = rim[i] != 0 && outline.on_outline(i, p, normals[i]);
      if (!holds && outside <= 0) continue;
      const Eigen::Vector3d slope = gradient(view, p);
      if (slope.norm() < 0.5 || slope.norm() > 2) continue;
      const Eigen::Vector3d way = slope.normalized();
      constexpr double alike = 0.7;
      if (holds && way.dot(normals[i].cast<double>()) < alike) continue;
      const double residual = static_cast<double>(outside) / slope.norm();
      pulls->push_back(pull(view, i, p, way, residual, aligned));
      held += holds ? 1 : 0;
    }
    return held;
  }

  bool shows_skin(size_t vertex) const {
    const HeadPart part = neutral_.part[vertex];
    return neutral_.face_front[vertex] != 0 &&
           (part == HeadPart::face || part == HeadPart::nose || part == HeadPart::lips);
  }

  /// Vertices with a triangle that faces the camera and one that does not.
  static std::vector<uint8_t> rim_vertices(const Eigen::Vector3f& eye, const Mesh& head) {
    constexpr uint8_t front = 1, back = 2;
    std::vector<uint8_t> faces(head.positions.size(), 0);
    for (const auto& t : head.triangles) {
      const Eigen::Vector3f &a = head.positions[t[0]], &b = head.positions[t[1]], &c = head.positions[t[2]];
      const uint8_t way = (b - a).cross(c - a).dot(eye - a) > 0 ? front : back;
      for (const uint32_t v : t) faces[v] |= way;
    }
    for (uint8_t& f : faces) f = f == (front | back) ? 1 : 0;
    return faces;
  }

  static Eigen::Vector3d gradient(const SilhouetteView& view, const Eigen::Vector3f& p) {
    constexpr float step_m = 0.002F;
    Eigen::Vector3d slope;
    for (int axis = 0; axis < 3; ++axis) {
      const Eigen::Vector3f step = step_m * Eigen::Vector3f::Unit(axis);
      slope[axis] = static_cast<double>((view.distance_m(p + step) - view.distance_m(p - step)) / (2 * step_m));
    }
    return slope.allFinite() ? slope : Eigen::Vector3d::Zero();
  }

  Pull pull(const SilhouetteView& view, size_t vertex, const Eigen::Vector3f& p, const Eigen::Vector3d& way,
            double residual, const Positions& aligned) const {
    // An outline's error: a share of a pixel, alike along several millimetres.
    constexpr double outline_px = 0.5, surface_m = 0.0007, alike_m = 0.008, scale_m = 0.006;
    const double pixel_m =
        (view.camera().camera_from_world * p.cast<double>()).z() * static_cast<double>(view.per_focal());
    const double sigma = std::hypot(outline_px * pixel_m, surface_m);
    const double spacing = scale_ * std::sqrt(areas_[vertex]);
    const double share = std::min(1.0, spacing / alike_m) * geman_mcclure(residual, scale_m);
    const auto v = static_cast<uint32_t>(vertex);
    const Eigen::Vector3d moved = p.cast<double>() - aligned.row(v).transpose();
    return {.vertex = {v, v, v},
            .weight = {1, 0, 0},
            .information = share / (sigma * sigma) * way * way.transpose(),
            .wanted = moved - residual * way};
  }

  const NeutralHead& neutral_;
  const std::vector<double>& areas_;
  double scale_;
};

/// Where the hull is close to the face, as its cameras see all of the face there, it holds the fit.
class HullPulls {
 public:
  /// @param pixel_m  what a pixel of the outlines is at the head
  HullPulls(const NeutralHead& neutral, const Field& hull, const std::vector<double>& areas, double scale,
            double pixel_m)
      : neutral_(neutral), hull_(hull), areas_(areas), scale_(scale), sigma_m_(std::hypot(0.0015, 0.5 * pixel_m)) {}

  void add(const Positions& aligned, const Mesh& head, const std::vector<float>& gaps,
           const std::vector<Eigen::Vector3f>& normals, std::vector<Pull>* pulls) const {
    for (size_t i = 0; i < head.positions.size(); ++i) {
      constexpr float unseen_m = 0.004F;
      if (neutral_.face_front[i] == 0 || gaps[i] > unseen_m) continue;
      const Eigen::Vector3d p = head.positions[i].cast<double>();
      const auto here = distance_at(hull_, p);
      if (!here) continue;
      Eigen::Vector3d slope;
      const double step_m = hull_.grid().voxel_m;
      bool known = true;
      for (int axis = 0; axis < 3; ++axis) {
        const Eigen::Vector3d step = step_m * Eigen::Vector3d::Unit(axis);
        const auto after = distance_at(hull_, p + step), before = distance_at(hull_, p - step);
        known = known && after && before;
        if (known) slope[axis] = (*after - *before) / (2 * step_m);
      }
      if (!known || slope.norm() < 0.5 || slope.norm() > 2) continue;
      const Eigen::Vector3d way = slope.normalized();
      constexpr double alike = 0.7;
      if (way.dot(normals[i].cast<double>()) < alike) continue;
      const double residual = *here / slope.norm();
      constexpr double alike_m = 0.01, scale_m = 0.003, gap_m = 0.0015;
      const double trust = std::exp(-std::pow(static_cast<double>(gaps[i]) / gap_m, 2));
      const double spacing = scale_ * std::sqrt(areas_[i]);
      const double share =
          std::min(1.0, std::pow(spacing / alike_m, 2)) * trust * (residual > 0 ? 1 : geman_mcclure(residual, scale_m));
      const auto v = static_cast<uint32_t>(i);
      const Eigen::Vector3d moved = p - aligned.row(v).transpose();
      pulls->push_back({.vertex = {v, v, v},
                        .weight = {1, 0, 0},
                        .information = share / (sigma_m_ * sigma_m_) * way * way.transpose(),
                        .wanted = moved - residual * way});
    }
  }

 private:
  const NeutralHead& neutral_;
  const Field& hull_;
  const std::vector<double>& areas_;
  double scale_;
  double sigma_m_;
};

/// What a pixel is at a place, in the median of the views that see it; 0 without views.
double pixel_size(const SilhouetteViews& views, const Eigen::Vector3d& place) {
  std::vector<double> sizes;
  for (const auto& view : views) {
    const double depth = (view->camera().camera_from_world * place).z();
    if (depth > 0) sizes.push_back(depth * static_cast<double>(view->per_focal()));
  }
  return median(std::move(sizes));
}

/// Where pictures agree on what is near the head, it moves there.
/// @param coarse  searches far, for a head that may be wrong by some millimetres
void add_picture_pulls(const NeutralHead& neutral, std::span<const FacePicture> pictures, const Similarity& similarity,
                       bool coarse, const Positions& displacement, const Mesh& head, const Work& work,
                       std::vector<Pull>* pulls) {
  Eigen::Isometry3d world_from_head = Eigen::Isometry3d::Identity();
  world_from_head.linear() = similarity.rotation;
  world_from_head.translation() = similarity.translation;
  constexpr SurfaceMatchOptions far{
      .spacing_m = 0.002, .half_window_m = 0.010, .range_m = 0.0075, .step_m = 0.00125, .least_correlation = 0.5};
  constexpr SurfaceMatchOptions near{
      .spacing_m = 0.0015, .half_window_m = 0.009, .range_m = 0.003, .step_m = 0.00075, .least_correlation = 0.6};
  const double scale_m = coarse ? 0.006 : 0.003;
  for (const SurfaceMatch& match : match_surface(pictures, head, world_from_head, coarse ? far : near, work)) {
    const auto in_face = [&](uint32_t v) { return neutral.face_front[v] != 0; };
    if (!std::all_of(match.vertex.begin(), match.vertex.end(), in_face)) continue;
    const Eigen::Vector3d way = match.normal.cast<double>();
    Eigen::Vector3d moved = Eigen::Vector3d::Zero();
    for (int k = 0; k < 3; ++k)
      moved +=
          static_cast<double>(match.weights[k]) * displacement.row(match.vertex[static_cast<size_t>(k)]).transpose();
    const double trust = geman_mcclure(match.along_m, scale_m);
    pulls->push_back({.vertex = match.vertex,
                      .weight = match.weights.cast<double>(),
                      .information = trust / (match.sigma_m * match.sigma_m) * way * way.transpose(),
                      .wanted = moved + match.along_m * way});
  }
}

void set_positions(const Positions& positions, Mesh* mesh) {
  for (size_t i = 0; i < mesh->positions.size(); ++i)
    mesh->positions[i] = positions.row(static_cast<Eigen::Index>(i)).transpose().cast<float>();
}

/// The paper's: every vertex in a pyramid keeps its coordinates there.
void transform_by_pyramids(const std::vector<Eigen::Vector3d>& from, const std::vector<Eigen::Vector3d>& to,
                           const Similarity& similarity, const NeutralHead& neutral, FittedHead* fitted) {
  const Eigen::Vector3d apex = Eigen::Vector3d::Zero();
  const TransformationPyramids pyramids(apex, from);
  for (size_t i = 0; i < neutral.mesh.positions.size(); ++i) {
    const Eigen::Vector3d p = neutral.mesh.positions[i].cast<double>();
    const auto at = pyramids.locate(p);
    fitted->face[i] = at && neutral.face_front[i] != 0 ? 1 : 0;
    if (at) fitted->mesh.positions[i] = pyramids.evaluate(*at, similarity * apex, to).cast<float>();
  }
}

/// @return how many places the outlines held
size_t bend_smoothly(const NeutralHead& neutral, const std::vector<Target>& targets,
                     std::span<const FacePicture> pictures, const SilhouetteViews& views, const Field& hull,
                     const Similarity& similarity, const HeadFitOptions& options, const Work& work, Mesh* head) {
  const auto count = static_cast<Eigen::Index>(neutral.mesh.positions.size());
  Positions aligned(count, 3);
  for (Eigen::Index i = 0; i < count; ++i) aligned.row(i) = head->positions[static_cast<size_t>(i)].cast<double>();

  std::vector<double> areas;
  Sparse energy = thin_plate(neutral.mesh, &areas);
  // A wave of length w and amplitude a has the energy a² (2π/w)⁴ / 2 per area, and (w/2)² of it one degree of freedom,
  // which shall have the energy 1 at the amplitude and length that faces differ by.
  constexpr double wave_m = 0.06, pi = 3.14159265358979;
  const double wave_energy =
      std::pow(options.variation_m, 2) * std::pow(2 * pi / wave_m, 4) / 2 * std::pow(wave_m / 2, 2);
  energy *= 1 / wave_energy;
  // Where nothing is known the head stays near where the similarity puts it.
  constexpr double stray_m = 0.03, strays = 20;
  const double whole_area = std::accumulate(areas.begin(), areas.end(), 0.0);
  for (Eigen::Index i = 0; i < count; ++i)
    energy.coeffRef(i, i) += strays / (stray_m * stray_m) * areas[static_cast<size_t>(i)] / whole_area;

  DisplacementSolver solver(std::move(energy));
  const OutlinePulls outline_pulls(neutral, areas, similarity.scale);
  const HullPulls hull_pulls(neutral, hull, areas, similarity.scale, pixel_size(views, similarity.translation));
  Positions displacement = Positions::Zero(count, 3);
  size_t held = 0;
  constexpr int first_with_outlines = 1, last_new_outlines = 2, first_with_pictures = 2, first_near = 4;
  const int rounds = pictures.size() > 1 ? 5 : views.empty() ? 2 : 3;
  std::vector<Pull> silhouette_pulls;
  for (int round = 0; round < rounds && !work.stopped(); ++round) {
    std::vector<Pull> pulls;
    for (const Target& target : targets) {
      const HeadLandmark& landmark = neutral.landmarks[target.landmark];
      const auto& corner = neutral.mesh.triangles[landmark.triangle];
      Eigen::Vector3d start = Eigen::Vector3d::Zero(), moved = Eigen::Vector3d::Zero();
      for (int k = 0; k < 3; ++k) {
        const double weight = static_cast<double>(landmark.weights[k]);
        start += weight * aligned.row(corner[static_cast<size_t>(k)]).transpose();
        moved += weight * displacement.row(corner[static_cast<size_t>(k)]).transpose();
      }
      const Eigen::Vector3d wanted = target.position - start;
      constexpr double scale_m = 0.008;
      pulls.push_back({.vertex = corner,
                       .weight = landmark.weights.cast<double>(),
                       .information = geman_mcclure((wanted - moved).norm(), scale_m) * target.covariance.inverse(),
                       .wanted = wanted});
    }
    if (round >= first_with_outlines && round <= last_new_outlines) {
      silhouette_pulls.clear();
      const std::vector<Eigen::Vector3f> normals = vertex_normals(*head);
      const std::vector<HeadOutline> outlines = head_outlines(views, *head, work);
      held = outline_pulls.add(aligned, *head, outlines, normals, work, &silhouette_pulls);
      if (!outlines.empty())
        hull_pulls.add(aligned, *head, own_hull_gaps(neutral, outlines, *head, normals, work), normals,
                       &silhouette_pulls);
    }
    pulls.insert(pulls.end(), silhouette_pulls.begin(), silhouette_pulls.end());
    if (round >= first_with_pictures)
      add_picture_pulls(neutral, pictures, similarity, round < first_near, displacement, *head, work, &pulls);
    // Those of later rounds are much alike.
    if (round <= first_with_pictures) solver.precondition(pulls);
    constexpr double rough = 1e-2, fine = 1e-3;  // the next round improves on a rough one
    solver.solve(pulls, round + 1 < rounds ? rough : fine, &displacement);
    set_positions(aligned + displacement, head);
  }
  return held;
}

}  // namespace

Result<FittedHead> fit_neutral_head(const NeutralHead& neutral, const FaceControlPoints& controls,
                                    std::span<const FacePicture> pictures, const SilhouetteViews& views,
                                    const Field& hull, const HeadFitOptions& options, const Work& work) {
  std::vector<Eigen::Vector3d> from;
  for (size_t i = 0; i < landmarks; ++i) from.push_back(neutral.landmark(i, neutral.mesh.positions).cast<double>());
  const std::vector<Eigen::Vector3f> vertex_normal = vertex_normals(neutral.mesh);
  std::vector<Eigen::Vector3d> normals;
  for (size_t i = 0; i < landmarks; ++i)
    normals.emplace_back(neutral.landmark(i, vertex_normal).cast<double>().normalized());
  // Sights that touch the jaw meet before it, not on it: where there are outlines, these know better.
  const bool contours = views.empty() || options.method == HeadFitMethod::pyramids;
  std::vector<Target> targets = targets_of(controls, normals, contours);
  FittedHead fitted;
  for (const Target& target : targets) fitted.features += is_contour_landmark(target.landmark) ? 0 : 1;
  if (fitted.features < options.fewest_features)
    return Error{ErrorCode::no_subject, "only " + std::to_string(fitted.features) +
                                            " landmarks of the face are known, and it takes " +
                                            std::to_string(options.fewest_features)};

  // Which way landmarks face is only known after a first alignment.
  const Similarity rough = align(from, targets);
  for (Eigen::Vector3d& normal : normals) normal = rough.rotation * normal;
  targets = targets_of(controls, normals, contours);
  const Similarity similarity = align(from, targets);
  std::vector<double> deviations;
  for (const Target& target : targets)
    if (!is_contour_landmark(target.landmark))
      deviations.push_back((similarity * from[target.landmark] - target.position).norm());
  // Inner and outer bounds of human heads, a small child's to a large man's, against the neutral one's 21 cm.
  constexpr double smallest = 0.6, largest = 1.4;
  if (const double deviation = median(deviations);
      !(similarity.scale > smallest && similarity.scale < largest && deviation < options.worst_feature_m))
    return Error{ErrorCode::no_subject, "the landmarks do not have the shape of a face (they are off by " +
                                            std::to_string(std::lround(1000 * deviation)) + " mm in the median)"};

  fitted.scale = similarity.scale;
  fitted.rotation = similarity.rotation;
  fitted.translation = similarity.translation;
  fitted.mesh = neutral.mesh;
  fitted.face = neutral.face_front;
  for (Eigen::Vector3f& p : fitted.mesh.positions) p = (similarity * p.cast<double>()).cast<float>();
  const Mesh aligned = fitted.mesh;
  if (options.method == HeadFitMethod::pyramids)
    transform_by_pyramids(from, complete(neutral, from, similarity, targets), similarity, neutral, &fitted);
  else
    fitted.outline_points =
        bend_smoothly(neutral, targets, pictures, views, hull, similarity, options, work, &fitted.mesh);
  const std::vector<float> bare = bareness(neutral, views, aligned, hull, fitted.mesh, work);
  for (size_t i = 0; i < bare.size(); ++i) fitted.bare.push_back(fitted.face[i] != 0 ? bare[i] : 0);
  if (work.stopped()) return Work::cancelled();

  std::vector<double> distances;
  for (const Target& target : targets)
    if (!is_contour_landmark(target.landmark))
      distances.push_back(
          (neutral.landmark(target.landmark, fitted.mesh.positions).cast<double>() - target.position).norm());
  fitted.feature_median_m = median(distances);
  return fitted;
}

}  // namespace booth
