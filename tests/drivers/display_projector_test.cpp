#include <gtest/gtest.h>

#include <cerrno>
#include <filesystem>
#include <functional>
#include <memory>
#include <string>

#include "drivers/display/display_projector.h"
#include "tests/drivers/simulated_card.h"

namespace booth {
namespace {

/// What an operator reads when a card or a display fails.
class DisplayProjector : public testing::Test {
 protected:
  DisplaySettings settings() const { return {.card = card.path(), .delay_us = 0}; }
  void expect_refusal(const DisplaySettings& asked, ErrorCode code, const std::string& message) {
    const auto opened = open_display_projector(asked, clock);
    ASSERT_FALSE(opened) << message;
    EXPECT_EQ(opened.error().code, code) << message;
    EXPECT_EQ(opened.error().message, message);
    EXPECT_EQ(card.buffers, 0u) << "the card's memory was not given back";
  }
  std::unique_ptr<FlippingProjector> open() {
    auto opened = open_display_projector(settings(), clock);
    EXPECT_TRUE(opened) << opened.error().message;
    return opened ? *std::move(opened) : nullptr;
  }

  const MonotonicClock clock;
  SimulatedCard card;
};

TEST_F(DisplayProjector, ShowsPatternsAndIsBlackBesides) {
  auto projector = open();
  ASSERT_TRUE(projector);
  const uint32_t black = card.shown_buffer;
  ASSERT_TRUE(projector->show(0));
  EXPECT_NE(card.shown_buffer, black);
  projector->dark();
  EXPECT_EQ(card.shown_buffer, black);
  EXPECT_EQ(projector->show(-1).error().message, "projector: has no pattern -1, only 0 to 19");
  projector.reset();
  EXPECT_EQ(card.buffers, 0u);
}

TEST_F(DisplayProjector, SaysWhatTheCardCannotDo) {
  card.has_dumb_buffers = false;
  expect_refusal(settings(), ErrorCode::unsupported, "projector: " + card.path() + " has no plain picture memory");
  card.has_dumb_buffers = true;
  card.stamps_with_monotonic_clock = false;
  expect_refusal(settings(), ErrorCode::unsupported,
                 "projector: " + card.path() + " does not stamp its flips with the monotonic clock");
  card.stamps_with_monotonic_clock = true;
  card.drives_displays = false;
  expect_refusal(settings(), ErrorCode::unsupported, "projector: " + card.path() + " drives no displays");
}

TEST_F(DisplayProjector, SaysWhereTheCardsMemoryEnds) {
  const std::pair<int SimulatedCard::*, const char*> cases[] = {
      {&SimulatedCard::create_error, "projector: the card gives no picture memory: Cannot allocate memory"},
      {&SimulatedCard::add_error, "projector: the card gives no frame buffer: Cannot allocate memory"},
      {&SimulatedCard::map_error, "projector: the card gives no way to its picture memory: Cannot allocate memory"}};
  for (const auto& [call, message] : cases) {
    card.*call = ENOMEM;
    expect_refusal(settings(), ErrorCode::unsupported, message);
    card.*call = 0;
  }
}

TEST_F(DisplayProjector, SaysThatAnotherProgramDraws) {
  card.master_error = EBUSY;
  expect_refusal(settings(), ErrorCode::busy,
                 "projector: another program draws on " + card.path() + " (Device or resource busy)");
}

TEST_F(DisplayProjector, SaysWhatIsConnected) {
  card.connectors = {{.number = 1, .connected = false}, {.number = 2}, {.number = 3}};
  expect_refusal(settings(), ErrorCode::invalid_argument,
                 "projector: several displays are connected to " + card.path() +
                     "; name the connector, one of HDMI-A-1, HDMI-A-2 (connected), HDMI-A-3 (connected)");
  auto named = settings();
  named.connector = "HDMI-A-1";
  expect_refusal(named, ErrorCode::device_lost, "projector: nothing is connected to HDMI-A-1 of " + card.path());
  named.connector = "DP-1";
  expect_refusal(named, ErrorCode::invalid_argument,
                 "projector: connector DP-1 is not on " + card.path() +
                     ", which has HDMI-A-1, HDMI-A-2 (connected), HDMI-A-3 (connected)");
  card.connectors.resize(1);
  expect_refusal(settings(), ErrorCode::device_lost, "projector: no display is connected to " + card.path());
}

TEST_F(DisplayProjector, SaysThatADisplayCannotBeDriven) {
  card.connectors = {{.has_modes = false}};
  expect_refusal(settings(), ErrorCode::device_lost, "projector: the display offers no mode");
  card.connectors = {{.has_crtc = false}};
  expect_refusal(settings(), ErrorCode::unsupported, "projector: " + card.path() + " cannot drive HDMI-A-1 now");
  card.connectors = {{}};
  card.mode_error = EINVAL;
  expect_refusal(settings(), ErrorCode::device_lost, "projector: its mode cannot be set: Invalid argument");
}

/// It gives up after a while, is black as far as the card lets it, and does not wait again with every pattern.
TEST_F(DisplayProjector, AFlipThatNeverCompletesIsReported) {
  const auto projector = open();
  ASSERT_TRUE(projector);
  const uint32_t black = card.shown_buffer;
  card.flips = false;
  card.shown_buffer = 0;
  const auto shown = projector->show(0);
  ASSERT_FALSE(shown);
  EXPECT_EQ(shown.error().code, ErrorCode::device_lost);
  EXPECT_EQ(shown.error().message, "projector: it has not flipped for 2000 ms: Connection timed out");
  EXPECT_EQ(card.shown_buffer, black) << "by setting the mode anew";
  const auto again = projector->show(1);
  ASSERT_FALSE(again);
  EXPECT_EQ(again.error().message, "projector: it does not flip any more: Connection timed out");
}

TEST_F(DisplayProjector, AFlipThatIsRefusedIsReported) {
  const auto projector = open();
  ASSERT_TRUE(projector);
  card.flip_error = EBUSY;
  EXPECT_EQ(projector->show(0).error().message, "projector: it does not flip: Device or resource busy");
  card.flip_error = EACCES;
  EXPECT_EQ(projector->show(0).error().message,
            "projector: it does not flip: another program took " + card.path() + " over");
  card.flip_error = 0;
  card.event_error = EIO;
  const auto untold = projector->show(0);
  EXPECT_EQ(untold.error().code, ErrorCode::device_lost);
  EXPECT_EQ(untold.error().message, "projector: it does not say when it flips: Input/output error");
  card.event_error = 0;
  EXPECT_TRUE(projector->show(0)) << "and goes on";
}

TEST_F(DisplayProjector, SaysThatThereIsNoCard) {
  if (std::filesystem::exists("/dev/dri")) GTEST_SKIP() << "this machine has a graphics card";
  expect_refusal({}, ErrorCode::device_lost, "projector: this machine has no graphics card in /dev/dri");
}

}  // namespace
}  // namespace booth
