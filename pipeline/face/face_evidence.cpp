#include "pipeline/face/face_evidence.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "pipeline/face/patch_matching.h"
#include "pipeline/face/ray_caster.h"

namespace booth {
namespace {

/// Share of the patch, where it takes the hull's place, that an outline says is outside the subject.
double share_outside(const FacePatch& fitted, const SilhouetteViews& views) {
  constexpr float in_place = 0.5F, most_outside_m = 0.006F;
  size_t all = 0, outside = 0;
  for (size_t v = 0; v < fitted.mesh.positions.size(); ++v) {
    if (fitted.weight[v] < in_place) continue;
    ++all;
    outside += std::any_of(views.begin(), views.end(), [&](const auto& view) {
      return view->distance_m(fitted.mesh.positions[v]) > most_outside_m;  // false where it is not seen: NaN
    });
  }
  return all > 0 ? static_cast<double>(outside) / static_cast<double>(all) : 0;
}

/// The triangles of a mesh that touch a box; the positions stay as they are.
Mesh within(const Mesh& mesh, const Eigen::AlignedBox3f& box) {
  Mesh part;
  part.positions = mesh.positions;
  for (const auto& t : mesh.triangles)
    if (std::any_of(t.begin(), t.end(), [&](uint32_t v) { return box.contains(mesh.positions[v]); }))
      part.triangles.push_back(t);
  return part;
}

/// The patch and as far around it as the hull may be from it.
Eigen::AlignedBox3f surroundings(const FacePatch& fitted) {
  Eigen::AlignedBox3f box;
  for (const Eigen::Vector3f& p : fitted.mesh.positions) box.extend(p);
  constexpr float around_m = 0.08F;
  const Eigen::Vector3f around = Eigen::Vector3f::Constant(around_m);
  return {box.min() - around, box.max() + around};
}

}  // namespace

std::optional<std::string> FaceEvidence::objection() const {
  constexpr double most_outside = 0.15;
  if (outside_outline > most_outside)
    return "the fitted one stands out of the outlines over " + std::to_string(std::lround(100 * outside_outline)) +
           " % of its area";
  constexpr size_t enough = 30;
  constexpr double tolerated = 0.03;  // what noise makes of means over that many places
  if (compared >= enough && of_fitted < of_hull - tolerated)
    return std::string("the pictures agree better on it than on the fitted one");
  return std::nullopt;
}

FaceEvidence weigh_face(std::span<const FacePicture> seen, const FaceControlPoints& controls, const Mesh& whole_hull,
                        const FacePatch& fitted, const SilhouetteViews& views, const Work& work) {
  FaceEvidence evidence;
  evidence.outside_outline = share_outside(fitted, views);
  std::vector<PinholePicture> pictures;  // of cameras that know a face when they see it
  for (const FacePicture& face : seen)
    if (std::any_of(controls.observations.begin(), controls.observations.end(),
                    [&](const FaceObservation& observation) { return observation.camera == face.pinhole.view.id; }))
      pictures.push_back(face.pinhole);
  if (pictures.size() < 2) return evidence;
  const auto frontal = [&](const PinholePicture& picture) {
    return (picture.view.center() - controls.frame.middle).normalized().dot(controls.frame.forward);
  };
  const auto reference = std::max_element(pictures.begin(), pictures.end(),
                                          [&](const auto& a, const auto& b) { return frontal(a) < frontal(b); });
  std::vector<const PinholePicture*> others;
  for (const PinholePicture& picture : pictures)
    if (&picture != &*reference) others.push_back(&picture);

  const Mesh hull = within(whole_hull, surroundings(fitted));
  const std::vector<Eigen::Vector3f> fitted_normals = vertex_normals(fitted.mesh), hull_normals = vertex_normals(hull);
  const RayCaster hull_rays(hull);
  const Eigen::Vector3f eye = reference->view.center().cast<float>();
  constexpr size_t wanted = 300;
  const size_t step = std::max<size_t>(1, fitted.mesh.positions.size() / wanted);
  const size_t places = (fitted.mesh.positions.size() + step - 1) / step;
  struct Pair {
    double of_hull = 0, of_fitted = 0;
  };
  std::vector<std::optional<Pair>> pairs(places);
  work.parallel_for(places, 16, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !work.stopped(); ++i) {
      const size_t v = i * step;
      constexpr float fully = 0.9F;
      if (fitted.weight[v] < fully) continue;
      const Eigen::Vector3f& p = fitted.mesh.positions[v];
      const Eigen::Vector3f way = (p - eye).normalized();
      const auto hit = hull_rays.cast(eye, way, 0, std::numeric_limits<float>::infinity());
      if (!hit) continue;
      const auto& corner = hull.triangles[hit->triangle];
      const Eigen::Vector3f normal = hull_normals[corner[0]] + hull_normals[corner[1]] + hull_normals[corner[2]];
      const auto here = patch_correlation(*reference, others, p.cast<double>(), fitted_normals[v].cast<double>());
      const auto there = patch_correlation(*reference, others, (eye + hit->distance_m * way).cast<double>(),
                                           normal.cast<double>().normalized());
      if (here && there) pairs[i] = Pair{*there, *here};
    }
  });
  for (const auto& pair : pairs) {
    if (!pair) continue;
    ++evidence.compared;
    evidence.of_hull += pair->of_hull;
    evidence.of_fitted += pair->of_fitted;
  }
  if (evidence.compared > 0) {
    evidence.of_hull /= static_cast<double>(evidence.compared);
    evidence.of_fitted /= static_cast<double>(evidence.compared);
  }
  return evidence;
}

}  // namespace booth
