#include <gmock/gmock.h>

#include <random>

#include "daemon/api/client.h"
#include "daemon/api/rate_limiter.h"
#include "daemon/api/zap_handler.h"
#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

using api::AllowedClient;
using api::ClientCredentials;
using api::ClientDirectory;
using api::CurveKeyPair;
using api::Role;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::SizeIs;

CurveKeyPair new_keys() {
  auto keys = api::make_key_pair();
  EXPECT_TRUE(keys);
  return *keys;
}

std::string bytes_of_key(const std::string& z85) {
  std::array<uint8_t, 32> bytes{};
  zmq_z85_decode(bytes.data(), z85.c_str());
  return {bytes.begin(), bytes.end()};
}

mode_t mode_of(const fs::path& file) {
  struct stat status {};
  EXPECT_EQ(::stat(file.c_str(), &status), 0) << file;
  return status.st_mode & 07777U;
}

TEST(CurveKeys, ComeBackAsTheyWereAndForTheirOwnerAlone) {
  const ScratchFolder folder;
  const fs::path server = folder.path() / "server.key", client = folder.path() / "client.key";
  const CurveKeyPair keys = new_keys();
  ASSERT_TRUE(api::save_server_keys(server, keys));
  ASSERT_TRUE(api::save_client_credentials(client, {keys, keys.public_key}));
  EXPECT_EQ(mode_of(server), 0600U);
  EXPECT_EQ(mode_of(client), 0600U);
  EXPECT_EQ(api::read_server_keys(server)->secret_key, keys.secret_key);
  EXPECT_EQ(api::read_client_credentials(client)->server_key, keys.public_key);
}

TEST(CurveKeys, ThatOthersMayReadAreRefused) {
  const ScratchFolder folder;
  const fs::path file = folder.path() / "server.key";
  ASSERT_TRUE(api::save_server_keys(file, new_keys()));
  for (const mode_t mode : {0640U, 0604U, 0644U}) {
    ASSERT_EQ(::chmod(file.c_str(), mode), 0);
    const auto read = api::read_server_keys(file);
    ASSERT_FALSE(read);
    EXPECT_THAT(read.error().message, HasSubstr("others than its owner"));
  }
}

TEST(CurveKeys, ThatAreNoneAreNamed) {
  const ScratchFolder folder;
  const fs::path file = folder.path() / "server.key";
  EXPECT_EQ(api::read_server_keys(file).error().code, ErrorCode::not_found);
  const CurveKeyPair one = new_keys(), other = new_keys();
  for (const std::string& text :
       {std::string(), std::string("[]"), std::string("{}"), std::string(R"({"public_key":7,"secret_key":8})"),
        Json{{"public_key", one.public_key}, {"secret_key", other.secret_key}}.dump(),
        Json{{"public_key", one.public_key}, {"secret_key", std::string(40, '"')}}.dump()}) {
    std::ofstream(file) << text;
    ASSERT_EQ(::chmod(file.c_str(), 0600), 0);
    const auto read = api::read_server_keys(file);
    ASSERT_FALSE(read) << text;
    EXPECT_THAT(read.error().message, HasSubstr(file.string()));
  }
}

TEST(AllowedClients, AreAddedListedAndRevoked) {
  const ScratchFolder folder;
  const fs::path clients = folder.path() / "clients";
  EXPECT_THAT(api::read_allowed_clients(clients).clients, IsEmpty());
  const std::string key = new_keys().public_key;
  ASSERT_TRUE(api::allow_client(clients, {"stand-7", key, Role::kiosk, ""}));
  EXPECT_EQ(mode_of(clients / "stand-7.json"), 0644U);
  EXPECT_EQ(api::allow_client(clients, {"stand-7", new_keys().public_key, Role::viewer, ""}).error().code,
            ErrorCode::invalid_state);
  EXPECT_EQ(api::allow_client(clients, {"other", key, Role::viewer, ""}).error().code, ErrorCode::invalid_state);
  for (const char* name : {"", "../up", "a/b", ".hidden"})
    EXPECT_EQ(api::allow_client(clients, {name, new_keys().public_key, Role::viewer, ""}).error().code,
              ErrorCode::invalid_argument)
        << name;
  EXPECT_EQ(api::allow_client(clients, {"short", "abc", Role::viewer, ""}).error().code, ErrorCode::invalid_argument);
  const auto read = api::read_allowed_clients(clients);
  ASSERT_THAT(read.clients, SizeIs(1));
  EXPECT_EQ(read.clients[0].role, Role::kiosk);
  EXPECT_TRUE(api::revoke_client(clients, "stand-7"));
  EXPECT_EQ(api::revoke_client(clients, "stand-7").error().code, ErrorCode::not_found);
  EXPECT_EQ(api::revoke_client(clients, "../server").error().code, ErrorCode::not_found);
}

TEST(AllowedClients, AFileThatIsNoneKeepsNobodyElseOut) {
  const ScratchFolder folder;
  ASSERT_TRUE(api::allow_client(folder.path(), {"good", new_keys().public_key, Role::viewer, ""}));
  std::ofstream(folder.path() / "bad.json") << "{";
  std::ofstream(folder.path() / "god.json") << Json{{"public_key", new_keys().public_key}, {"role", "god"}};
  const auto read = api::read_allowed_clients(folder.path());
  EXPECT_THAT(read.clients, SizeIs(1));
  EXPECT_THAT(read.faults, SizeIs(2));
}

TEST(Roles, EachMayAllThatThoseBeforeItMay) {
  for (const api::MethodEntry& entry : api::methods) {
    EXPECT_TRUE(api::may(Role::operate, entry.method)) << entry.name;
    EXPECT_GE(api::may(Role::kiosk, entry.method), api::may(Role::viewer, entry.method)) << entry.name;
    if (entry.changes) {
      EXPECT_FALSE(api::may(Role::viewer, entry.method)) << entry.name;
    }
  }
  EXPECT_FALSE(api::may(Role::viewer, api::Method::avatar_fetch));
  EXPECT_TRUE(api::may(Role::kiosk, api::Method::avatar_delete));
  EXPECT_FALSE(api::may(Role::kiosk, api::Method::system_shutdown));
}

TEST(Roles, AreThoseOfTheSchemas) {
  std::ifstream file(fs::path(BOOTH_SOURCE_DIR) / "daemon/api/schema/booth-api-1.json");
  const Json schemas = Json::parse(file)["methods"];
  for (const api::MethodEntry& entry : api::methods) {
    const std::string name(entry.name);
    ASSERT_TRUE(schemas.contains(name)) << name;
    EXPECT_EQ(schemas[name]["role"], api::to_string(api::least_role(entry.method))) << name;
    EXPECT_EQ(schemas[name]["params"]["properties"].contains("key"), entry.changes) << name;
  }
}

TEST(Zap, LetsInKnownKeysOnly) {
  const ScratchFolder folder;
  const CurveKeyPair known = new_keys(), stranger = new_keys();
  ASSERT_TRUE(api::allow_client(folder.path(), {"known", known.public_key, Role::kiosk, ""}));
  const ClientDirectory clients(folder.path());
  const std::vector<std::string> good{"1.0", "1", "booth", "10.0.0.7", "", "CURVE", bytes_of_key(known.public_key)};
  EXPECT_EQ(api::answer_zap(good, clients).status, "200");
  EXPECT_EQ(api::answer_zap(good, clients).user_id, known.public_key);
  const auto with = [&](size_t index, const std::string& frame) {
    auto frames = good;
    frames[index] = frame;
    return api::answer_zap(frames, clients).status;
  };
  EXPECT_EQ(with(6, bytes_of_key(stranger.public_key)), "400");
  EXPECT_EQ(with(2, "elsewhere"), "400");
  EXPECT_EQ(with(5, "NULL"), "400");
  EXPECT_EQ(with(5, "PLAIN"), "400");
  EXPECT_EQ(with(0, "2.0"), "500");
  EXPECT_EQ(with(6, known.public_key), "500") << "in Z85, and not the bytes";
  EXPECT_EQ(with(6, ""), "500");
}

TEST(Zap, AnswersWhateverItIsAsked) {
  const ScratchFolder folder;
  const ClientDirectory clients(folder.path());
  std::mt19937 random(3);
  for (int i = 0; i < 2000; ++i) {
    std::vector<std::string> frames(random() % 12);
    for (std::string& frame : frames) {
      frame.resize(random() % 40);
      for (char& c : frame) c = static_cast<char>(random());
    }
    if (!frames.empty() && i % 2 == 0) frames[0] = "1.0";
    EXPECT_NE(api::answer_zap(frames, clients).status, "200");
  }
}

TEST(RateLimiter, GivesEachClientItsShare) {
  const auto begin = std::chrono::steady_clock::time_point();
  api::RateLimiter rates({.per_second = 10, .burst = 3, .most_clients = 2});
  for (int i = 0; i < 3; ++i) EXPECT_TRUE(rates.take("a", begin));
  EXPECT_FALSE(rates.take("a", begin));
  EXPECT_TRUE(rates.take("b", begin)) << "one's haste is not another's";
  EXPECT_TRUE(rates.take("a", begin + std::chrono::milliseconds(100)));
  EXPECT_FALSE(rates.take("a", begin + std::chrono::milliseconds(100)));
  for (int i = 0; i < 100; ++i) rates.take("stranger " + std::to_string(i), begin);
  EXPECT_EQ(rates.clients(), 2U) << "many clients cost no more";
}

/// A booth with local sockets and with remote ones.
class Remote : public TestBooth {
 protected:
  void SetUp() override {
    TestBooth::SetUp();
    ASSERT_TRUE(api::save_server_keys(folder_.path() / "server.key", server_keys_));
    ApiConfig& api = options_.config.api;
    api.server_key = folder_.path() / "server.key";
    api.client_keys = folder_.path() / "clients";
    // Free ports, which the kernel names for a moment.
    zmq::context_t context;
    zmq::socket_t first(context, zmq::socket_type::router), second(context, zmq::socket_type::router);
    first.bind("tcp://127.0.0.1:*");
    second.bind("tcp://127.0.0.1:*");
    api.remote_control = first.get(zmq::sockopt::last_endpoint);
    api.remote_events = second.get(zmq::sockopt::last_endpoint);
    first.close();
    second.close();
    context.close();
    viewer_ = let_in("viewer", Role::viewer);
    kiosk_ = let_in("kiosk", Role::kiosk);
    operator_ = let_in("operator", Role::operate);
    start();
  }
  ClientCredentials let_in(const std::string& name, Role role) {
    const CurveKeyPair keys = new_keys();
    EXPECT_TRUE(api::allow_client(folder_.path() / "clients", {name, keys.public_key, role, ""}));
    return {keys, server_keys_.public_key};
  }
  api::Client connect(const std::optional<ClientCredentials>& credentials,
                      std::chrono::milliseconds patience = long_enough) {
    return {options_.config.api.remote_control, options_.config.api.remote_events, patience, credentials};
  }
  static std::string kind_of(api::Client& client, const std::string& method, const Json& params = Json::object()) {
    const auto answer = client.call(method, params);
    const auto* error = std::get_if<api::CallError>(&answer);
    if (error == nullptr) return "";
    return error->unreachable ? "unreachable" : error->kind;
  }

  const CurveKeyPair server_keys_ = new_keys();
  ClientCredentials viewer_, kiosk_, operator_;
};

TEST_F(Remote, EachRoleMayWhatItMay) {
  auto viewer = connect(viewer_), kiosk = connect(kiosk_), boss = connect(operator_);
  for (const api::MethodEntry& entry : api::methods) {
    // A parameter that nobody knows: who may ask is told of it, and nothing is done.
    const Json params{{"no_such_parameter", 1}};
    const std::string name(entry.name);
    EXPECT_EQ(kind_of(viewer, name, params), api::may(Role::viewer, entry.method) ? "invalid_params" : "forbidden")
        << name;
    EXPECT_EQ(kind_of(kiosk, name, params), api::may(Role::kiosk, entry.method) ? "invalid_params" : "forbidden")
        << name;
    EXPECT_EQ(kind_of(boss, name, params), "invalid_params") << name;
  }
  const auto answer = viewer.call("capture.start", Json::object());
  ASSERT_TRUE(std::holds_alternative<api::CallError>(answer));
  EXPECT_EQ(std::get<api::CallError>(answer).code, -32009);
  EXPECT_EQ(call("system.status")["state"], "idle") << "and the local socket asks for no key";
}

TEST_F(Remote, AKioskTakesACaptureAndHearsOfIt) {
  auto kiosk = connect(kiosk_);
  kiosk.subscribe();
  ASSERT_TRUE(wait_until([&] { return kiosk.next_event(std::chrono::milliseconds(500)).has_value(); }));
  const auto answer = kiosk.call("capture.start", {{"face", "none"}});
  ASSERT_TRUE(std::holds_alternative<api::CallReply>(answer));
  EXPECT_TRUE(wait_until([&] {
    const auto event = kiosk.next_event(std::chrono::milliseconds(500));
    return event && event->topic == "avatar.published";
  }));
}

TEST_F(Remote, StrangersGetNothing) {
  constexpr std::chrono::milliseconds patience{400};
  auto plain = connect(std::nullopt, patience);
  EXPECT_EQ(kind_of(plain, "system.status"), "unreachable");
  plain.subscribe();
  EXPECT_FALSE(plain.next_event(patience));
  auto stranger = connect(ClientCredentials{new_keys(), server_keys_.public_key}, patience);
  EXPECT_EQ(kind_of(stranger, "system.status"), "unreachable");
  stranger.subscribe();
  EXPECT_FALSE(stranger.next_event(patience));
  auto deceived = connect(ClientCredentials{operator_.keys, new_keys().public_key}, patience);
  EXPECT_EQ(kind_of(deceived, "system.status"), "unreachable") << "another server's key";
  EXPECT_GE(call("system.metrics").value("clients_refused", 0.0), 1.0);
  auto friendly = connect(viewer_);
  EXPECT_EQ(kind_of(friendly, "system.status"), "");
}

TEST_F(Remote, WhoIsRevokedIsOutAtOnceAndOthersStay) {
  auto revoked = connect(kiosk_, std::chrono::milliseconds(1000)), other = connect(viewer_);
  revoked.subscribe();
  other.subscribe();
  ASSERT_EQ(kind_of(revoked, "system.status"), "");
  ASSERT_TRUE(wait_until([&] { return revoked.next_event(std::chrono::milliseconds(500)).has_value(); }));
  ASSERT_TRUE(wait_until([&] { return other.next_event(std::chrono::milliseconds(500)).has_value(); }));
  ASSERT_TRUE(api::revoke_client(options_.config.api.client_keys, "kiosk"));
  ASSERT_TRUE(wait_until([&] { return kind_of(revoked, "system.status") != ""; }));
  ASSERT_TRUE(wait_until([&] { return !revoked.next_event(std::chrono::milliseconds(2500)); }))
      << "a heartbeat comes each second";
  EXPECT_EQ(kind_of(other, "system.status"), "");
  const uint64_t now = call("system.status")["sequence"];
  EXPECT_TRUE(wait_until([&] {
    const auto event = other.next_event(std::chrono::milliseconds(500));
    return event && event->fields["sequence"] > now;
  })) << "its connection was closed too, and came back";
}

TEST_F(Remote, AKeyThatIsAddedLaterIsLetIn) {
  auto client = connect(let_in("late", Role::viewer), std::chrono::milliseconds(1000));
  EXPECT_TRUE(wait_until([&] { return kind_of(client, "system.status").empty(); }));
}

TEST_F(Remote, AnswersWhileStrangersKnock) {
  // Bytes that are no handshake, connections that never say anything, and real handshakes with unknown keys.
  zmq::context_t context;
  std::vector<zmq::socket_t> knocking;
  const CurveKeyPair unknown = new_keys();
  for (int i = 0; i < 60; ++i) {
    zmq::socket_t& raw = knocking.emplace_back(context, zmq::socket_type::stream);
    raw.set(zmq::sockopt::linger, 0);
    raw.connect(options_.config.api.remote_control);
    zmq::message_t identity;
    static_cast<void>(raw.recv(identity, zmq::recv_flags::none));
    zmq::message_t nothing;
    static_cast<void>(raw.recv(nothing, zmq::recv_flags::none));
    std::string junk(i % 3 == 0 ? 0 : 2000, static_cast<char>(i % 3 == 1 ? 0xff : i));
    if (junk.empty()) continue;
    raw.send(identity, zmq::send_flags::sndmore);
    raw.send(zmq::buffer(junk), zmq::send_flags::none);
  }
  for (int i = 0; i < 20; ++i) {
    zmq::socket_t& stranger = knocking.emplace_back(context, zmq::socket_type::dealer);
    stranger.set(zmq::sockopt::linger, 0);
    stranger.set(zmq::sockopt::reconnect_ivl, 10);
    stranger.set(zmq::sockopt::curve_serverkey, server_keys_.public_key);
    stranger.set(zmq::sockopt::curve_publickey, unknown.public_key);
    stranger.set(zmq::sockopt::curve_secretkey, unknown.secret_key);
    stranger.connect(options_.config.api.remote_control);
  }
  auto viewer = connect(viewer_);
  for (int i = 0; i < 20; ++i) EXPECT_EQ(kind_of(viewer, "system.status"), "");
  ASSERT_TRUE(wait_until([&] { return call("system.metrics").value("clients_refused", 0.0) >= 20; }));
  EXPECT_EQ(kind_of(viewer, "system.status"), "");
}

TEST_F(Remote, WhoAsksTooOftenIsToldSo) {
#ifdef __SANITIZE_THREAD__
  GTEST_SKIP() << "under this sanitizer nobody is answered as often as is allowed";
#endif
  constexpr int flood = 12'000;
  RawClient hasty(options_.config.api.control);
  hasty.socket().set(zmq::sockopt::sndhwm, 0);
  int refused = 0;
  for (int i = 0; i < flood; ++i)
    hasty.send({Json{{"jsonrpc", "2.0"}, {"id", i}, {"method", "system.describe"}}.dump()});
  for (int i = 0; i < flood && refused == 0; ++i)
    if (hasty.receive_response().kind() == "busy") ++refused;
  EXPECT_EQ(refused, 1);
  call("system.status");  // another client is not held up by it
}

TEST_F(Remote, WithoutAKeyItDoesNotStart) {
  stop();
  for (const fs::path& file : {folder_.path() / "nothing.key", folder_.path()}) {
    options_.config.api.server_key = file;
    auto opened = Booth::open(options_, devices(), clock());
    ASSERT_TRUE(opened);
    const auto server = api::Server::start(options_.config.api, **opened, [] {});
    ASSERT_FALSE(server);
    EXPECT_EQ(server.error().code, ErrorCode::invalid_argument);
    EXPECT_THAT(server.error().message, HasSubstr("boothctl keys server"));
  }
}

TEST_F(Remote, AnAddressThatIsTakenIsNamed) {
  ApiConfig other = options_.config.api;
  other.control = "ipc://" + (folder_.path() / "other").string();
  other.events = "ipc://" + (folder_.path() / "others").string();
  const auto server = api::Server::start(other, *booth_, [] {});
  ASSERT_FALSE(server);
  EXPECT_THAT(server.error().message, HasSubstr(other.remote_control));
}

}  // namespace
}  // namespace booth::test
