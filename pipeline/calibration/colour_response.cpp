#include "pipeline/calibration/colour_response.h"

#include <Eigen/Dense>
#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <map>
#include <numeric>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgproc.hpp>
#include <optional>
#include <tuple>

#include "pipeline/calibration/board.h"
#include "pipeline/types/rig.h"

namespace booth {
namespace {

/// sRGB values above it are as good as overexposed.
constexpr uint8_t brightest_value = 250;
/// Darker white is noise and the camera's black level.
constexpr float least_light = 0.01F;

float linear_from_srgb(uint8_t value) {
  const double encoded = value / 255.0;
  return static_cast<float>(encoded <= 0.04045 ? encoded / 12.92 : std::pow((encoded + 0.055) / 1.055, 2.4));
}

/// How far each place of the board is from the next black, or from its edge.
class WhiteClearance {
 public:
  explicit WhiteClearance(const BoardPattern& pattern) : step_m_(pattern.board().square_m / steps) {
    const CalibrationBoard& board = pattern.board();
    // A frame of what is not white: whether paper goes on beyond the board nobody knows.
    cv::Mat white(board.squares_y * steps + 2, board.squares_x * steps + 2, CV_8UC1, cv::Scalar(0));
    for (int y = 0; y < board.squares_y * steps; ++y)
      for (int x = 0; x < board.squares_x * steps; ++x)
        white.at<uint8_t>(y + 1, x + 1) = pattern.white((x + 0.5) * step_m_, (y + 0.5) * step_m_) ? 255 : 0;
    cv::distanceTransform(white, distance_, cv::DIST_L2, cv::DIST_MASK_PRECISE);
  }
  /// Metres; `p` in the board frame, on the board.
  double at(const Eigen::Vector2d& p) const {
    const int x = std::clamp(static_cast<int>(p.x() / step_m_) + 1, 0, distance_.cols - 1);
    const int y = std::clamp(static_cast<int>(p.y() / step_m_) + 1, 0, distance_.rows - 1);
    return static_cast<double>(distance_.at<float>(y, x)) * step_m_;
  }

 private:
  static constexpr int steps = 48;  // of a square
  double step_m_;
  cv::Mat distance_;
};

/// From the board's plane, metres, to pixels around one square; by its own corners and those next to them, so that lens
/// distortion is no matter. Nothing where too few were found, or one of its own was not.
std::optional<Eigen::Matrix3d> pixel_from_board(const std::map<int, Eigen::Vector2d>& found,
                                                const CalibrationBoard& board, int square_x, int square_y) {
  std::vector<cv::Point2f> from, to;
  bool in_columns = false, in_rows = false;
  for (int y = square_y - 1; y <= square_y + 2; ++y)
    for (int x = square_x - 1; x <= square_x + 2; ++x) {
      if (x < 1 || y < 1 || x >= board.squares_x || y >= board.squares_y) continue;
      const auto corner = found.find((y - 1) * (board.squares_x - 1) + x - 1);
      const bool own = x >= square_x && x <= square_x + 1 && y >= square_y && y <= square_y + 1;
      if (corner == found.end()) {
        if (own) return std::nullopt;
        continue;
      }
      const cv::Point2f at(static_cast<float>(x * board.square_m), static_cast<float>(y * board.square_m));
      in_columns |= !from.empty() && at.y != from.front().y;
      in_rows |= !from.empty() && at.x != from.front().x;
      from.push_back(at);
      to.emplace_back(static_cast<float>(corner->second.x()), static_cast<float>(corner->second.y()));
    }
  constexpr size_t fewest_corners = 4;
  if (from.size() < fewest_corners || !in_columns || !in_rows) return std::nullopt;
  const cv::Mat homography = cv::findHomography(from, to, 0);
  if (homography.empty()) return std::nullopt;
  const Eigen::Matrix3d matrix =
      Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(homography.ptr<double>());
  if (!matrix.allFinite() || !(std::abs(matrix.determinant()) > 0)) return std::nullopt;
  return matrix;
}

/// The mean of the middle half.
float midmean(std::vector<float>& values) {
  std::sort(values.begin(), values.end());
  const auto quarter = static_cast<std::ptrdiff_t>(values.size() / 4);
  const double sum = std::accumulate(values.begin() + quarter, values.end() - quarter, 0.0);
  return static_cast<float>(sum / static_cast<double>(values.size() - 2 * static_cast<size_t>(quarter)));
}

/// A sample that can be compared: a camera's logarithmic light of a place.
struct Observation {
  size_t camera = 0, place = 0;
  Eigen::Array3d log;
};

std::string percent(double share) {
  char text[32];
  std::snprintf(text, sizeof text, "%.0f %%", 100 * share);
  return text;
}

/// Of each observation, its distance from the weighted mean of its place, once the responses are taken off.
std::vector<Eigen::Array3d> residuals_of(const std::vector<Observation>& observations, size_t places,
                                         const std::vector<double>& weights, const Eigen::MatrixX3d& responses) {
  std::vector<Eigen::Array3d> mean(places, Eigen::Array3d::Zero());
  std::vector<double> sum(places, 0);
  const auto radiance = [&](const Observation& one) -> Eigen::Array3d {
    return one.log - responses.row(static_cast<Eigen::Index>(one.camera)).transpose().array();
  };
  for (size_t i = 0; i < observations.size(); ++i) {
    mean[observations[i].place] += weights[i] * radiance(observations[i]);
    sum[observations[i].place] += weights[i];
  }
  std::vector<Eigen::Array3d> residuals;
  for (const Observation& one : observations) residuals.push_back(radiance(one) - mean[one.place] / sum[one.place]);
  return residuals;
}

/// The logarithmic responses of the cameras, a row each, their mean 0; every camera is connected to every other.
/// The places' radiances are eliminated: what is left is a weighted graph Laplacian.
Eigen::MatrixX3d weighted_solution(const std::vector<Observation>& observations, size_t cameras, size_t places,
                                   const std::vector<double>& weights) {
  const auto count = static_cast<Eigen::Index>(cameras);
  Eigen::MatrixXd normal = Eigen::MatrixXd::Constant(count, count, 1.0);  // fixes the mean, which is free otherwise
  Eigen::MatrixX3d right = Eigen::MatrixX3d::Zero(count, 3);
  std::vector<std::vector<size_t>> of_place(places);
  for (size_t i = 0; i < observations.size(); ++i) of_place[observations[i].place].push_back(i);
  for (const std::vector<size_t>& group : of_place) {
    double sum = 0;
    Eigen::Array3d light = Eigen::Array3d::Zero();
    for (const size_t i : group) {
      sum += weights[i];
      light += weights[i] * observations[i].log;
    }
    for (const size_t i : group) {
      const auto row = static_cast<Eigen::Index>(observations[i].camera);
      normal(row, row) += weights[i];
      right.row(row) += (weights[i] * (observations[i].log - light / sum)).matrix().transpose();
      for (const size_t j : group)
        normal(row, static_cast<Eigen::Index>(observations[j].camera)) -= weights[i] * weights[j] / sum;
    }
  }
  return normal.ldlt().solve(right);
}

double size_of(const Eigen::Array3d& residual) { return std::sqrt(residual.square().mean()); }

struct Solution {
  Eigen::MatrixX3d responses;
  std::vector<double> weights;  ///< of the observations
};

Solution robust_solution(const std::vector<Observation>& observations, size_t cameras, size_t places) {
  constexpr int most_rounds = 30;
  constexpr double tuning = 1.345;          // Huber: 95 % efficient for normal errors
  constexpr double least_deviation = 1e-3;  // exact pictures have rounding errors only
  constexpr double settled = 1e-7;
  Solution solution{Eigen::MatrixX3d::Zero(static_cast<Eigen::Index>(cameras), 3),
                    std::vector<double>(observations.size(), 1.0)};
  for (int round = 0; round < most_rounds; ++round) {
    const Eigen::MatrixX3d before = solution.responses;
    solution.responses = weighted_solution(observations, cameras, places, solution.weights);
    if (round > 0 && (solution.responses - before).cwiseAbs().maxCoeff() < settled) break;
    std::vector<double> sizes;
    for (const Eigen::Array3d& residual : residuals_of(observations, places, solution.weights, solution.responses))
      sizes.push_back(size_of(residual));
    std::vector<double> sorted = sizes;
    const auto middle = sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2);
    std::nth_element(sorted.begin(), middle, sorted.end());
    const double limit = tuning * std::max(least_deviation, 1.4826 * *middle);
    for (size_t i = 0; i < sizes.size(); ++i) solution.weights[i] = std::min(1.0, limit / std::max(sizes[i], 1e-12));
  }
  return solution;
}

/// The cameras of the largest group that shares places; of equally large ones that with the first camera.
std::vector<size_t> largest_group(const std::vector<Observation>& observations, size_t cameras, size_t places) {
  std::vector<size_t> group(cameras);
  std::iota(group.begin(), group.end(), size_t{0});
  const auto root = [&](size_t camera) {
    while (group[camera] != camera) camera = group[camera];
    return camera;
  };
  std::vector<std::optional<size_t>> first(places);
  for (const Observation& one : observations) {
    if (!first[one.place]) first[one.place] = one.camera;
    const size_t a = root(*first[one.place]), b = root(one.camera);
    group[std::max(a, b)] = std::min(a, b);
  }
  std::vector<std::vector<size_t>> members(cameras);
  for (size_t camera = 0; camera < cameras; ++camera) members[root(camera)].push_back(camera);
  const auto largest = std::max_element(members.begin(), members.end(),
                                        [](const auto& a, const auto& b) { return a.size() < b.size(); });
  return largest == members.end() ? std::vector<size_t>() : *largest;
}

/// Makes 0 the mean response of the colour cameras, or where all are grey, of all.
void normalise(const std::vector<bool>& grey, Eigen::MatrixX3d& responses) {
  const bool all_grey = std::find(grey.begin(), grey.end(), false) == grey.end();
  Eigen::RowVector3d mean = Eigen::RowVector3d::Zero();
  double count = 0;
  for (size_t i = 0; i < grey.size(); ++i) {
    if (grey[i] && !all_grey) continue;
    mean += responses.row(static_cast<Eigen::Index>(i));
    ++count;
  }
  responses.rowwise() -= mean / count;
}

/// How a grey camera's response differs between the channels: it cannot tell the paper's tint. Otherwise 0.
Eigen::MatrixX3d unseen_tint(const std::vector<bool>& grey, const Eigen::MatrixX3d& responses) {
  Eigen::MatrixX3d tint = Eigen::MatrixX3d::Zero(responses.rows(), 3);
  for (Eigen::Index row = 0; row < responses.rows(); ++row)
    if (grey[static_cast<size_t>(row)]) tint.row(row) = responses.row(row).array() - responses.row(row).mean();
  return tint;
}

}  // namespace

std::vector<WhiteSample> sample_whites(const BoardView& view, const Image& image, const CalibrationBoard& board) {
  constexpr double blurs_away = 3;  // beyond so many deviations of the blur, 0.1 % of an edge is left
  constexpr double least_away_px = 1.5;
  constexpr size_t fewest_pixels = 8;
  constexpr double most_clipped = 0.1;  // of the pixels
  if (view.corners.empty() || (image.channels != 1 && image.channels < 3)) return {};
  const BoardPattern pattern(board);
  const WhiteClearance clearance(pattern);
  const double away_px = std::max(least_away_px, blurs_away * view.blur_px);
  const int channels = image.channels == 1 ? 1 : 3;
  std::map<int, Eigen::Vector2d> found;
  for (const TargetCorner& corner : view.corners) found[corner.id] = corner.pixel;

  std::vector<WhiteSample> samples;
  for (int square_y = 0; square_y < board.squares_y; ++square_y)
    for (int square_x = 0; square_x < board.squares_x; ++square_x) {
      if (BoardPattern::black_square(square_x, square_y)) continue;
      const auto pixel_of = pixel_from_board(found, board, square_x, square_y);
      if (!pixel_of) continue;
      const Eigen::Vector2d low = board.square_m * Eigen::Vector2d(square_x, square_y);
      const Eigen::Vector2d high = low + Eigen::Vector2d::Constant(board.square_m);
      const auto at = [&](double x, double y) -> Eigen::Vector2d {
        return (*pixel_of * Eigen::Vector3d(x, y, 1)).hnormalized();
      };
      Eigen::AlignedBox2d box;
      for (const double x : {low.x(), high.x()})
        for (const double y : {low.y(), high.y()}) box.extend(at(x, y));
      box.clamp(Eigen::AlignedBox2d(Eigen::Vector2d(0, 0), Eigen::Vector2d(image.width - 1, image.height - 1)));
      if (box.isEmpty() || !box.min().allFinite() || !box.max().allFinite()) continue;
      // The board's metres in pixels, along the direction in which they are fewest.
      const double x = 0.5 * (low.x() + high.x()), y = 0.5 * (low.y() + high.y()), half = 0.5 * board.square_m;
      Eigen::Matrix2d pixels_per_m;
      pixels_per_m << (at(x + half, y) - at(x - half, y)), (at(x, y + half) - at(x, y - half));
      pixels_per_m /= board.square_m;
      const Eigen::Matrix2d squared = pixels_per_m.transpose() * pixels_per_m;
      const double least_squared = Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d>(squared).eigenvalues()[0];
      const double least_clearance_m = away_px / std::sqrt(std::max(0.0, least_squared));

      const Eigen::Matrix3d board_from_pixel = pixel_of->inverse();
      std::array<std::vector<float>, 3> light;
      size_t clipped = 0;
      for (int v = static_cast<int>(std::ceil(box.min().y())); v <= static_cast<int>(box.max().y()); ++v)
        for (int u = static_cast<int>(std::ceil(box.min().x())); u <= static_cast<int>(box.max().x()); ++u) {
          const Eigen::Vector2d p = (board_from_pixel * Eigen::Vector3d(u, v, 1)).hnormalized();
          if (!((p - low).minCoeff() >= 0) || !((high - p).minCoeff() > 0) || clearance.at(p) < least_clearance_m)
            continue;
          const uint8_t* pixel = image.pixel(u, v);
          clipped += *std::max_element(pixel, pixel + channels) > brightest_value ? 1 : 0;
          for (size_t c = 0; c < light.size(); ++c) light[c].push_back(linear_from_srgb(pixel[channels == 1 ? 0 : c]));
        }
      const size_t pixels = light[0].size();
      if (pixels < fewest_pixels) continue;
      WhiteSample sample{.camera = view.camera,
                         .pose = view.pose,
                         .square = square_y * board.squares_x + square_x,
                         .grey = channels == 1,
                         .clipped = static_cast<double>(clipped) > most_clipped * static_cast<double>(pixels)};
      for (size_t c = 0; c < light.size(); ++c) sample.light[static_cast<Eigen::Index>(c)] = midmean(light[c]);
      if (sample.clipped || sample.light.minCoeff() >= least_light) samples.push_back(std::move(sample));
    }
  return samples;
}

ColourResponse match_colours(std::span<const std::string> cameras, std::span<const WhiteSample> samples) {
  constexpr double most_disagreement = 0.1;
  ColourResponse result;
  std::map<std::string, size_t> numbers;  // by name, so that the cameras' order is no matter
  for (const std::string& id : cameras) numbers.emplace(id, 0);
  size_t next = 0;
  for (auto& [id, number] : numbers) number = next++;
  std::vector<CameraColour> colours(numbers.size());
  for (const auto& [id, number] : numbers) colours[number].id = id;

  std::vector<const WhiteSample*> ordered;
  for (const WhiteSample& sample : samples)
    if (numbers.contains(sample.camera)) ordered.push_back(&sample);
  std::sort(ordered.begin(), ordered.end(), [](const WhiteSample* a, const WhiteSample* b) {
    return std::tie(a->pose, a->square, a->camera) < std::tie(b->pose, b->square, b->camera);
  });
  std::vector<bool> grey(colours.size(), false);
  std::map<std::pair<int, int>, std::vector<Observation>> seen;
  for (const WhiteSample* sample : ordered) {
    const size_t number = numbers.at(sample->camera);
    ++(sample->clipped ? colours[number].clipped : colours[number].samples);
    grey[number] = grey[number] || sample->grey;
    if (sample->clipped || !(sample->light > 0).all()) continue;
    seen[{sample->pose, sample->square}].push_back(
        {.camera = number, .place = 0, .log = sample->light.cast<double>().log()});
  }
  std::vector<Observation> observations;
  size_t places = 0;
  for (const auto& [key, group] : seen) {
    if (group.size() < 2) continue;  // nothing to compare with
    for (Observation one : group) {
      one.place = places;
      observations.push_back(one);
    }
    ++places;
  }

  const std::vector<size_t> group = largest_group(observations, colours.size(), places);
  if (group.size() > 1) {
    std::vector<std::optional<size_t>> within(colours.size());
    std::vector<bool> grey_within;
    for (const size_t camera : group) {
      within[camera] = grey_within.size();
      grey_within.push_back(grey[camera]);
    }
    std::erase_if(observations, [&](const Observation& one) { return !within[one.camera]; });
    // What is left of the places is numbered anew.
    std::map<size_t, size_t> renumbered;
    for (Observation& one : observations) {
      one.camera = *within[one.camera];
      one.place = renumbered.emplace(one.place, renumbered.size()).first->second;
    }
    places = renumbered.size();
    Solution solution = robust_solution(observations, group.size(), places);
    normalise(grey_within, solution.responses);

    // That grey cameras tell no colours is no disagreement.
    const Eigen::MatrixX3d tint = unseen_tint(grey_within, solution.responses);
    const auto after = residuals_of(observations, places, solution.weights, solution.responses);
    const auto before = residuals_of(observations, places, solution.weights, tint);
    solution.responses -= tint;
    std::vector<double> weight(group.size(), 0);
    double all = 0;
    for (size_t i = 0; i < observations.size(); ++i) {
      CameraColour& colour = colours[group[observations[i].camera]];
      const double w = solution.weights[i], was = w * before[i].square().mean(), is = w * after[i].square().mean();
      weight[observations[i].camera] += w, all += w;
      colour.before += was, result.before += was;
      colour.after += is, result.after += is;
    }
    result.before = std::sqrt(result.before / all);
    result.after = std::sqrt(result.after / all);
    result.samples = static_cast<int>(observations.size());
    for (size_t i = 0; i < group.size(); ++i) {
      CameraColour& colour = colours[group[i]];
      colour.before = std::sqrt(colour.before / weight[i]);
      colour.after = std::sqrt(colour.after / weight[i]);
      const Eigen::Array3d gain = (-solution.responses.row(static_cast<Eigen::Index>(i)).transpose().array()).exp();
      colour.matched = (gain >= least_colour_gain).all() && (gain <= most_colour_gain).all();
      if (colour.matched)
        colour.gain = gain.cast<float>();
      else
        result.messages.push_back(colour.id +
                                  ": the board's white is more than ten times as bright, or as dark, as in the other "
                                  "cameras' pictures: its colours are not matched; set its exposure and white balance");
      if (colour.after > most_disagreement)
        result.messages.push_back(colour.id + ": how bright the board is differs from the other cameras' pictures by " +
                                  percent(colour.after) +
                                  " from place to place: light shines off the board, or exposure changed");
    }
  }
  std::string unmatched;
  for (size_t i = 0; i < colours.size(); ++i) {
    const CameraColour& colour = colours[i];
    if (colour.clipped > colour.samples)
      result.messages.push_back(colour.id + ": the board's white is overexposed in " + std::to_string(colour.clipped) +
                                " of " + std::to_string(colour.clipped + colour.samples) +
                                " squares; expose less to match its colours");
    if (group.size() < 2 || std::find(group.begin(), group.end(), i) == group.end())
      unmatched += (unmatched.empty() ? "" : ", ") + colour.id;
  }
  if (!unmatched.empty() && colours.size() > 1)
    result.messages.push_back(
        "share no well exposed white of the board with the others, and their colours are not "
        "matched: " +
        unmatched);
  for (const std::string& id : cameras) result.cameras.push_back(colours[numbers.at(id)]);
  return result;
}

}  // namespace booth
