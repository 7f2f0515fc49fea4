#include <arpa/inet.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <functional>

#include "drivers/aravis/aravis_source.h"
#include "drivers/aravis/device_clock.h"
#include "drivers/aravis/frame_matcher.h"
#include "drivers/aravis/gvcp.h"
#include "drivers/aravis/ptp_watch.h"

namespace booth {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;
using Verdict = FrameMatcher::Verdict;

// Settings.

AravisSettings good_settings() {
  return {.cameras = {{.id = "left", .serial = "A1"}, {.id = "right", .address = "10.0.0.2"}}};
}

TEST(AravisSettings, DefaultsAreFine) {
  const auto checked = check(good_settings());
  EXPECT_TRUE(checked) << checked.error().message;
}

TEST(AravisSettings, EachBadValueIsNamedWithWhatWouldDo) {
  struct Case {
    std::function<void(AravisSettings&)> spoil;
    const char* message;
  };
  const Case cases[] = {
      {[](auto& s) { s.cameras[0].exposure_us = 0; }, "camera left: exposure_us: 0, expected 1 … 1e+07"},
      {[](auto& s) { s.cameras[0].exposure_us = std::nan(""); }, "camera left: exposure_us: nan, expected"},
      {[](auto& s) { s.cameras[0].gain_db = -1; }, "camera left: gain_db: -1, expected 0 … 60"},
      {[](auto& s) { s.cameras[0].pattern_exposure_us = 2e7; }, "camera left: pattern_exposure_us: 2e+07"},
      {[](auto& s) { s.cameras[0].pattern_gain_db = 61; }, "camera left: pattern_gain_db: 61"},
      {[](auto& s) { s.cameras[0].white_balance_red = 0; }, "camera left: white_balance_red: 0, expected 0.1 … 16"},
      {[](auto& s) { s.cameras[0].white_balance_blue = 20; }, "camera left: white_balance_blue: 20"},
      {[](auto& s) { s.cameras[0].pixel_format = "Mono10"; }, "camera left: pixel_format: \"Mono10\", expected Mono8"},
      {[](auto& s) { s.cameras[0].region.x = -2; }, "camera left: region.x: -2, expected 0 … 65535"},
      {[](auto& s) { s.cameras[0].region.height = 70000; }, "camera left: region.height: 70000"},
      {[](auto& s) { s.cameras[0].trigger_line = ""; }, "camera left: trigger_line: \"\", expected a line's name"},
      {[](auto& s) { s.cameras[0].trigger_selector = "a b"; }, "camera left: trigger_selector: \"a b\""},
      {[](auto& s) { s.cameras[0].trigger_delay_us = -1; }, "camera left: trigger_delay_us: -1"},
      {[](auto& s) { s.cameras[0].action = 32; }, "camera left: action: 32, expected 0 … 31"},
      {[](auto& s) { s.cameras[0].preview_fps = 0; }, "camera left: preview_fps: 0, expected 1 … 60"},
      {[](auto& s) { s.cameras[0].packet_size = 100; }, "camera left: packet_size: 100, expected 576 … 16384"},
      {[](auto& s) { s.cameras[0].packet_delay_ns = -1; }, "camera left: packet_delay_ns: -1"},
      {[](auto& s) { s.cameras[0].resend_ratio = 1.5; }, "camera left: resend_ratio: 1.5, expected 0 … 1"},
      {[](auto& s) { s.cameras[0].packet_timeout_ms = 0; }, "camera left: packet_timeout_ms: 0"},
      {[](auto& s) { s.cameras[0].frame_retention_ms = 0; }, "camera left: frame_retention_ms: 0"},
      {[](auto& s) { s.cameras[0].socket_buffer_kib = 1; }, "camera left: socket_buffer_kib: 1, expected 64"},
      {[](auto& s) { s.cameras[0].buffers = 1; }, "camera left: buffers: 1, expected 2 … 256"},
      {[](auto& s) { s.cameras[0].heartbeat_ms = 500; }, "camera left: heartbeat_ms: 500, expected 2000 … 60000"},
      {[](auto& s) {
         s.cameras[0].features = {{"No blanks", "1"}};
       },
       "camera left: features: \"No blanks\""},
      {[](auto& s) { s.cameras[0].address = "10.0.0.9"; }, "camera left: serial: \"A1\" with address \"10.0.0.9\""},
      {[](auto& s) { s.cameras[0].serial = ""; }, "expected either a serial number or an address"},
      {[](auto& s) { s.cameras[1].id = "left"; }, "camera left: id: \"left\", expected an id that no other camera has"},
      {[](auto& s) { s.cameras[1].id = "a/b"; }, "camera a/b: id: \"a/b\", expected letters"},
      {[](auto& s) { s.cameras[1].address = "", s.cameras[1].serial = "A1"; },
       "camera right: serial: serial A1, expected a device that no other camera is"},
      {[](auto& s) { s.cameras[0].trigger = AravisTriggerSource::action, s.action.group_mask = 0; },
       "action: group_mask: 0, expected at least one bit"},
      {[](auto& s) { s.cameras[0].trigger = AravisTriggerSource::action, s.action.destinations.clear(); },
       "action: destinations: 0 of them, expected 1 … 64"},
      {[](auto& s) { s.cameras[0].trigger = AravisTriggerSource::action, s.action.schedule_ahead_us = 10; },
       "action: schedule_ahead_us: 10, expected 1000 … 1000000"},
      {[](auto& s) { s.cameras[0].trigger = AravisTriggerSource::action, s.action.acknowledge_timeout_ms = 0; },
       "action: acknowledge_timeout_ms: 0, expected 1 … 10000"},
  };
  const MonotonicClock clock;
  for (const Case& one : cases) {
    AravisSettings settings = good_settings();
    one.spoil(settings);
    const auto source = AravisSource::create(settings, clock);
    ASSERT_FALSE(source) << one.message;
    EXPECT_EQ(source.error().code, ErrorCode::invalid_argument);
    EXPECT_THAT(source.error().message, HasSubstr(one.message));
  }
}

TEST(AravisSource, KnowsOnlyWhatIsConfigured) {
  const MonotonicClock clock;
  const auto source = AravisSource::create(good_settings(), clock);
  ASSERT_TRUE(source);
  EXPECT_EQ((*source)->open_camera("middle").error().code, ErrorCode::not_found);
  EXPECT_EQ((*source)->open_trigger().error().code, ErrorCode::unsupported);
  EXPECT_EQ((*source)->open_projector().error().code, ErrorCode::unsupported);
}

// The camera's clock.

TEST(DeviceClock, FollowsAClockThatRunsFast) {
  DeviceClock clock;
  EXPECT_FALSE(clock.host_time(0));
  const auto device = [](Timestamp host) {
    return (host - seconds(1000)) + (host - seconds(1000)) / 10'000;
  };  // 100 ppm
  for (int i = 0; i <= 10; ++i) {
    const Timestamp host = seconds(1000 + i);
    clock.note_reading(device(host), host - 50'000, host + 50'000);
  }
  EXPECT_NEAR(clock.drift_ppm(), 100, 0.1);
  EXPECT_EQ(clock.uncertainty_ns(), 50'000);
  const Timestamp later = seconds(1020);
  EXPECT_NEAR(static_cast<double>(*clock.host_time(device(later)) - later), 0, 10'000);
  EXPECT_NEAR(static_cast<double>(*clock.device_time(later) - device(later)), 0, 10'000);
}

TEST(DeviceClock, ASlowAnswerDoesNotReplaceAQuickOne) {
  DeviceClock clock;
  clock.note_reading(seconds(5), seconds(100) - 10'000, seconds(100) + 10'000);
  clock.note_reading(seconds(6), seconds(101) - milliseconds(80), seconds(101) + milliseconds(1));
  EXPECT_EQ(*clock.host_time(seconds(6)), seconds(101));
  EXPECT_EQ(clock.uncertainty_ns(), 10'000);
}

TEST(DeviceClock, AClockThatWasSetIsBelievedAtOnce) {
  DeviceClock clock;
  clock.note_reading(seconds(5), seconds(100), seconds(100) + 1000);
  clock.note_reading(seconds(7), seconds(102), seconds(102) + 1000);
  clock.note_reading(seconds(1'700'000'000), seconds(104), seconds(104) + 1000);  // PTP took over
  EXPECT_NEAR(static_cast<double>(*clock.host_time(seconds(1'700'000'001)) - seconds(105)), 0, 2000);
}

TEST(DeviceClock, ArrivalsBoundItWhereItCannotBeAsked) {
  DeviceClock clock;
  clock.note_arrival(seconds(1), seconds(51) + milliseconds(30));
  clock.note_arrival(seconds(2), seconds(52) + milliseconds(12));
  clock.note_arrival(seconds(3), seconds(53) + milliseconds(40));
  EXPECT_EQ(*clock.host_time(seconds(3)), seconds(53) + milliseconds(12));
  EXPECT_FALSE(clock.device_time(seconds(53)));
}

// Which frame answers which trigger.

constexpr Timestamp second = seconds(1);

TEST(FrameMatcher, AnUncertainClockWidensWhatATriggerExplains) {
  FrameMatcher matcher;
  matcher.begin(2);
  matcher.note_trigger(0, second);
  const Timestamp early = second - milliseconds(20);
  EXPECT_EQ(matcher.match(1, early, 0, second * 2).verdict, Verdict::unwanted);
  EXPECT_EQ(matcher.match(1, early, milliseconds(16), second * 2).verdict, Verdict::answers);
}

TEST(PtpWatch, NamesSeveralMastersOnce) {
  PtpWatch watch;
  EXPECT_EQ(watch.note("a", "Master"), std::nullopt);
  EXPECT_EQ(watch.note("b", "Slave"), std::nullopt);
  EXPECT_EQ(watch.note("c", "Master"),
            "ptp: a, c are all masters, so that their clocks do not agree: they must be on one network");
  EXPECT_EQ(watch.note("c", "Master"), std::nullopt) << "that was said";
  EXPECT_EQ(watch.note("a", "Slave"), std::nullopt);
  EXPECT_TRUE(watch.note("a", "Master"));
}

TEST(FrameMatcher, CountsWhereNoTriggerIsNoted) {
  FrameMatcher matcher;
  matcher.begin(3);
  for (int i = 0; i < 3; ++i) {
    const auto match = matcher.match(static_cast<uint64_t>(17 + i), second * i, 0, second * i);
    EXPECT_EQ(match.verdict, Verdict::answers);
    EXPECT_EQ(match.index, i);
  }
  EXPECT_EQ(matcher.match(20, second * 3, 0, second * 3).verdict, Verdict::too_many);
}

TEST(FrameMatcher, AGapInTheIdsIsALostFrame) {
  FrameMatcher matcher;
  matcher.begin(10);
  EXPECT_EQ(matcher.match(65534, 0, 0, 0).index, 0);
  matcher.note_damaged();                         // 65535
  EXPECT_EQ(matcher.match(1, 0, 0, 0).index, 2);  // ids go round without 0
  EXPECT_EQ(matcher.match(5, 0, 0, 0).index, 6);
  matcher.begin(10);
  matcher.note_damaged();
  matcher.note_damaged();
  EXPECT_EQ(matcher.match(3, 0, 0, 0).index, 2) << "damaged frames answered triggers, too";
}

TEST(FrameMatcher, CamerasWithoutIdsAreCounted) {
  FrameMatcher matcher;
  matcher.begin(3);
  for (int i = 0; i < 3; ++i) EXPECT_EQ(matcher.match(0, 0, 0, 0).index, i);
}

TEST(FrameMatcher, TheInstantDecidesWhereTheCountSlipped) {
  FrameMatcher matcher;
  matcher.begin(4);
  for (int i = 0; i < 4; ++i) matcher.note_trigger(i, second * (i + 1));
  EXPECT_EQ(matcher.match(1, second + 400, 0, second).index, 0);
  // Trigger 1 was not seen by the camera, so it did not count it either.
  const auto slipped = matcher.match(2, second * 3 + 400, 0, second * 3);
  EXPECT_EQ(slipped.verdict, Verdict::answers);
  EXPECT_EQ(slipped.index, 2);
  EXPECT_TRUE(slipped.slipped);
  EXPECT_EQ(matcher.match(3, second * 4 + 400, 0, second * 4).index, 3);
}

TEST(FrameMatcher, AFrameThatNothingTriggeredIsUnwanted) {
  FrameMatcher matcher;
  matcher.begin(3);
  matcher.note_trigger(0, second);
  EXPECT_EQ(matcher.match(1, second + 400, 0, second).index, 0);
  // Noise on the line half a second later: perhaps its trigger is yet to be noted, but not for ever.
  const Timestamp noise = second + second / 2;
  EXPECT_EQ(matcher.match(2, noise, 0, noise + 1000).verdict, Verdict::wait);
  EXPECT_EQ(matcher.match(2, noise, 0, matcher.wait_until(noise)).verdict, Verdict::unwanted);
  matcher.note_trigger(1, second * 2);
  const auto next = matcher.match(3, second * 2 + 400, 0, second * 2);
  EXPECT_EQ(next.verdict, Verdict::answers);
  EXPECT_EQ(next.index, 1);
  // Twice for one trigger.
  EXPECT_EQ(matcher.match(4, second * 2 + 900, 0, second * 3).verdict, Verdict::unwanted);
}

TEST(FrameMatcher, AFrameMayComeBeforeItsTriggerIsNoted) {
  FrameMatcher matcher;
  matcher.begin(1);
  matcher.note_trigger(0, second);
  matcher.begin(1);
  EXPECT_EQ(matcher.match(1, second * 2, 0, second * 2 + 1000).verdict, Verdict::wait);
  matcher.note_trigger(0, second * 2 - 100);
  EXPECT_EQ(matcher.match(1, second * 2, 0, second * 2 + 2000).index, 0);
}

TEST(FrameMatcher, KnowsWhatIsOwed) {
  FrameMatcher matcher;
  matcher.begin(1);
  EXPECT_FALSE(matcher.owes_answer(second * 9));
  matcher.note_trigger(0, second);
  EXPECT_FALSE(matcher.owes_answer(second - 1));
  EXPECT_TRUE(matcher.owes_answer(second));
  EXPECT_EQ(matcher.match(1, second, 0, second).verdict, Verdict::answers);
  EXPECT_FALSE(matcher.owes_answer(second * 9));
  matcher.note_trigger(1, second * 2);
  EXPECT_FALSE(matcher.owes_answer(second * 9)) << "it is not armed for that one";
}

// GVCP.

TEST(ActionCommand, HasTheBytesOfTheStandard) {
  const AravisActionSettings settings{.device_key = 0x01020304, .group_key = 0x0a0b0c0d, .group_mask = 0xf0};
  EXPECT_THAT(action_command(settings, 0x1234, std::nullopt),
              ElementsAre(0x42, 0x01, 0x01, 0x00, 0x00, 0x0c, 0x12, 0x34,  // key, acknowledge, ACTION_CMD, length, id
                          0x01, 0x02, 0x03, 0x04, 0x0a, 0x0b, 0x0c, 0x0d, 0x00, 0x00, 0x00, 0xf0));
  EXPECT_THAT(action_command(settings, 1, 0x1122334455667788),
              ElementsAre(0x42, 0x81, 0x01, 0x00, 0x00, 0x14, 0x00, 0x01, 0x01, 0x02, 0x03, 0x04, 0x0a, 0x0b, 0x0c,
                          0x0d, 0x00, 0x00, 0x00, 0xf0, 0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88));
}

TEST(ActionCommand, OnlyItsOwnAcknowledgeCounts) {
  in_addr from{};
  from.s_addr = htonl(0x0a000001);
  const std::vector<uint8_t> good{0x00, 0x00, 0x01, 0x01, 0x00, 0x00, 0x12, 0x34};
  const auto parsed = parse_action_acknowledge(good, from, 0x1234);
  ASSERT_TRUE(parsed);
  EXPECT_EQ(parsed->status, 0);
  EXPECT_EQ(to_text(parsed->from), "10.0.0.1");
  EXPECT_FALSE(parse_action_acknowledge(good, from, 0x1235)) << "of another command";
  EXPECT_FALSE(parse_action_acknowledge({0x00, 0x00, 0x01}, from, 0x1234)) << "cut off";
  std::vector<uint8_t> other = good;
  other[3] = 0x03;
  EXPECT_FALSE(parse_action_acknowledge(other, from, 0x1234)) << "of another kind";
  other = good;
  other[0] = 0x80, other[1] = 0x02;
  EXPECT_EQ(parse_action_acknowledge(other, from, 0x1234)->status, 0x8002);
}

TEST(ActionCommand, ADestinationMustBeAHost) {
  const auto sender = ActionSender::create({.destinations = {"not a host"}});
  ASSERT_FALSE(sender);
  EXPECT_EQ(sender.error().message, "action: destinations: \"not a host\", expected an address or a known host");
}

}  // namespace
}  // namespace booth
