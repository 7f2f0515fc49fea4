#include <gmock/gmock.h>

#include <set>

#include "daemon/api/methods.h"
#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

const fs::path corpus = fs::path(BOOTH_SOURCE_DIR) / "tests/fuzz/corpus/request";

std::vector<std::string> examples() {
  std::vector<std::string> texts;
  for (const auto& entry : fs::directory_iterator(corpus)) {
    std::ifstream file(entry.path(), std::ios::binary);
    texts.emplace_back(std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>());
  }
  return texts;
}

/// The examples of the request fuzzer, whole and damaged, through all of the interface of a booth that works.
class Requests : public TestBooth {
 protected:
  void SetUp() override {
    TestBooth::SetUp();
    start();
  }
  /// What is answered to a text: at most one frame of JSON, as the next answer shows.
  std::vector<Json> answers(const std::string& text) {
    const std::string last = "last-" + std::to_string(++asked_);
    client().send({text});
    client().send({Json{{"jsonrpc", "2.0"}, {"id", last}, {"method", "job.list"}}.dump()});
    std::vector<Json> came;
    for (;;) {
      const auto frames = client().receive();
      if (frames.empty()) return {};
      came.push_back(Json::parse(frames[0], nullptr, false));
      if (came.back().is_object() && came.back().value("id", Json()) == last) break;
    }
    return came;
  }
  /// @return its refusal's kind; empty for a result, or for what wants no answer
  std::string check(const std::string& text) {
    for (const Json& answer : answers(text)) {
      EXPECT_EQ(answer.value("jsonrpc", ""), "2.0") << text;
      EXPECT_NE(answer.contains("result"), answer.contains("error")) << answer;
      if (!answer.contains("error")) continue;
      const Json& error = answer["error"];
      EXPECT_FALSE(error["message"].get<std::string>().empty()) << text;
      EXPECT_NE(error["data"]["kind"], "internal") << text << "\n" << error;
      return error["data"]["kind"];
    }
    return "";
  }

 private:
  int asked_ = 0;
};

TEST_F(Requests, EveryMethodHasAnExampleThatIsUnderstood) {
  std::set<std::string> understood;
  for (const std::string& text : examples()) {
    const Json request = Json::parse(text, nullptr, false);
    if (!request.is_object() || !request.contains("method")) continue;
    if (check(text) != "invalid_params") understood.insert(request["method"]);
  }
  for (const auto& method : api::methods) EXPECT_TRUE(understood.contains(std::string(method.name))) << method.name;
}

TEST_F(Requests, DamagedOnesAreAnsweredToo) {
  constexpr size_t places = 12;
  size_t asked = 0;
  for (const std::string& text : examples())
    for (size_t place = 0; place < places; ++place) {
      const size_t at = text.size() * place / places;
      if (at >= text.size()) continue;
      check(text.substr(0, at));
      std::string damaged = text;
      damaged[at] = static_cast<char>(~damaged[at]);
      check(damaged);
      damaged = text;
      damaged.insert(at, 1, "0\"{]}\x01e,"[place % 8]);
      check(damaged);
      asked += 3;
    }
  EXPECT_GT(asked, 500U);
  EXPECT_EQ(call("system.describe")["api"], 1);
}

}  // namespace
}  // namespace booth::test
