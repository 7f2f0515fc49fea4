#pragma once

#include <gtest/gtest.h>
#include <spdlog/spdlog.h>
#include <sys/stat.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <functional>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <thread>
#include <vector>
#include <zmq.hpp>

#include "config/booth_config.h"
#include "daemon/api/server.h"
#include "daemon/booth.h"
#include "drivers/clock.h"
#include "replay/recording_writer.h"
#include "tests/replay/scratch_folder.h"

namespace booth::test {

using Json = nlohmann::json;
namespace fs = std::filesystem;

/// Long enough for a machine that is busy and a sanitizer that is slow; nothing passes by waiting for it.
constexpr std::chrono::seconds long_enough{240};

inline bool wait_until(const std::function<bool()>& holds, std::chrono::milliseconds patience = long_enough) {
  const auto deadline = std::chrono::steady_clock::now() + patience;
  while (!holds()) {
    if (std::chrono::steady_clock::now() > deadline) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
  return true;
}

/// A program in place of booth-reconstruct: does what the file "behaviour" beside it says, "good" at first.
class FakeReconstruct {
 public:
  explicit FakeReconstruct(const fs::path& folder) : folder_(folder) {
    behave("good");
    fs::copy_file(fs::path(BOOTH_SOURCE_DIR) / "tests/daemon/fake_reconstruct.sh", path());
    ::chmod(path().c_str(), 0755);
  }
  fs::path path() const { return folder_ / "reconstruct"; }
  void behave(const std::string& how) const { std::ofstream(folder_ / "behaviour") << how << "\n"; }
  size_t calls() const {
    std::ifstream file(folder_ / "calls");
    size_t count = 0;
    for (std::string line; std::getline(file, line);) ++count;
    return count;
  }
  /// What one that was started before its job was told so far, a line each.
  std::vector<std::string> news() const {
    std::ifstream file(folder_ / "news");
    std::vector<std::string> lines;
    for (std::string line; std::getline(file, line);) lines.push_back(line);
    return lines;
  }
  /// The process that was last started before its job, or 0.
  pid_t early() const {
    std::ifstream file(folder_ / "growing");
    pid_t process = 0;
    return file >> process ? process : 0;
  }
  /// The arguments with which it was last asked to learn a background, or none.
  std::string learned() const {
    std::ifstream file(folder_ / "learned");
    std::string last;
    for (std::string line; std::getline(file, line);) last = line;
    return last;
  }

 private:
  const fs::path folder_;
};

/// A recording of tiny pictures to be played: body cameras "b0" … "b3", face cameras "f0", "f1", and a projector.
inline fs::path write_tiny_recording(const fs::path& parent) {
  constexpr int width = 16, height = 8;
  constexpr GrayCodePattern pattern{.width = 4, .height = 2, .columns = true, .rows = true, .inverse = true};
  Rig rig;
  rig.volume = {Eigen::Vector3d(-1, 0, -1), Eigen::Vector3d(1, 2, 1)};
  const auto view = [&](const std::string& id) {
    CalibratedView made;
    made.id = id;
    made.intrinsics = {.width = width, .height = height, .fx = 20, .fy = 20, .cx = 8, .cy = 4};
    return made;
  };
  for (const char* id : {"b0", "b1", "b2", "b3", "f0", "f1"}) {
    RigCamera& camera = rig.cameras.emplace_back();
    static_cast<CalibratedView&>(camera) = view(id);
    camera.role = id[0] == 'f' ? CameraRole::face : CameraRole::body;
    camera.rms_px = 0.25;
  }
  rig.projector = view("beamer");
  auto writer =
      RecordingWriter::begin(parent, {.id = "tiny", .created = "2026-11-22T10:15:00Z", .label = {}, .face = {}}, rig);
  EXPECT_TRUE(writer) << writer.error().message;
  const auto frame = [&](const std::string& camera, int index) {
    return Frame{.camera = camera,
                 .index = index,
                 .timestamp_ns = seconds(5) + milliseconds(40) * index + (camera[1] - '0') * 70'000,
                 .frame_id = 0,
                 .exposure_us = 4000,
                 .pixels = std::make_shared<const Image>(width, height, 1, static_cast<uint8_t>(index))};
  };
  EXPECT_TRUE((*writer)->begin_shot({.name = "background", .role = ShotRole::background}));
  EXPECT_TRUE((*writer)->begin_shot({.name = "body", .role = ShotRole::body}));
  EXPECT_TRUE((*writer)->begin_shot({.name = "face", .role = ShotRole::gray_code, .pattern = pattern}));
  for (const RigCamera& camera : rig.cameras) {
    EXPECT_TRUE((*writer)->add("background", frame(camera.id, 0)));
    EXPECT_TRUE((*writer)->add("body", frame(camera.id, 0)));
    for (int i = 0; camera.role == CameraRole::face && i < pattern_count(pattern); ++i)
      EXPECT_TRUE((*writer)->add("face", frame(camera.id, i)));
  }
  EXPECT_TRUE((*writer)->commit());
  return parent / "tiny";
}

/// What came back for one request.
struct Response {
  Json message;                      ///< the JSON frame
  std::optional<std::string> bytes;  ///< the frame behind it
  int code() const { return message.contains("error") ? message["error"]["code"].get<int>() : 0; }
  std::string kind() const {
    return message.contains("error") ? message["error"]["data"]["kind"].get<std::string>() : "";
  }
  const Json& result() const { return message.at("result"); }
};

/// Speaks to the control socket frame by frame.
class RawClient {
 public:
  explicit RawClient(const std::string& endpoint, zmq::socket_type type = zmq::socket_type::dealer,
                     const std::string& identity = "")
      : socket_(context_, type) {
    socket_.set(zmq::sockopt::linger, 0);
    socket_.set(zmq::sockopt::rcvtimeo, static_cast<int>(std::chrono::milliseconds(long_enough).count()));
    if (!identity.empty()) socket_.set(zmq::sockopt::routing_id, identity);
    socket_.connect(endpoint);
  }
  void send(const std::vector<std::string>& frames) {
    for (size_t i = 0; i < frames.size(); ++i)
      socket_.send(zmq::buffer(frames[i]), i + 1 < frames.size() ? zmq::send_flags::sndmore : zmq::send_flags::none);
  }
  /// Empty: nothing came in time.
  std::vector<std::string> receive() {
    std::vector<std::string> frames;
    for (bool more = true; more;) {
      zmq::message_t frame;
      if (!socket_.recv(frame, zmq::recv_flags::none)) return {};
      frames.push_back(frame.to_string());
      more = frame.more();
    }
    return frames;
  }
  Response receive_response() {
    const auto frames = receive();
    if (frames.empty())
      return {Json{{"error", {{"code", 1}, {"message", "no answer"}, {"data", {{"kind", "no_answer"}}}}}}, {}};
    Response response{Json::parse(frames[0]), {}};
    if (frames.size() > 1) response.bytes = frames[1];
    return response;
  }
  Response send_text(const std::string& text) {
    send({text});
    return receive_response();
  }
  Response call(const std::string& method, const Json& params = Json::object()) {
    return send_text(Json{{"jsonrpc", "2.0"}, {"id", ++id_}, {"method", method}, {"params", params}}.dump());
  }
  zmq::socket_t& socket() { return socket_; }

 private:
  zmq::context_t context_;
  zmq::socket_t socket_;
  int id_ = 0;
};

struct SeenEvent {
  std::string topic;
  Json fields;
  std::string bytes = {};  ///< of a preview: its JPEG
};

/// Hears every event from its construction on.
class Listener {
 public:
  /// @param booth  of this process, which is made to say something at once; else its heartbeat is waited for
  explicit Listener(const std::string& endpoint, Booth* booth = nullptr) : socket_(context_, zmq::socket_type::sub) {
    socket_.set(zmq::sockopt::linger, 0);
    socket_.set(zmq::sockopt::subscribe, "");
    socket_.set(zmq::sockopt::rcvtimeo, 20);
    socket_.connect(endpoint);
    // The first event shows that the subscription has arrived.
    EXPECT_TRUE(wait_until([&] {
      if (booth != nullptr) booth->events().publish(Alert{Severity::info, "test", "is anybody there?"});
      return receive();
    }));
  }
  /// The next event, heard already or not, that is as wanted; those before it are skipped.
  std::optional<SeenEvent> find(const std::function<bool(const SeenEvent&)>& wanted) {
    const auto deadline = std::chrono::steady_clock::now() + long_enough;
    while (std::chrono::steady_clock::now() < deadline)
      if (receive() && wanted(heard_.back())) return heard_.back();
    return std::nullopt;
  }
  std::optional<SeenEvent> find(const std::string& topic) {
    return find([&](const SeenEvent& event) { return event.topic == topic; });
  }
  const std::vector<SeenEvent>& heard() const { return heard_; }
  std::vector<SeenEvent> heard(const std::string& topic) const {
    std::vector<SeenEvent> found;
    for (const SeenEvent& event : heard_)
      if (event.topic == topic) found.push_back(event);
    return found;
  }

 private:
  /// @return whether one came
  bool receive() {
    zmq::message_t topic, fields;
    if (!socket_.recv(topic, zmq::recv_flags::none)) return false;
    static_cast<void>(socket_.recv(fields, zmq::recv_flags::none));
    heard_.push_back({topic.to_string(), Json::parse(fields.to_string())});
    if (!fields.more()) return true;
    zmq::message_t picture;
    static_cast<void>(socket_.recv(picture, zmq::recv_flags::none));
    heard_.back().bytes = picture.to_string();
    return true;
  }

  zmq::context_t context_;
  zmq::socket_t socket_;
  std::vector<SeenEvent> heard_;
};

/// A booth and its interface in this process, on a scratch folder, playing a recording of tiny pictures.
class TestBooth : public testing::Test {
 protected:
  void SetUp() override {
    if (std::getenv("BOOTH_TEST_LOG") == nullptr) spdlog::set_level(spdlog::level::off);
    options_.config.booth.state_directory = folder_.path() / "state";
    options_.config.api.control = "ipc://" + (folder_.path() / "control").string();
    options_.config.api.events = "ipc://" + (folder_.path() / "events").string();
    options_.config.disk.reserve_mib = 0;
    options_.config.capture.frame_timeout_ms = 500;
    options_.config.replay.recording = write_tiny_recording(folder_.path());
    options_.config.replay.pace = ReplayOptions::Pace::fast;
    options_.reconstruct_command = reconstruct_.path();
  }

  /// What the booth works with: as configured, unless a test has its own.
  virtual Result<Devices> devices() { return open_devices(options_.config, clock_); }

  void start() {
    open();
    ASSERT_TRUE(wait_until([&] { return all_tried() && booth_->status().not_ready.empty(); }))
        << "the booth is not ready";
  }
  /// Whether each camera is online, or it is known why not.
  bool all_tried() {
    const auto cameras = booth_->status().cameras;
    return std::none_of(cameras.begin(), cameras.end(),
                        [](const CameraStatus& camera) { return camera.message == "not opened yet"; });
  }
  /// Without waiting until it is ready.
  void open() {
    auto opened = Booth::open(options_, devices(), clock());
    ASSERT_TRUE(opened) << opened.error().message;
    booth_ = std::move(*opened);
    auto server = api::Server::start(options_.config.api, *booth_, [this] { ++shutdowns_; });
    ASSERT_TRUE(server) << server.error().message;
    server_ = std::move(*server);
    client_ = std::make_unique<RawClient>(options_.config.api.control);
  }
  virtual const Clock& clock() { return clock_; }
  /// As SIGTERM does.
  void stop() {
    if (booth_) booth_->drain();
    server_.reset();
    booth_.reset();
  }
  void TearDown() override { stop(); }

  RawClient& client() { return *client_; }
  Json call(const std::string& method, const Json& params = Json::object()) {
    const Response response = client_->call(method, params);
    EXPECT_TRUE(response.message.contains("result")) << method << ": " << response.message;
    return response.message.value("result", Json());
  }
  std::string refusal(const std::string& method, const Json& params = Json::object()) {
    return client_->call(method, params).kind();
  }
  std::string capture(const Json& params = Json::object()) { return call("capture.start", params)["capture"]; }
  Json job(const std::string& id) {
    const Response response = client_->call("job.list", {{"job", id}});
    return response.kind().empty() ? response.result()["jobs"][0] : Json{{"state", response.kind()}};
  }
  bool wait_job(const std::string& id, const std::string& state) {
    return wait_until([&] { return job(id)["state"] == state; });
  }
  /// Files below the state folder whose path has that text.
  std::vector<std::string> traces(const std::string& text) {
    std::vector<std::string> found;
    for (const auto& entry : fs::recursive_directory_iterator(options_.config.booth.state_directory))
      if (entry.path().string().find(text) != std::string::npos) found.push_back(entry.path().string());
    return found;
  }
  std::vector<std::string> entries(const fs::path& folder) {
    std::vector<std::string> found;
    for (const auto& entry : fs::directory_iterator(folder)) found.push_back(entry.path().filename().string());
    return found;
  }

  const ScratchFolder folder_;
  const FakeReconstruct reconstruct_{folder_.path()};
  const MonotonicClock clock_;
  BoothOptions options_;
  std::atomic<int> shutdowns_ = 0;
  std::unique_ptr<Booth> booth_;
  std::unique_ptr<api::Server> server_;
  std::unique_ptr<RawClient> client_;
};

}  // namespace booth::test
