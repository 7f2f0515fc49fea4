#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <map>
#include <set>
#include <vector>

#include "drivers/gpio/gpio_devices.h"
#include "drivers/gpio/gpio_system.h"

namespace booth {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;

struct Edge {
  Timestamp when = 0;
  std::string line;
  bool active = false;

  bool operator==(const Edge&) const = default;
};
void PrintTo(const Edge& edge, std::ostream* out) { *out << edge.line << (edge.active ? "↑" : "↓") << edge.when; }

/// Lines that note what is done to them, in a time that passes only while somebody sleeps.
class SimulatedGpio final : public GpioSystem, public Clock {
 public:
  Timestamp now() const override { return now_; }
  void sleep_until(Timestamp then) override { now_ = std::max(now_, then); }
  Result<std::unique_ptr<OutputLine>> request_output(const GpioLineSettings& line, const std::string&) override {
    if (missing.contains(line.line)) return Error{ErrorCode::device_lost, "line " + line.line + " is gone"};
    held.insert(line.line);
    return std::unique_ptr<OutputLine>(std::make_unique<Line>(*this, line.line));
  }

  /// Everything in microseconds since the beginning.
  std::vector<Edge> edges;
  std::map<std::string, bool> active;
  std::set<std::string> held;
  std::set<std::string> missing;
  int works_for = 1 << 30;  ///< so many settings of a line; then one fails, and those after it work again

 private:
  class Line final : public OutputLine {
   public:
    Line(SimulatedGpio& gpio, std::string name) : gpio_(gpio), name_(std::move(name)) {}
    ~Line() override { gpio_.held.erase(name_); }
    Result<void> set(bool active) override {
      if (gpio_.works_for-- == 0) return Error{ErrorCode::device_lost, name_ + " cannot be set"};
      gpio_.edges.push_back({gpio_.now_ / 1000, name_, active});
      gpio_.active[name_] = active;
      return {};
    }

   private:
    SimulatedGpio& gpio_;
    std::string name_;
  };
  Timestamp now_ = 0;
};

class Gpio : public testing::Test {
 protected:
  static GpioTriggerSettings plain() { return {.trigger = {.chip = "gpiochip0", .line = "T"}, .pulse_us = 500}; }
  static GpioTriggerSettings lit() {
    auto settings = plain();
    settings.lights = GpioLineSettings{.chip = "gpiochip0", .line = "L"};
    settings.lights_lead_us = 1000;
    settings.lights_hold_us = 20000;
    return settings;
  }
  static GpioProjectorSettings stepped() {
    return {.pattern = {.width = 4, .height = 2},  // 2·2 + 1·2 + 2 patterns
            .step = {.chip = "gpiochip0", .line = "S"},
            .reset = {.chip = "gpiochip0", .line = "R"},
            .pulse_us = 100,
            .pause_us = 200,
            .settle_us = 5000};
  }
  std::unique_ptr<Trigger> trigger(const GpioTriggerSettings& settings) {
    auto opened = open_gpio_trigger(settings, *gpio, gpio);
    EXPECT_TRUE(opened) << opened.error().message;
    return *std::move(opened);
  }
  std::unique_ptr<Projector> projector() {
    auto opened = open_gpio_projector(stepped(), *gpio, gpio);
    EXPECT_TRUE(opened) << opened.error().message;
    return *std::move(opened);
  }
  int pulses(const std::string& line) const {
    return static_cast<int>(std::count_if(gpio->edges.begin(), gpio->edges.end(),
                                          [&](const Edge& edge) { return edge.line == line && edge.active; }));
  }
  bool all_at_rest() const {
    return std::none_of(gpio->active.begin(), gpio->active.end(), [](const auto& line) { return line.second; });
  }

  std::shared_ptr<SimulatedGpio> gpio = std::make_shared<SimulatedGpio>();
};

TEST_F(Gpio, ATriggerIsOnePulseOfItsWidth) {
  const auto line = trigger(plain());
  EXPECT_EQ(line->driver(), "gpio");
  EXPECT_TRUE(gpio->edges.empty()) << "opening triggers nothing";
  gpio->sleep_until(milliseconds(7));
  EXPECT_EQ(*line->fire(), milliseconds(7));
  EXPECT_THAT(gpio->edges, ElementsAre(Edge{7000, "T", true}, Edge{7500, "T", false}));
}

TEST_F(Gpio, LightsLeadTheTriggerAndHold) {
  const auto line = trigger(lit());
  EXPECT_EQ(*line->fire(), milliseconds(1));
  EXPECT_THAT(gpio->edges,
              ElementsAre(Edge{0, "L", true}, Edge{1000, "T", true}, Edge{1500, "T", false}, Edge{21000, "L", false}));
}

TEST_F(Gpio, GrayCodesAreTakenInTheDark) {
  const auto line = trigger(lit());
  line->prepare(ShotRole::gray_code);
  ASSERT_TRUE(line->fire());
  EXPECT_EQ(pulses("L"), 0);
  line->prepare(ShotRole::background);
  ASSERT_TRUE(line->fire());
  EXPECT_EQ(pulses("L"), 1);
  EXPECT_EQ(pulses("T"), 2);
}

/// Whatever setting of a line fails, nothing stays active.
TEST_F(Gpio, EveryFailureLeavesAllLinesAtRest) {
  for (int works_for = 0; works_for < 4; ++works_for) {
    gpio->works_for = 1 << 30;
    const auto line = trigger(lit());
    gpio->works_for = works_for;
    const auto fired = line->fire();
    ASSERT_FALSE(fired);
    EXPECT_EQ(fired.error().code, ErrorCode::device_lost);
    EXPECT_THAT(fired.error().message, testing::AnyOf("T cannot be set", "L cannot be set"));
    EXPECT_TRUE(all_at_rest()) << works_for;
  }
}

TEST_F(Gpio, LinesAreFreedWithTheTrigger) {
  {
    const auto line = trigger(lit());
    EXPECT_THAT(gpio->held, ElementsAre("L", "T"));
  }
  EXPECT_TRUE(gpio->held.empty());
  gpio->missing = {"L"};
  EXPECT_EQ(open_gpio_trigger(lit(), *gpio, gpio).error().message, "gpio lights: line L is gone");
  EXPECT_TRUE(gpio->held.empty());
}

TEST_F(Gpio, AProjectorIsResetWhenItIsOpenedAndWhenItIsClosed) {
  {
    const auto steps = projector();
    EXPECT_EQ(pulses("R"), 1);
    EXPECT_EQ(pulses("S"), 0);
    ASSERT_TRUE(steps->show(0));
    EXPECT_EQ(pulses("S"), 1);
  }
  EXPECT_EQ(pulses("R"), 2);
  EXPECT_TRUE(all_at_rest());
}

TEST_F(Gpio, AProjectorStepsToThePatternThatIsAskedFor) {
  const auto steps = projector();
  ASSERT_TRUE(steps->show(2));
  EXPECT_EQ(pulses("S"), 3);
  ASSERT_TRUE(steps->show(2)) << "taken again";
  EXPECT_EQ(pulses("S"), 3);
  ASSERT_TRUE(steps->show(3));
  EXPECT_EQ(pulses("S"), 4);
  EXPECT_EQ(pulses("R"), 1);
  ASSERT_TRUE(steps->show(1)) << "behind: over the reset";
  EXPECT_EQ(pulses("R"), 2);
  EXPECT_EQ(pulses("S"), 6);
  steps->dark();
  EXPECT_EQ(pulses("R"), 3);
  steps->dark();
  EXPECT_EQ(pulses("R"), 3) << "it is dark already";
}

TEST_F(Gpio, AProjectorWaitsUntilThePatternIsThere) {
  const auto steps = projector();
  const Timestamp begin = gpio->now();
  ASSERT_TRUE(steps->show(1));
  EXPECT_EQ(gpio->now() - begin, (2 * (100 + 200) + 5000) * 1000);
}

TEST_F(Gpio, AProjectorHasNoOtherPatterns) {
  const auto steps = projector();
  EXPECT_EQ(steps->show(8).error().message, "projector: has no pattern 8, only 0 to 7");
  EXPECT_EQ(steps->show(-1).error().code, ErrorCode::invalid_argument);
}

/// After a fault nobody knows how far the projector got.
TEST_F(Gpio, AProjectorThatFailedStartsOverAndIsDark) {
  for (int works_for = 0; works_for < 4; ++works_for) {
    const auto steps = projector();
    gpio->works_for = works_for;
    EXPECT_FALSE(steps->show(1));
    gpio->works_for = 1 << 30;
    EXPECT_EQ(gpio->edges.back().line, "R") << works_for;
    EXPECT_TRUE(all_at_rest());
    gpio->edges.clear();
    ASSERT_TRUE(steps->show(1));
    EXPECT_EQ(pulses("S"), 2) << "from the first pattern on";
  }
}

TEST_F(Gpio, AProjectorWhoseLinesCannotBeHadOrSetIsNamed) {
  for (const char* line : {"S", "R"}) {
    gpio->missing = {line};
    EXPECT_EQ(open_gpio_projector(stepped(), *gpio, gpio).error().message,
              std::string("projector: line ") + line + " is gone");
    EXPECT_TRUE(gpio->held.empty());
  }
  gpio->missing.clear();
  gpio->works_for = 0;
  EXPECT_EQ(open_gpio_projector(stepped(), *gpio, gpio).error().message, "projector: R cannot be set");
  EXPECT_TRUE(gpio->held.empty());
}

TEST_F(Gpio, WhatAKilledProcessLeftActiveIsBroughtToRest) {
  const auto trigger_lines = lit();
  const auto projector_lines = stepped();
  gpio->held.clear();
  ASSERT_TRUE(rest_gpio_lines(&trigger_lines, &projector_lines, *gpio, gpio));
  EXPECT_TRUE(all_at_rest());
  EXPECT_EQ(pulses("R"), 1) << "the projector is where it is dark";
  EXPECT_EQ(pulses("S") + pulses("T") + pulses("L"), 0);
  EXPECT_TRUE(gpio->held.empty()) << "the service may have them";
  EXPECT_TRUE(rest_gpio_lines(nullptr, nullptr, *gpio, gpio)) << "there are none";
  gpio->missing = {"T"};
  EXPECT_EQ(rest_gpio_lines(&trigger_lines, &projector_lines, *gpio, gpio).error().message,
            "gpio trigger: line T is gone");
  EXPECT_EQ(pulses("R"), 2) << "the others all the same";
}

std::string fault(const auto& settings) {
  const auto checked = check(settings);
  return checked ? "" : checked.error().message;
}

TEST_F(Gpio, BadSettingsAreNamed) {
  EXPECT_EQ(fault(lit()), "");
  auto bad = plain();
  bad.pulse_us = 5;
  EXPECT_EQ(fault(bad), "gpio: pulse_us is 5, expected 10 … 100000");
  EXPECT_EQ(open_gpio_trigger(bad, *gpio, gpio).error().code, ErrorCode::invalid_argument);
  bad = plain();
  bad.trigger.line.clear();
  EXPECT_EQ(fault(bad), "gpio.trigger: line is empty, expected its offset or its name");
  bad = lit();
  bad.lights->line = "T";
  EXPECT_EQ(fault(bad), "gpio.trigger and gpio.lights are both line T of gpiochip0");
  bad = lit();
  bad.lights_hold_us = -1;
  EXPECT_EQ(fault(bad), "gpio: lights_hold_us is -1, expected 0 … 1000000");
  auto projector = stepped();
  projector.reset.chip.clear();
  EXPECT_EQ(fault(projector), "projector.reset: chip is empty, expected a GPIO chip");
  projector = stepped();
  projector.reset.line = "S";
  EXPECT_EQ(fault(projector), "projector.step and projector.reset are both line S of gpiochip0");
  projector = stepped();
  projector.id = "a/b";
  EXPECT_EQ(fault(projector), "gpio projector: id is \"a/b\", expected a file-name safe name");
  projector = stepped();
  projector.pattern.width = 0;
  EXPECT_EQ(fault(projector), "projector: width is 0, expected 1 … 16384");
}

TEST(LinuxGpio, AChipThatIsNotThereIsNamed) {
  const MonotonicClock clock;
  const auto opened = open_gpio_trigger({.trigger = {.chip = "no-such-chip", .line = "0"}}, clock);
  ASSERT_FALSE(opened);
  EXPECT_EQ(opened.error().code, ErrorCode::device_lost);
  EXPECT_EQ(opened.error().message,
            "gpio trigger: line 0 of no-such-chip cannot be had, as the chip cannot be opened: No such file or "
            "directory");
}

}  // namespace
}  // namespace booth
