#include <gmock/gmock.h>
#include <syslog.h>

#include "daemon/identifier.h"
#include "daemon/log.h"
#include "daemon/metrics.h"
#include "daemon/prometheus.h"
#include "daemon/redaction.h"

namespace booth {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::Not;

TEST(Prometheus, WritesNumbersAndHistograms) {
  Metrics metrics;
  metrics.add("requests", 7);
  metrics.add("camera_body-00_frames", 3);
  metrics.observe("request_seconds", 0.02);
  metrics.observe("request_seconds", 30);
  const std::string text = prometheus_text(metrics.snapshot());
  EXPECT_THAT(text, HasSubstr("\nbooth_requests 7\n"));
  EXPECT_THAT(text, HasSubstr("\nbooth_camera_body_00_frames 3\n"));
  EXPECT_THAT(text, HasSubstr("# TYPE booth_request_seconds histogram\n"));
  EXPECT_THAT(text, HasSubstr("booth_request_seconds_bucket{le=\"0.01\"} 0\n"
                              "booth_request_seconds_bucket{le=\"0.1\"} 1\n"));
  EXPECT_THAT(text, HasSubstr("booth_request_seconds_bucket{le=\"100\"} 2\n"
                              "booth_request_seconds_bucket{le=\"+Inf\"} 2\n"));
  EXPECT_THAT(text, HasSubstr("booth_request_seconds_count 2\n"));
  EXPECT_THAT(text, Not(HasSubstr("untyped\nbooth_request_seconds")));
}

TEST(Redaction, TakesOutEveryIdThatIsMade) {
  const std::string first = make_capture_id(std::chrono::system_clock::now());
  const std::string second = make_capture_id(std::chrono::system_clock::now());
  ASSERT_NE(first, second);
  Redaction redaction({});
  const std::string text = redaction.apply("capture " + first + " and /x/" + second + "/y, again " + first);
  EXPECT_EQ(text, "capture capture-1 and /x/capture-2/y, again capture-1");
  EXPECT_EQ(redaction.apply(second), "capture-2") << "the same in another text";
  EXPECT_THAT(capture_ids_in(first + second + first), ElementsAre(first, second));
}

TEST(JournalFields, NameTheCaptureAndTheJob) {
  const std::string id = "2026-11-22T10-15-00.123Z-00ff";
  EXPECT_THAT(journal_fields(LOG_WARNING, "capture " + id + ": failed: timeout: b1 is late"),
              testing::IsSupersetOf({"MESSAGE=capture " + id + ": failed: timeout: b1 is late",
                                     std::string("PRIORITY=4"), "BOOTH_CAPTURE=" + id}));
  EXPECT_THAT(journal_fields(LOG_INFO, "job " + id + ": done"),
              testing::IsSupersetOf({std::string("PRIORITY=6"), "BOOTH_JOB=" + id, "BOOTH_CAPTURE=" + id}));
}

TEST(JournalFields, WhatIsNoIdIsNone) {
  for (const char* text : {"the capture thread: out of memory", "capture ../../etc: failed", "capture", "capture : x",
                           "job two words: started", "stopping", ""})
    EXPECT_THAT(journal_fields(LOG_INFO, text), Not(testing::Contains(HasSubstr("BOOTH_")))) << text;
}

TEST(Redaction, TakesOutLabels) {
  Redaction redaction({"Zoë", "", "Zoë Müller"});
  EXPECT_EQ(redaction.apply("Zoë Müller met Zoë"), "… met …");
  EXPECT_THAT(capture_ids_in("nothing 2026-11-22T10:15:00Z"), IsEmpty());
}

}  // namespace
}  // namespace booth
