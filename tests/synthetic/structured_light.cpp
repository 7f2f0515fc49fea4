#include "tests/synthetic/structured_light.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <random>

#include "pipeline/geometry/camera_model.h"
#include "tests/synthetic/scene.h"

namespace booth::synthetic {
namespace {

Eigen::Isometry3d look_at(const Eigen::Vector3d& eye, const Eigen::Vector3d& target) {
  const Eigen::Vector3d z = (target - eye).normalized();
  const Eigen::Vector3d x = z.cross(Eigen::Vector3d::UnitY()).normalized();
  Eigen::Isometry3d camera_from_world = Eigen::Isometry3d::Identity();
  camera_from_world.linear() << x.transpose(), z.cross(x).transpose(), z.transpose();
  camera_from_world.translation() = -camera_from_world.linear() * eye;
  return camera_from_world;
}

}  // namespace

double brightness(const GrayCodePattern& pattern, int image, const Eigen::Vector2d& at, double blur_px) {
  const int images = pattern_count(pattern);
  if (image == images - 2) return 1;
  if (image == images - 1) return 0;
  const auto bits_of = [](int size) { return static_cast<int>(std::ceil(std::log2(size))); };
  const int column_bits = bits_of(pattern.width);
  const int number = image / 2;
  const bool of_column = number < column_bits;
  const int bit = of_column ? column_bits - 1 - number : bits_of(pattern.height) - 1 - (number - column_bits);
  const double x = of_column ? at.x() : at.y();
  // Each projector pixel is a box, blurred by a Gaussian: the difference of two error functions.
  double sum = 0;
  for (int i = static_cast<int>(std::floor(x)) - 4; i <= static_cast<int>(std::floor(x)) + 5; ++i) {
    const unsigned gray = static_cast<unsigned>(std::max(i, 0)) ^ (static_cast<unsigned>(std::max(i, 0)) >> 1);
    if ((gray >> bit & 1) == 0) continue;
    const double scale = 1 / (blur_px * std::sqrt(2.0));
    sum += 0.5 * (std::erf((i + 0.5 - x) * scale) - std::erf((i - 0.5 - x) * scale));
  }
  return image % 2 == 0 ? sum : 1 - sum;
}

Rig scanner_rig(const Eigen::Vector3d& target) {
  Rig rig = ring_rig({.cameras = 3});
  rig.cameras.clear();
  for (const double side : {-1.0, 1.0}) {
    RigCamera camera;
    camera.id = side < 0 ? "face-right" : "face-left";
    camera.role = CameraRole::face;
    camera.intrinsics = {360, 270, 675, 679, 181, 134, 0, {-0.03, 0.01, 1e-4, -2e-4, 0}};
    camera.camera_from_world = look_at(target + Eigen::Vector3d(side * 0.22, 0.06, 0.7), target);
    rig.cameras.push_back(camera);
  }
  CalibratedView projector;
  projector.id = "projector";
  projector.intrinsics = {256, 192, 480, 482, 127, 98, 0, {0.01, -0.005, 1e-4, 1e-4, 0}};
  projector.camera_from_world = look_at(target + Eigen::Vector3d(0, -0.08, 0.72), target);
  rig.projector = projector;
  return rig;
}

GrayCodeCapture render_gray_code(const Body& body, const Rig& rig, const GrayCodeScene& scene) {
  GrayCodeCapture capture;
  const CalibratedView& projector = *rig.projector;
  capture.pattern = {projector.intrinsics.width, projector.intrinsics.height, true, true, true};
  const int images = pattern_count(capture.pattern);
  std::mt19937 random(scene.seed);
  std::normal_distribution<double> noise(0, scene.noise);
  capture.sets.resize(static_cast<size_t>(images));
  for (int image = 0; image < images; ++image) capture.sets[static_cast<size_t>(image)].index = image;
  for (const RigCamera& camera : rig.cameras) {
    struct Seen {
      double lit = 0;
      Eigen::Vector2d at = Eigen::Vector2d::Zero();
    };
    const int width = camera.intrinsics.width, height = camera.intrinsics.height;
    std::vector<Seen> seen(static_cast<size_t>(width) * static_cast<size_t>(height));
    // The body moves past fixed pixels: what they see is traced anew now and then.
    constexpr int images_at_rest = 12;
    for (int image = 0; image < images; ++image) {
      const Eigen::Vector3d moved = scene.sway_m * image / (images - 1);
      if (image == 0 || (image % images_at_rest == 0 && !scene.sway_m.isZero()))
        for (int y = 0; y < height; ++y)
          for (int x = 0; x < width; ++x) {
            Seen& pixel = seen[static_cast<size_t>(y * width + x)];
            pixel = {};
            Eigen::Vector3d hit, lit;
            if (!trace(body, camera.center() - moved, world_ray(camera, {x, y}), &hit)) continue;
            const Eigen::Vector3d source = projector.center() - moved, towards = hit - source;
            if (!trace(body, source, towards.normalized(), &lit) || (lit - hit).norm() > 1e-3) continue;
            const auto at = project(projector, hit + moved);
            if (!at || at->minCoeff() < 0 || at->x() > projector.intrinsics.width - 1 ||
                at->y() > projector.intrinsics.height - 1)
              continue;
            constexpr double h = 1e-4;
            Eigen::Vector3d normal;
            for (int axis = 0; axis < 3; ++axis)
              normal[axis] = signed_distance(body, hit + h * Eigen::Vector3d::Unit(axis)) -
                             signed_distance(body, hit - h * Eigen::Vector3d::Unit(axis));
            pixel.lit = std::max(0.0, -normal.normalized().dot(towards.normalized()));
            pixel.at = *at;
          }
      auto pixels = std::make_shared<Image>(width, height, 1);
      for (size_t i = 0; i < seen.size(); ++i) {
        double value = scene.ambient + noise(random);
        if (seen[i].lit > 0)
          value += scene.contrast * seen[i].lit * brightness(capture.pattern, image, seen[i].at, scene.blur_px);
        pixels->samples[i] = static_cast<uint8_t>(std::clamp(std::lround(value), 0L, 255L));
      }
      Frame frame;
      frame.camera = camera.id;
      frame.index = image;
      frame.pixels = pixels;
      capture.sets[static_cast<size_t>(image)].frames.push_back(frame);
    }
  }
  return capture;
}

}  // namespace booth::synthetic
