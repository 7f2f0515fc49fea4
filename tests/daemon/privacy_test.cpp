#include <sstream>

#include "tests/daemon/booth_programs.h"

namespace booth::test {
namespace {

class Privacy : public Process {
 protected:
  static std::string content(const fs::path& path) {
    std::ifstream file(path, std::ios::binary);
    return std::string((std::istreambuf_iterator<char>(file)), {});
  }
  static std::string line_with(const std::string& text, const std::string& word) {
    std::istringstream lines(text);
    for (std::string line; std::getline(lines, line);)
      if (line.find(word) != std::string::npos) return line;
    return "";
  }
  const std::string visitor = "Zo\xc3\xab Quisling";
};

/// Sessions that succeed, fail and are broken off, and clients that get everything wrong, with the log at its most
/// talkative: neither it, nor anything that is not a visitor's own, has a label or a picture in it.
TEST_F(Privacy, NothingOfAPersonIsOutsideTheFoldersOfHisCapture) {
  options_.config.log.level = LogLevel::debug;
  options_.config.replay.faults = {{.kind = ReplayFault::Kind::missing, .camera = "b0", .capture = 1},
                                   {.kind = ReplayFault::Kind::corrupt, .camera = "b1", .capture = 2},
                                   {.kind = ReplayFault::Kind::lost, .camera = "b2", .capture = 3}};
  std::ofstream(config_) << write_config(options_.config);
  start_boothd();
  std::vector<std::string> ids;
  const auto begin = [&](const char* behaviour) {
    reconstruct_.behave(behaviour);
    ASSERT_TRUE(wait_until([&] { return call("system.status")["ready"] == true; }));
    ids.push_back(capture({{"face", "none"}, {"label", visitor}, {"key", "press " + std::to_string(ids.size())}}));
    ASSERT_TRUE(wait_until([&] { return call("system.status")["capture"].is_null(); }));
  };
  for (const char* behaviour : {"good", "fail", "silent_fail", "crash", "nothing", "good_health"}) {
    begin(behaviour);
    ASSERT_TRUE(wait_until([&] {
      const std::string state = job(ids.back())["state"];
      return state == "done" || state == "failed" || state == "not_found";
    })) << job(ids.back());
  }
  begin("hang");
  EXPECT_EQ(client().call("job.cancel", {{"job", ids.back()}}).kind(), "");
  // Whatever a client does with a name, the answer may repeat it; the log may not.
  refusal("capture.start", {{"label", visitor + std::string(300, 'x')}});
  refusal("capture.start", {{"label", visitor}, {"face", visitor}});
  refusal("capture.start", {{visitor, 1}});
  refusal("capture.start", {{"label", visitor + "!"}, {"key", "press 0"}});
  refusal("system.status", {{"label", visitor}});
  refusal(visitor);
  for (const char* method : {"avatar.get", "avatar.delete"}) refusal(method, {{"avatar", visitor}});
  refusal("avatar.fetch", {{"avatar", ids[0]}, {"file", visitor}});
  for (const char* method : {"job.retry", "job.cancel"}) refusal(method, {{"job", visitor}});
  for (const char* method : {"capture.cancel", "capture.delete"}) refusal(method, {{"capture", visitor}});
  refusal("preview.start", {{"camera", visitor}});
  client().send_text("{\"label\": \"" + visitor + "\", not JSON");
  // One that ends with the program.
  capture({{"face", "none"}, {"label", visitor}, {"countdown_s", 30}});
  ::kill(boothd_, SIGKILL);
  wait_exit();
  start_boothd();
  ::kill(boothd_, SIGTERM);
  wait_exit();

  size_t searched = 0, of_visitors = 0;
  const IdentityConfig& booth = options_.config.booth;
  for (const auto& entry : fs::recursive_directory_iterator(folder_.path())) {
    if (!entry.is_regular_file()) continue;
    const fs::path& path = entry.path();
    bool his = false;
    for (const fs::path& folder : {booth.recordings(), booth.avatars(), booth.jobs()})
      his = his || path.string().starts_with(folder.string() + "/");
    const bool found = content(path).find("Quisling") != std::string::npos;
    of_visitors += his && found;
    if (his) continue;
    ++searched;
    EXPECT_FALSE(found) << path << "\n" << line_with(content(path), "Quisling");
  }
  EXPECT_GT(of_visitors, 0U) << "the search finds what is there";
  EXPECT_GT(searched, 5U);
  const std::string log = content(folder_.path() / "log");
  EXPECT_THAT(log, testing::HasSubstr(ids[3])) << "it does tell what happened";
  EXPECT_THAT(log, testing::HasSubstr("debug"));
  for (const char c : log)
    ASSERT_TRUE(c == '\n' || c == '\t' || static_cast<unsigned char>(c) >= 0x20) << "not a text: bytes of a picture?";
}

TEST_F(Privacy, TheReportHoldsNothingOfTheVisitors) {
  start_boothd();
  const std::string label = "Zoë Müller-Lüdenscheidt";
  const std::string id = capture({{"face", "none"}, {"label", label}});
  ASSERT_TRUE(wait_job(id, "done"));
  reconstruct_.behave("fail");
  const std::string failed = capture({{"face", "none"}, {"label", "Erwin Lindemann"}});
  ASSERT_TRUE(wait_job(failed, "failed"));
  // As if something had let a label slip into the log.
  std::ofstream(folder_.path() / "log", std::ios::app) << "a line about " << label << "\n";
  const fs::path report = folder_.path() / "report.tar.gz", unpacked = folder_.path() / "unpacked";
  const auto said = boothctl({"report", "--to", report, "--config", config_, "--log", folder_.path() / "log"});
  ASSERT_EQ(said.first, 0);
  fs::create_directories(unpacked);
  ASSERT_EQ(run({"/bin/tar", "-xzf", report, "-C", unpacked}).first, 0);
  EXPECT_THAT(entries(unpacked),
              testing::UnorderedElementsAre("boothd.toml", "describe.json", "doctor.json", "history.json", "log.txt",
                                            "metrics.json", "status.json", "versions.txt"));
  for (const std::string& name : entries(unpacked)) {
    std::ifstream file(unpacked / name);
    const std::string text((std::istreambuf_iterator<char>(file)), {});
    EXPECT_THAT(text, testing::Not(testing::IsEmpty())) << name;
    for (const std::string& private_text : {label, std::string("Lindemann"), id, failed})
      EXPECT_THAT(text, testing::Not(testing::HasSubstr(private_text))) << name;
  }
  std::ifstream log(unpacked / "log.txt");
  const std::string text((std::istreambuf_iterator<char>(log)), {});
  EXPECT_THAT(text, testing::HasSubstr("capture-1"));

  EXPECT_THAT(boothctl({"metrics", "--prometheus"}).second,
              testing::HasSubstr("# TYPE booth_request_seconds histogram"));
  EXPECT_THAT(boothctl({"history"}).second,
              testing::AllOf(testing::HasSubstr("started 1 times; captures "), testing::HasSubstr(" threads")));
  ASSERT_EQ(boothctl({"shutdown"}).first, 0);
  wait_exit();
  EXPECT_EQ(run({BOOTHCTL, "--control", options_.config.api.control, "--timeout", "0.2", "report", "--to", report,
                 "--config", config_, "--log", config_})
                .first,
            0)
      << "also without the booth";
}

/// What is deleted is gone from all that the booth stores; what it logs never had a name in it.
TEST_F(Privacy, NothingIsLeftOfWhoWasDeleted) {
  constexpr const char* label = "Zo\xc3\xab Quisling";
  const auto traces = [&](const std::vector<std::string>& words) {
    std::vector<std::string> command{"traces", "--config", config_};
    command.insert(command.end(), words.begin(), words.end());
    return boothctl(command);
  };
  start_boothd();
  std::vector<std::string> ids;
  for (const char* behaviour : {"good", "fail", "crash"}) {
    reconstruct_.behave(behaviour);
    ids.push_back(capture({{"face", "none"}, {"label", label}, {"key", std::string("press-") + behaviour}}));
    ASSERT_TRUE(wait_until([&] { return job(ids.back())["state"] == (ids.size() == 1 ? "done" : "failed"); }));
  }
  EXPECT_EQ(traces({ids[0]}).first, 1);
  EXPECT_THAT(traces({label}).second, testing::HasSubstr(ids[1]));
  EXPECT_EQ(call("avatar.delete", {{"avatar", ids[0]}}), Json::object());
  for (const std::string& id : ids) call("capture.delete", {{"capture", id}});
  ASSERT_TRUE(wait_until([&] { return entries(options_.config.booth.state_directory / "deleting").empty(); }));
  const auto [status, output] = traces({ids[0], ids[1], ids[2], label});
  EXPECT_EQ(status, 0) << output;
  EXPECT_EQ(traces({label, "--log", folder_.path() / "log"}).first, 0) << "a label is in the log";
  EXPECT_EQ(traces({ids[0], "--log", folder_.path() / "log"}).first, 1) << "the log is searched";
  EXPECT_EQ(traces({"press-good"}).first, 1) << "the clients' own words are kept for a day";
}

}  // namespace
}  // namespace booth::test
