#include <gmock/gmock.h>

#include <limits>

#include "daemon/api/methods.h"
#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

using testing::Contains;
using testing::HasSubstr;
using testing::Not;
using testing::SizeIs;

class Protocol : public TestBooth {
 protected:
  void SetUp() override {
    TestBooth::SetUp();
    start();
  }
};

TEST_F(Protocol, AnswersWithTheIdOfTheRequest) {
  for (const std::string id : {"1", "\"a\"", "-7", "1.5", "null", "\"ü\""}) {
    const Response response = client().send_text(R"({"jsonrpc":"2.0","method":"system.describe","id":)" + id + "}");
    EXPECT_EQ(response.message["id"], Json::parse(id));
    EXPECT_EQ(response.message["jsonrpc"], "2.0");
    EXPECT_TRUE(response.message.contains("result"));
    EXPECT_FALSE(response.message.contains("error"));
  }
}

TEST_F(Protocol, RefusesWhatIsNoJson) {
  for (const std::string& text :
       {std::string(), std::string("{"), std::string("nonsense"), std::string("{\"a\":1}x"), std::string("\0\0", 2),
        std::string("{\"jsonrpc\":\"2.0\",\"id\":1,\"method\":\"\xff\xfe\"}"), std::string(60'000, '['),
        std::string(R"({"jsonrpc":"2.0","id":1e999,"method":"system.status"})")}) {
    const Response response = client().send_text(text);
    EXPECT_EQ(response.code(), -32700) << text.substr(0, 80);
    EXPECT_EQ(response.kind(), "parse_error");
    EXPECT_TRUE(response.message.at("id").is_null());
  }
  call("system.status");
}

TEST_F(Protocol, RefusesWhatIsNoRequest) {
  for (const std::string text :
       {"1", "null", "\"x\"", "{}", R"([])", R"([{"jsonrpc":"2.0","id":1,"method":"system.status"}])",
        R"({"id":1,"method":"system.status"})", R"({"jsonrpc":2.0,"id":1,"method":"system.status"})",
        R"({"jsonrpc":"1.0","id":1,"method":"system.status"})", R"({"jsonrpc":"2.0","id":1})",
        R"({"jsonrpc":"2.0","id":1,"method":5})", R"({"jsonrpc":"2.0","id":{},"method":"system.status"})",
        R"({"jsonrpc":"2.0","id":true,"method":"system.status"})"}) {
    const Response response = client().send_text(text);
    EXPECT_EQ(response.code(), -32600) << text;
    EXPECT_EQ(response.kind(), "invalid_request") << text;
  }
}

TEST_F(Protocol, NamesTheUnknown) {
  const Response response = client().call("system.explode");
  EXPECT_EQ(response.code(), -32601);
  EXPECT_EQ(response.kind(), "unknown_method");
  EXPECT_THAT(response.message["error"]["message"].get<std::string>(), HasSubstr("system.explode"));
}

TEST_F(Protocol, WantsAnObjectOfKnownParameters) {
  for (const Json& params : {Json::array(), Json(nullptr), Json(1), Json("x"), Json{{"unknown", 1}}}) {
    const Response response = client().call("system.status", params);
    EXPECT_EQ(response.code(), -32602) << params;
    EXPECT_EQ(response.kind(), "invalid_params") << params;
  }
  EXPECT_EQ(client().send_text(R"({"jsonrpc":"2.0","id":1,"method":"system.status"})").code(), 0) << "without params";
}

TEST_F(Protocol, EveryMethodRefusesAnUnknownParameter) {
  const Json methods = call("system.describe")["methods"];
  EXPECT_THAT(methods, SizeIs(api::methods.size()));
  for (const Json& method : methods) {
    EXPECT_EQ(refusal(method, {{"no_such_parameter", 1}}), "invalid_params") << method;
  }
  EXPECT_EQ(shutdowns_, 0);
}

TEST_F(Protocol, DoesNotAnswerNotifications) {
  client().send({R"({"jsonrpc":"2.0","method":"system.status"})"});
  client().send({R"({"jsonrpc":"2.0","method":"system.explode"})"});
  client().send({R"({"jsonrpc":"2.0","method":"system.status","params":[]})"});
  client().send({R"({"jsonrpc":"2.0","method":"system.shutdown"})"});
  EXPECT_EQ(client().call("system.describe").message["id"], 1) << "the first answer is to the first request";
  EXPECT_EQ(shutdowns_, 1) << "a notification is carried out";
}

TEST_F(Protocol, LimitsTheSizeOfARequest) {
  const std::string begin = R"({"jsonrpc":"2.0","id":1,"method":"system.status","params":{}})";
  EXPECT_EQ(client().send_text(begin + std::string(65536 - begin.size(), ' ')).code(), 0);
  const Response larger = client().send_text(begin + std::string(65537 - begin.size(), ' '));
  EXPECT_EQ(larger.code(), -32600);
  RawClient huge(options_.config.api.control);
  huge.socket().set(zmq::sockopt::rcvtimeo, 100);
  huge.send({std::string(32UL * 1024 * 1024, 'x')});
  EXPECT_THAT(huge.receive(), SizeIs(0));
  call("system.status");
}

TEST_F(Protocol, GivesFramesBeforeTheRequestBackUnchanged) {
  client().send({"", "route", R"({"jsonrpc":"2.0","id":9,"method":"system.describe"})"});
  const auto frames = client().receive();
  ASSERT_THAT(frames, SizeIs(3));
  EXPECT_EQ(frames[0], "");
  EXPECT_EQ(frames[1], "route");
  EXPECT_EQ(Json::parse(frames[2])["id"], 9);
}

TEST_F(Protocol, ServesReqClients) {
  RawClient req(options_.config.api.control, zmq::socket_type::req);
  for (int i = 0; i < 3; ++i) EXPECT_EQ(req.call("system.describe").result()["api"], 1);
}

TEST_F(Protocol, SurvivesMessagesOfManyFrames) {
  client().send(std::vector<std::string>(10'000, "x"));
  client().send({R"({"jsonrpc":"2.0","id":1,"method":"system.describe"})"});
  EXPECT_EQ(client().receive_response().message["id"], 1);
}

TEST_F(Protocol, AnIdentityIsTakenOver) {
  RawClient first(options_.config.api.control, zmq::socket_type::dealer, "kiosk");
  EXPECT_EQ(first.call("system.describe").code(), 0);
  RawClient second(options_.config.api.control, zmq::socket_type::dealer, "kiosk");
  EXPECT_EQ(second.call("system.describe").code(), 0);
  EXPECT_EQ(second.call("system.describe").code(), 0);
}

TEST_F(Protocol, AnswersManyRequestsInARow) {
  constexpr int count = 500;
  for (int i = 0; i < count; ++i)
    client().send({Json{{"jsonrpc", "2.0"}, {"id", i}, {"method", "system.status"}}.dump()});
  for (int i = 0; i < count; ++i) EXPECT_EQ(client().receive_response().message["id"], i);
}

TEST_F(Protocol, ASubscriberThatDoesNotReadHoldsUpNobody) {
  zmq::context_t context;
  zmq::socket_t slow(context, zmq::socket_type::sub);
  slow.set(zmq::sockopt::linger, 0);
  slow.set(zmq::sockopt::rcvhwm, 1);
  slow.set(zmq::sockopt::subscribe, "");
  slow.connect(options_.config.api.events);
  Listener listener(options_.config.api.events, booth_.get());
  for (int i = 0; i < 3000; ++i) {
    booth_->events().publish(Alert{Severity::info, "test", std::string(500, 'x')});
    if (i % 500 == 0) call("system.describe");
  }
  const uint64_t last = call("system.status")["sequence"];
  EXPECT_TRUE(listener.find([&](const SeenEvent& event) { return event.fields["sequence"] >= last; }));
}

TEST_F(Protocol, EventsCountWithoutGaps) {
  Listener listener(options_.config.api.events, booth_.get());
  const std::string id = capture();
  ASSERT_TRUE(listener.find("avatar.published"));
  ASSERT_TRUE(listener.find("heartbeat"));
  const Json status = call("system.status");
  uint64_t expected = listener.heard().front().fields["sequence"];
  for (const SeenEvent& event : listener.heard()) {
    EXPECT_EQ(event.fields["sequence"], expected++) << event.topic;
    EXPECT_EQ(event.fields["boot"], status["boot"]);
    EXPECT_THAT(event.fields["time"].get<std::string>(), testing::MatchesRegex("....-..-..T..:..:..\\....Z"));
  }
  EXPECT_GE(status["sequence"].get<uint64_t>() + 1, expected);
}

TEST_F(Protocol, TcpWithoutAKeyIsRefused) {
  ApiConfig config = options_.config.api;
  config.control = "tcp://127.0.0.1:5555";
  config.server_key = folder_.path() / "server.key";
  const auto server = api::Server::start(config, *booth_, [] {});
  ASSERT_FALSE(server);
  EXPECT_EQ(server.error().code, ErrorCode::invalid_argument);
}

}  // namespace
}  // namespace booth::test
