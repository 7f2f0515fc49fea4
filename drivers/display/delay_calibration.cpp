#include "drivers/display/delay_calibration.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <string>
#include <thread>
#include <tuple>
#include <utility>
#include <vector>

namespace booth {
namespace {

/// What a picture shows where the projector's light falls.
struct Reference {
  std::vector<size_t> lit;  ///< samples that the projector's light reaches
  double white = 0;         ///< their mean
  double black = 0;
};

/// The projector's light makes at least this difference to a sample, of 255, well above the noise of a camera.
constexpr int least_contrast = 20;
/// … and on at least this part of the picture, so that a reflection on something shiny is no projector.
constexpr double least_lit = 0.005;
constexpr int finest_us = 1000;
/// Twice what bisection needs; a camera that cannot be triggered at will takes pictures when it likes.
constexpr int most_steps = 24;
/// Of the delay that was found; each that fails makes it longer.
constexpr int most_confirmations = 5;

double mean(const Image& image, const std::vector<size_t>& samples) {
  double sum = 0;
  for (const size_t sample : samples) sum += image.samples[sample];
  return sum / static_cast<double>(samples.size());
}

class Calibration {
 public:
  Calibration(FlippingProjector& projector, Trigger* trigger, Camera& camera, const Clock& clock,
              const DelayCalibrationOptions& options, const std::function<void()>& alive)
      : projector_(projector), trigger_(trigger), camera_(camera), clock_(clock), options_(options), alive_(alive) {}

  ~Calibration() {
    projector_.dark();
    camera_.stop();
  }
  Calibration(const Calibration&) = delete;
  Calibration& operator=(const Calibration&) = delete;

  Result<DelayCalibration> run() {
    if (auto learned = learn_reference(); !learned) return learned.error();
    const int longest_us = options_.max_delay_ms * 1000;
    auto round = take_round(longest_us);
    if (!round) return round.error();
    if (!round->whole)
      return Error{ErrorCode::not_ready, camera_.info().id + ": pictures still mix two patterns " +
                                             std::to_string(options_.max_delay_ms) +
                                             " ms after the flip; does the scene move, or the light flicker?"};
    int too_short_us = -finest_us, enough_us = round->offset_us;
    for (int step = 0; step < most_steps && enough_us - too_short_us > finest_us; ++step) {
      round = take_round(std::max(0, (too_short_us + enough_us) / 2));
      if (!round) return round.error();
      if (round->whole)
        enough_us = std::min(enough_us, round->offset_us);
      else
        too_short_us = std::max(too_short_us, round->offset_us);
    }
    // Luck may have helped at one of the steps, and instants jitter: what is recommended has to hold by itself, and to
    // be longer than all that was seen to be too short.
    for (int confirmation = 0; confirmation < most_confirmations; ++confirmation) {
      enough_us = std::max(enough_us, too_short_us + finest_us);
      const int delay_us = enough_us + static_cast<int>(projector_.refresh_ns() / 1000);
      if (delay_us > longest_us) break;
      round = take_round(delay_us);
      if (!round) return round.error();
      if (round->whole) return DelayCalibration{delay_us, enough_us, reference_.white - reference_.black, pictures_};
      too_short_us = std::max(too_short_us, round->offset_us);
    }
    return Error{ErrorCode::not_ready,
                 camera_.info().id + ": the delay is not steady: pictures still mixed two patterns " +
                     std::to_string(too_short_us) + " µs after the flip; does the scene move, or the light flicker?"};
  }

 private:
  int white() const { return pattern_count(projector_.info().pattern) - 2; }
  int black() const { return pattern_count(projector_.info().pattern) - 1; }

  void sleep_until(Timestamp then) const {
    for (Timestamp now = clock_.now(); now < then; now = clock_.now())
      std::this_thread::sleep_for(
          std::min<std::chrono::nanoseconds>(std::chrono::nanoseconds(then - now), longest_nap));
  }

  struct Picture {
    Frame frame;
    int offset_us = 0;  ///< from the flip to the beginning of its exposure
  };

  /// A picture whose exposure begins `delay_us` or a little more after the flip to that pattern.
  Result<Picture> picture(int pattern, int delay_us) {
    if (alive_) alive_();
    if (auto armed = camera_.arm({.role = ShotRole::gray_code}, 1); !armed) return armed.error();
    const auto flipped = projector_.flip(pattern);
    if (!flipped) return flipped.error();
    sleep_until(*flipped + Timestamp{delay_us} * 1000);
    Timestamp fired = clock_.now();
    if (trigger_ != nullptr) {
      const auto pulse = trigger_->fire();
      if (!pulse) return pulse.error();
      fired = *pulse;
    }
    camera_.note_trigger(0, fired);
    ++pictures_;
    auto frame = camera_.wait_frame(fired + milliseconds(options_.frame_timeout_ms));
    if (!frame) return frame.error();
    const Timestamp began = std::max(fired, frame->timestamp_ns);
    return Picture{*std::move(frame), static_cast<int>((began - *flipped) / 1000)};
  }

  Result<void> learn_reference() {
    const int longest_us = options_.max_delay_ms * 1000;
    const auto dark = picture(black(), longest_us);
    if (!dark) return dark.error();
    const auto bright = picture(white(), longest_us);
    if (!bright) return bright.error();
    const Image& from = *dark->frame.pixels;
    const Image& to = *bright->frame.pixels;
    if (from.samples.size() != to.samples.size())
      return Error{ErrorCode::not_ready, camera_.info().id + ": its pictures differ in size"};
    for (size_t i = 0; i < to.samples.size(); ++i)
      if (to.samples[i] - from.samples[i] >= least_contrast) reference_.lit.push_back(i);
    if (static_cast<double>(reference_.lit.size()) < least_lit * static_cast<double>(to.samples.size()))
      return Error{ErrorCode::not_ready, camera_.info().id + ": does not see the light of " + projector_.info().id +
                                             "; darken the booth, or expose longer"};
    reference_.white = mean(to, reference_.lit);
    reference_.black = mean(from, reference_.lit);
    return {};
  }

  /// Pictures of every change, asked for at one delay.
  struct Round {
    bool whole = true;  ///< all show the new pattern alone
    /// From the flip to the exposure, which nobody starts on the microsecond: of whole pictures the offset at which
    /// both changes were, of a mixed one its own.
    int offset_us = 0;
  };

  Result<Round> take_round(int delay_us) {
    const double tolerance = options_.tolerance * (reference_.white - reference_.black);
    Round round;
    for (const auto& [from, to, expected] :
         {std::tuple{black(), white(), reference_.white}, std::tuple{white(), black(), reference_.black}}) {
      int earliest_us = std::numeric_limits<int>::max();
      for (int i = 0; i < options_.repeats; ++i) {
        if (const auto before = projector_.flip(from); !before) return before.error();
        sleep_until(clock_.now() + milliseconds(options_.max_delay_ms));
        const auto taken = picture(to, delay_us);
        if (!taken) return taken.error();
        if (std::abs(mean(*taken->frame.pixels, reference_.lit) - expected) > tolerance)
          return Round{false, taken->offset_us};
        earliest_us = std::min(earliest_us, taken->offset_us);
      }
      round.offset_us = std::max(round.offset_us, earliest_us);
    }
    return round;
  }

  static constexpr std::chrono::milliseconds longest_nap{10};

  FlippingProjector& projector_;
  Trigger* trigger_;
  Camera& camera_;
  const Clock& clock_;
  const DelayCalibrationOptions& options_;
  const std::function<void()>& alive_;
  Reference reference_;
  int pictures_ = 0;
};

Result<void> check(const DelayCalibrationOptions& options) {
  const auto refused = [](const std::string& what) {
    return Error{ErrorCode::invalid_argument, "projector calibration: " + what};
  };
  if (options.max_delay_ms < 10 || options.max_delay_ms > 2000) return refused("max_delay_ms, expected 10 … 2000");
  if (options.repeats < 1 || options.repeats > 100) return refused("repeats, expected 1 … 100");
  if (!(options.tolerance >= 0.001 && options.tolerance <= 0.2)) return refused("tolerance, expected 0.001 … 0.2");
  if (options.frame_timeout_ms < 50 || options.frame_timeout_ms > 60000)
    return refused("frame_timeout_ms, expected 50 … 60000");
  return {};
}

}  // namespace

Result<DelayCalibration> calibrate_delay(FlippingProjector& projector, Trigger* trigger, Camera& camera,
                                         const Clock& clock, const DelayCalibrationOptions& options,
                                         const std::function<void()>& alive) {
  if (auto checked = check(options); !checked) return checked.error();
  if (trigger != nullptr) trigger->prepare(ShotRole::gray_code);
  return Calibration(projector, trigger, camera, clock, options, alive).run();
}

}  // namespace booth
