#include "pipeline/face/head_view.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

/// Rec. 709 luma of a pixel.
float luma(const Image& picture, int x, int y) {
  const uint8_t* p = picture.pixel(x, y);
  if (picture.channels == 1) return p[0];
  constexpr float red = 0.2126F, green = 0.7152F, blue = 0.0722F;
  return red * static_cast<float>(p[0]) + green * static_cast<float>(p[1]) + blue * static_cast<float>(p[2]);
}

/// Red less blue of a colour pixel, linear light.
float matte(const Image& picture, int x, int y) {
  static const std::array<float, 256> linear = [] {
    std::array<float, 256> table{};
    for (size_t i = 0; i < table.size(); ++i) {
      const double coded = static_cast<double>(i) / 255;  // IEC 61966-2-1
      table[i] = static_cast<float>(coded <= 0.04045 ? coded / 12.92 : std::pow((coded + 0.055) / 1.055, 2.4));
    }
    return table;
  }();
  const uint8_t* p = picture.pixel(x, y);
  return linear[p[0]] - linear[p[2]];
}

/// From the view's pixels to the camera's, without a world between.
class ViewToCamera {
 public:
  ViewToCamera(const CalibratedView& camera, const CalibratedView& view)
      : camera_(camera.intrinsics),
        view_(view.intrinsics),
        turn_(camera.camera_from_world.linear() * view.camera_from_world.linear().transpose()) {}
  std::optional<Eigen::Vector2d> operator()(double x, double y) const {
    return project_camera_point(camera_,
                                turn_ * Eigen::Vector3d((x - view_.cx) / view_.fx, (y - view_.cy) / view_.fy, 1));
  }

 private:
  const Intrinsics& camera_;
  const Intrinsics& view_;
  Eigen::Matrix3d turn_;
};

/// Where the view's pixels lie in the camera's picture, linear between the nodes of a grid over the view: over so few
/// pixels neither a lens nor the change of direction bends a line by a hundredth of a pixel.
class PixelMap {
 public:
  explicit PixelMap(const CalibratedView& camera, const CalibratedView& view)
      : columns_(view.intrinsics.width / cell + 2), rows_(view.intrinsics.height / cell + 2) {
    const ViewToCamera to_camera(camera, view);
    nodes_.reserve(static_cast<size_t>(columns_) * static_cast<size_t>(rows_));
    for (int row = 0; row < rows_; ++row)
      for (int column = 0; column < columns_; ++column)
        nodes_.push_back(to_camera(column * cell + first, row * cell + first)
                             .value_or(Eigen::Vector2d::Constant(std::numeric_limits<double>::quiet_NaN())));
  }

  /// @param x, y  within half a pixel of the view
  /// @return not a number near where the camera's model ends
  Eigen::Vector2d operator()(double x, double y) const {
    const double across = (x - first) / cell, down = (y - first) / cell;
    const int column = static_cast<int>(across), row = static_cast<int>(down);
    const double u = across - column, v = down - row;
    const Eigen::Vector2d* upper =
        &nodes_[static_cast<size_t>(row) * static_cast<size_t>(columns_) + static_cast<size_t>(column)];
    const Eigen::Vector2d* lower = upper + columns_;
    return (1 - v) * ((1 - u) * upper[0] + u * upper[1]) + v * ((1 - u) * lower[0] + u * lower[1]);
  }

  /// Where all of them lie.
  Eigen::AlignedBox2d extent() const {
    Eigen::AlignedBox2d box;
    for (const Eigen::Vector2d& node : nodes_)
      if (!node.hasNaN()) box.extend(node);
    return box;
  }

 private:
  static constexpr int cell = 4;         // pixels of the view
  static constexpr double first = -0.5;  // where the first pixel begins
  int columns_, rows_;
  std::vector<Eigen::Vector2d> nodes_;
};

/// A value of the pixels of that part of a picture which a view shows.
class PictureValues {
 public:
  template <class Value>
  PictureValues(const Image& picture, const Eigen::AlignedBox2d& shown, Value&& value)
      : last_x_(picture.width - 1), last_y_(picture.height - 1) {
    const Eigen::AlignedBox2d part = shown.intersection({Eigen::Vector2d::Zero(), Eigen::Vector2d(last_x_, last_y_)});
    if (part.isEmpty()) return;
    // One more than needed, so that there is always a next one.
    left_ = static_cast<int>(part.min().x()), top_ = static_cast<int>(part.min().y());
    width_ = std::min(static_cast<int>(part.max().x()) + 2, picture.width) - left_;
    const int height = std::min(static_cast<int>(part.max().y()) + 2, picture.height) - top_;
    values_.reserve(static_cast<size_t>(width_) * static_cast<size_t>(height));
    for (int y = top_; y < top_ + height; ++y)
      for (int x = left_; x < left_ + width_; ++x) values_.push_back(value(picture, x, y));
  }

  /// Linear between four pixels; 0 outside the picture and at no place.
  /// @param at  within what the view shows
  float operator()(const Eigen::Vector2d& at) const {
    if (!(at.x() >= 0 && at.y() >= 0 && at.x() <= last_x_ && at.y() <= last_y_)) return 0;
    const int x = std::min(static_cast<int>(at.x()), last_x_ - 1), y = std::min(static_cast<int>(at.y()), last_y_ - 1);
    const auto fx = static_cast<float>(at.x() - x), fy = static_cast<float>(at.y() - y);
    const float* upper =
        &values_[static_cast<size_t>(y - top_) * static_cast<size_t>(width_) + static_cast<size_t>(x - left_)];
    const float* lower = upper + width_;
    return (1 - fy) * ((1 - fx) * upper[0] + fx * upper[1]) + fy * ((1 - fx) * lower[0] + fx * lower[1]);
  }

 private:
  int last_x_, last_y_, left_ = 0, top_ = 0, width_ = 0;
  std::vector<float> values_;
};

/// Samples a value of the picture at every pixel of the view, averaged where the picture is finer.
template <class Value, class Put>
void render(const CalibratedView& camera, const Image& picture, const CalibratedView& view, Value&& value, Put&& put) {
  if (picture.width < 2 || picture.height < 2) return;
  const ViewToCamera to_camera(camera, view);
  const auto middle = to_camera(view.intrinsics.cx, view.intrinsics.cy);
  const auto aside = to_camera(view.intrinsics.cx + 1, view.intrinsics.cy);
  if (!middle || !aside) return;
  constexpr int most_samples = 8;
  const int samples =
      static_cast<int>(std::clamp(std::ceil((*aside - *middle).norm() - 0.25), 1.0, double{most_samples}));
  const PixelMap in_picture(camera, view);
  const PictureValues values(picture, in_picture.extent(), value);
  for (int y = 0; y < view.intrinsics.height; ++y)
    for (int x = 0; x < view.intrinsics.width; ++x) {
      float sum = 0;
      for (int i = 0; i < samples * samples; ++i) {
        const double across = (i % samples + 0.5) / samples - 0.5, down = (i / samples + 0.5) / samples - 0.5;
        sum += values(in_picture(x + across, y + down));
      }
      put(x, y, sum / static_cast<float>(samples * samples));
    }
}

}  // namespace

std::optional<CalibratedView> upright_view(const CalibratedView& camera, const Eigen::Vector3d& middle, double width_m,
                                           int pixels) {
  const Eigen::Vector3d eye = camera.center(), sight = middle - eye;
  const double distance = sight.norm();
  constexpr double steepest = 0.766;  // sin 50°
  if (!(distance > 0) || std::abs(sight.y()) > steepest * distance) return std::nullopt;
  const Eigen::Vector3d forward = sight / distance;
  const Eigen::Vector3d right = forward.cross(Eigen::Vector3d::UnitY()).normalized();
  CalibratedView view;
  view.id = camera.id;
  Eigen::Matrix3d rows;
  rows << right.transpose(), forward.cross(right).transpose(), forward.transpose();
  view.camera_from_world.linear() = rows;
  view.camera_from_world.translation() = -rows * eye;
  view.intrinsics.width = view.intrinsics.height = pixels;
  view.intrinsics.fx = view.intrinsics.fy = pixels * distance / width_m;
  view.intrinsics.cx = view.intrinsics.cy = (pixels - 1) / 2.0;
  return view;
}

Image render_view(const CalibratedView& camera, const Image& picture, const CalibratedView& view) {
  Image seen(view.intrinsics.width, view.intrinsics.height, 1);
  render(camera, picture, view, luma,
         [&](int x, int y, float value) { seen.at(x, y) = static_cast<uint8_t>(std::lround(value)); });
  return seen;
}

FloatImage render_matte(const CalibratedView& camera, const Image& picture, const CalibratedView& view) {
  FloatImage seen(view.intrinsics.width, view.intrinsics.height, 1);
  if (picture.channels >= 3)
    render(camera, picture, view, matte, [&](int x, int y, float value) { seen.at(x, y) = value; });
  return seen;
}

std::optional<Eigen::Vector2d> pixel_in_camera(const CalibratedView& camera, const CalibratedView& view,
                                               const Eigen::Vector2d& pixel) {
  return ViewToCamera(camera, view)(pixel.x(), pixel.y());
}

}  // namespace booth
