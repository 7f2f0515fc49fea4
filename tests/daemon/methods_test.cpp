#include <gmock/gmock.h>

#include <map>

#include "pipeline/export/sha256.h"
#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

using testing::Contains;
using testing::ElementsAre;
using testing::IsEmpty;
using testing::Not;
using testing::SizeIs;

class Methods : public TestBooth {
 protected:
  void SetUp() override {
    TestBooth::SetUp();
    start();
  }
  /// An avatar that is there without a capture.
  void put_avatar(const std::string& id, const std::string& created, const std::string& file) {
    const fs::path folder = options_.config.booth.avatars() / id;
    fs::create_directories(folder);
    std::ofstream(folder / "avatar.dae") << file;
    std::ofstream(folder / "metadata.json")
        << Json{{"id", id}, {"created", created}, {"label", ""}, {"recording", id}, {"triangles", 7}};
    ASSERT_TRUE(booth_->avatars().publish(id));
  }
};

TEST_F(Methods, DescribeTellsWhatThereIs) {
  const Json about = call("system.describe");
  EXPECT_EQ(about["name"], "booth");
  EXPECT_EQ(about["version"], BOOTH_VERSION);
  EXPECT_EQ(about["api"], 1);
  EXPECT_THAT(about["methods"].get<std::vector<std::string>>(), Contains("avatar.fetch"));
  EXPECT_THAT(about["topics"].get<std::vector<std::string>>(), Contains("job.progress"));
  EXPECT_THAT(about["stages"].get<std::vector<std::string>>(), Contains("hull"));
}

TEST_F(Methods, StatusTellsEverything) {
  const Json status = call("system.status");
  EXPECT_EQ(status["state"], "idle");
  EXPECT_EQ(status["ready"], true);
  EXPECT_THAT(status["not_ready"], IsEmpty());
  EXPECT_TRUE(status.at("capture").is_null());
  EXPECT_THAT(status["tasks"], IsEmpty());
  ASSERT_THAT(status["cameras"], SizeIs(6));
  const Json& camera = status["cameras"][0];
  EXPECT_EQ(camera["id"], "b0");
  EXPECT_EQ(camera["driver"], "replay");
  EXPECT_EQ(camera["role"], "body");
  EXPECT_EQ(camera["state"], "online");
  EXPECT_TRUE(camera.at("message").is_null());
  EXPECT_GE(camera["last_frame_age_s"], 0) << "its test frame";
  EXPECT_EQ(camera["frames"], 0);
  EXPECT_TRUE(camera.at("fault").is_null());
  EXPECT_EQ(status["projector"]["id"], "beamer");
  EXPECT_EQ(status["trigger"]["driver"], "replay");
  EXPECT_EQ(status["calibration"]["loaded"], true);
  EXPECT_EQ(status["calibration"]["rms_px"], 0.25);
  EXPECT_EQ(status["background"]["learned"], true);
  EXPECT_THAT(status["queue"], IsEmpty());
  EXPECT_GT(status["disk"]["free_bytes"], 0);
  EXPECT_GE(status["uptime_s"], 0);
}

TEST_F(Methods, MetricsAreFlatNumbers) {
  const Json metrics = call("system.metrics");
  EXPECT_GE(metrics.at("requests"), 1);
  for (const auto& [name, value] : metrics.items()) EXPECT_TRUE(value.is_number()) << name;
}

TEST_F(Methods, ShutdownIsAnsweredAndAskedForOnce) {
  EXPECT_EQ(call("system.shutdown", {{"key", "bye"}}), Json::object());
  EXPECT_EQ(call("system.shutdown", {{"key", "bye"}}), Json::object());
  EXPECT_EQ(shutdowns_, 1);
}

TEST_F(Methods, TheirParametersAreChecked) {
  EXPECT_EQ(refusal("preview.start", {{"camera", "nobody"}}), "not_found");
  EXPECT_EQ(refusal("preview.stop", {{"camera", "nobody"}}), "not_found");
  EXPECT_EQ(refusal("preview.stop"), "invalid_params");
  EXPECT_EQ(refusal("background.learn", {{"frames", 101}}), "invalid_params");
  EXPECT_EQ(refusal("camera.discover", {{"driver", "aravis"}}), "invalid_params");
  EXPECT_EQ(refusal("preview.start", {{"camera", "b0"}, {"fps", 31}}), "invalid_params");
  EXPECT_EQ(refusal("preview.start"), "invalid_params");
  EXPECT_EQ(refusal("background.learn", {{"frames", 0}}), "invalid_params");
}

TEST_F(Methods, CaptureChecksItsParameters) {
  for (const Json& params : {Json{{"face", "pretty"}}, Json{{"face", 1}}, Json{{"countdown_s", -1}},
                             Json{{"countdown_s", 61}}, Json{{"countdown_s", "3"}}, Json{{"countdown_s", true}},
                             Json{{"label", 5}}, Json{{"label", std::string(201, 'x')}}, Json{{"key", ""}},
                             Json{{"key", 7}}, Json{{"key", std::string(65, 'k')}}})
    EXPECT_EQ(refusal("capture.start", params), "invalid_params") << params;
  std::string label;
  for (int i = 0; i < 200; ++i) label += "ü";
  EXPECT_FALSE(capture({{"label", label}}).empty());
}

TEST_F(Methods, UnknownThingsAreNotFound) {
  EXPECT_EQ(refusal("capture.cancel", {{"capture", "none"}}), "not_found");
  EXPECT_EQ(refusal("job.list", {{"job", "none"}}), "not_found");
  EXPECT_EQ(refusal("job.retry", {{"job", "none"}}), "not_found");
  EXPECT_EQ(refusal("job.cancel", {{"job", "none"}}), "not_found");
  EXPECT_EQ(refusal("avatar.get", {{"avatar", "none"}}), "not_found");
  EXPECT_EQ(refusal("avatar.fetch", {{"avatar", "none"}, {"file", "avatar.dae"}}), "not_found");
  EXPECT_EQ(refusal("avatar.list", {{"before", "none"}}), "not_found");
}

TEST_F(Methods, DeletingNothingSucceeds) {
  for (const char* id : {"none", "", "../jobs", "/etc", ".."}) {
    EXPECT_EQ(call("capture.delete", {{"capture", id}}), Json::object());
    EXPECT_EQ(call("avatar.delete", {{"avatar", id}}), Json::object());
  }
  EXPECT_TRUE(fs::exists(options_.config.booth.jobs()));
}

TEST_F(Methods, AvatarsAreListedInPagesNewestFirst) {
  for (const char number : {'0', '1', '2', '3', '4'}) {
    std::string created = "2026-11-20T10:00:00Z";
    created[9] = static_cast<char>('5' - (number - '0'));
    put_avatar(std::string("a") + number, created, "x");
  }
  const auto ids = [](const Json& result) {
    std::vector<std::string> found;
    for (const Json& avatar : result["avatars"]) found.push_back(avatar["id"]);
    return found;
  };
  EXPECT_THAT(ids(call("avatar.list")), ElementsAre("a0", "a1", "a2", "a3", "a4"));
  EXPECT_THAT(ids(call("avatar.list", {{"limit", 2}})), ElementsAre("a0", "a1"));
  EXPECT_THAT(ids(call("avatar.list", {{"limit", 2}, {"before", "a1"}})), ElementsAre("a2", "a3"));
  EXPECT_THAT(ids(call("avatar.list", {{"before", "a4"}})), IsEmpty());
  const Json avatar = call("avatar.list", {{"limit", 1}})["avatars"][0];
  EXPECT_EQ(avatar["triangles"], 7);
  EXPECT_TRUE(avatar.at("label").is_null());
  EXPECT_TRUE(avatar.at("job").is_null());
  EXPECT_EQ(avatar["files"], Json({"avatar.dae", "metadata.json"}));
  for (const Json& limit : {Json(0), Json(501), Json(-1), Json("5"), Json(1.5)})
    EXPECT_EQ(refusal("avatar.list", {{"limit", limit}}), "invalid_params") << limit;
}

TEST_F(Methods, FilesComeInPieces) {
  std::string content;
  for (int i = 0; i < 10'000; ++i) content += std::to_string(i);
  put_avatar("a", "2026-11-22T10:00:00Z", content);
  const std::string digest = sha256_hex({reinterpret_cast<const uint8_t*>(content.data()), content.size()});
  const Json file{{"avatar", "a"}, {"file", "avatar.dae"}};
  const auto fetch = [&](const Json& range) {
    Json params = file;
    params.update(range);
    return client().call("avatar.fetch", params);
  };
  const Response whole = fetch(Json::object());
  EXPECT_EQ(whole.result()["size"], content.size());
  EXPECT_EQ(whole.result()["sha256"], digest);
  EXPECT_EQ(whole.bytes, content);
  const Response part = fetch({{"offset", 100}, {"length", 50}});
  EXPECT_EQ(part.bytes, content.substr(100, 50));
  EXPECT_EQ(part.result()["sha256"], digest);
  EXPECT_EQ(fetch({{"offset", content.size() - 3}}).bytes, content.substr(content.size() - 3));
  EXPECT_EQ(fetch({{"offset", content.size()}}).bytes, "");
  EXPECT_EQ(fetch({{"offset", content.size() + 1}}).kind(), "invalid_params");
  EXPECT_FALSE(fetch({{"offset", content.size() + 1}}).bytes);
  EXPECT_EQ(fetch({{"length", 8 * 1024 * 1024 + 1}}).kind(), "invalid_params");
  EXPECT_EQ(fetch({{"offset", -1}}).kind(), "invalid_params");
  EXPECT_EQ(client()
                .call("avatar.fetch", {{"avatar", "a"}, {"file", "metadata.json"}})
                .result()["sha256"]
                .get<std::string>()
                .size(),
            64);
  for (const char* name : {"../../lock", "nothing", "", ".", "/etc/passwd"})
    EXPECT_EQ(refusal("avatar.fetch", {{"avatar", "a"}, {"file", name}}), "not_found") << name;
  EXPECT_EQ(call("avatar.get", {{"avatar", "a"}})["triangles"], 7);
}

TEST_F(Methods, LargeFilesComeWholeInPiecesOf8MiB) {
  const std::string content(9UL * 1024 * 1024, 'x');
  put_avatar("a", "2026-11-22T10:00:00Z", content);
  const Response first = client().call("avatar.fetch", {{"avatar", "a"}, {"file", "avatar.dae"}});
  ASSERT_TRUE(first.bytes);
  EXPECT_EQ(first.bytes->size(), 8UL * 1024 * 1024);
  const Response second =
      client().call("avatar.fetch", {{"avatar", "a"}, {"file", "avatar.dae"}, {"offset", first.bytes->size()}});
  ASSERT_TRUE(second.bytes);
  EXPECT_EQ(*first.bytes + *second.bytes, content);
}

TEST_F(Methods, AKeyGivesTheFirstAnswerAgain) {
  const Json params{{"key", "k1"}, {"label", "Ann"}};
  const std::string id = capture(params);
  EXPECT_EQ(capture(params), id) << "while it runs";
  ASSERT_TRUE(wait_job(id, "done"));
  EXPECT_EQ(capture(params), id);
  EXPECT_EQ(refusal("capture.start", {{"key", "k1"}, {"label", "Bob"}}), "invalid_params");
  EXPECT_EQ(refusal("capture.delete", {{"key", "k1"}, {"capture", id}}), "invalid_params");
  RawClient other(options_.config.api.control);
  EXPECT_EQ(other.call("capture.start", params).result()["capture"], id) << "keys are the booth's";
  EXPECT_THAT(call("job.list")["jobs"], SizeIs(1));

  stop();
  start();
  EXPECT_EQ(capture(params), id) << "after a restart";
  EXPECT_THAT(call("job.list")["jobs"], SizeIs(1));
  EXPECT_EQ(refusal("capture.start", {{"key", "k1"}, {"label", "Bob"}}), "invalid_params");
}

TEST_F(Methods, AKeyGivesTheSameAnswerWhileTheFirstIsAwaited) {
  reconstruct_.behave("hang");
  const std::string id = capture();
  ASSERT_TRUE(wait_job(id, "running"));
  const auto cancel = [&](int number, const std::string& job) {
    return Json{{"jsonrpc", "2.0"}, {"id", number}, {"method", "job.cancel"}, {"params", {{"job", job}, {"key", "k"}}}}
        .dump();
  };
  for (int i = 0; i < 3; ++i) client().send({cancel(i, id)});
  client().send({cancel(3, "another")});
  std::map<int, std::string> kinds;
  for (int i = 0; i < 4; ++i) {
    const Response response = client().receive_response();
    kinds[response.message["id"]] = response.kind();
  }
  EXPECT_THAT(kinds, testing::ElementsAre(testing::Pair(0, ""), testing::Pair(1, ""), testing::Pair(2, ""),
                                          testing::Pair(3, "invalid_params")));
}

TEST_F(Methods, ErrorsAreNotRemembered) {
  EXPECT_EQ(refusal("capture.cancel", {{"capture", "none"}, {"key", "k"}}), "not_found");
  EXPECT_FALSE(capture({{"key", "k"}}).empty());
}

TEST_F(Methods, KeysKeepNothingOfThePerson) {
  const std::string id = capture({{"key", "k"}, {"label", "Rumpelstiltskin"}});
  ASSERT_TRUE(wait_job(id, "done"));
  call("avatar.delete", {{"avatar", id}});
  EXPECT_TRUE(wait_until([&] { return traces(id).empty(); }));
  for (const auto& entry : fs::recursive_directory_iterator(options_.config.booth.state_directory)) {
    if (!entry.is_regular_file()) continue;
    std::ifstream file(entry.path());
    const std::string text((std::istreambuf_iterator<char>(file)), {});
    EXPECT_EQ(text.find("Rumpelstiltskin"), std::string::npos) << entry.path();
  }
}

TEST_F(Methods, MethodsThatChangeNothingTakeNoKey) {
  for (const char* method : {"system.status", "job.list", "avatar.list"})
    EXPECT_EQ(refusal(method, {{"key", "k"}}), "invalid_params") << method;
}

}  // namespace
}  // namespace booth::test
