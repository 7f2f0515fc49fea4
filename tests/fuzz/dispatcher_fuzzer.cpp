#include <spdlog/spdlog.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <future>
#include <memory>
#include <nlohmann/json.hpp>
#include <string>
#include <string_view>

#include "daemon/api/dispatcher.h"
#include "daemon/api/json_rpc.h"
#include "daemon/api/requests.h"
#include "daemon/booth.h"
#include "drivers/clock.h"

namespace {

namespace fs = std::filesystem;
using booth::api::Answer;
using booth::api::Role;
using Json = nlohmann::json;

constexpr int most_requests = 8;  ///< of one input
constexpr std::chrono::seconds patience{20};

void require(bool holds) {
  if (!holds) std::abort();
}

/// A booth that has no device and one avatar, with its state in memory, so that nothing waits for a disk.
class DevicelessBooth {
 public:
  DevicelessBooth() {
    spdlog::set_level(spdlog::level::off);
    std::string name = "/dev/shm/booth-dispatcher-fuzzer-XXXXXX";
    require(::mkdtemp(name.data()) != nullptr);
    folder_ = name;
    booth::BoothOptions options;
    options.config.booth.state_directory = folder_;
    options.config.disk.reserve_mib = 0;
    options.reconstruct_command = options.calibrate_command = "/bin/false";
    const fs::path avatar = options.config.booth.avatars() / "2026";
    fs::create_directories(avatar);
    std::ofstream(avatar / "avatar.dae") << "dae\n\n";
    std::ofstream(avatar / "metadata.json")
        << R"({"id": "2026", "created": "2026-11-22T10:15:00Z",)"
        << R"( "recording": "2026", "label": "Ann", "triangles": 12,)"
        << R"( "warnings": [], "files": {"avatar.dae": {"size": 5, "sha256": "0"}}})";
    auto opened = booth::Booth::open(
        options, booth::Error{booth::ErrorCode::not_found, "there are no devices on purpose"}, clock_);
    require(opened.ok());
    booth_ = std::move(*opened);
    dispatcher_ = std::make_unique<booth::api::Dispatcher>(*booth_, [] {});
  }
  DevicelessBooth(const DevicelessBooth&) = delete;
  DevicelessBooth& operator=(const DevicelessBooth&) = delete;
  ~DevicelessBooth() {
    dispatcher_.reset();
    booth_.reset();
    fs::remove_all(folder_);
  }

  booth::api::Dispatcher& dispatcher() { return *dispatcher_; }
  void forget_events() { booth_->events().take(); }

 private:
  const booth::MonotonicClock clock_;
  fs::path folder_;
  std::unique_ptr<booth::Booth> booth_;
  std::unique_ptr<booth::api::Dispatcher> dispatcher_;
};

/// What a client gets is one line of JSON that it can tell from others by its id.
void check_text(const std::string& text, const Json& id) {
  require(text.find('\n') == std::string::npos);
  const Json answer = Json::parse(text, nullptr, false);
  require(answer.is_object() && answer.contains("id") && answer.contains("result") != answer.contains("error"));
  require(answer["id"].dump() == id.dump());
  if (answer.contains("error")) require(!answer["error"]["message"].get_ref<const std::string&>().empty());
}

/// The first byte is the client's role, the rest what it says.
void serve(DevicelessBooth& booth, std::string_view message) {
  if (message.empty()) return;
  const Role role = message[0] == 'v' ? Role::viewer : message[0] == 'k' ? Role::kiosk : Role::operate;
  booth::api::Request request;
  if (const auto refusal = booth::api::read_request(message.substr(1), role, request)) {
    check_text(booth::api::error_text(request.id, refusal->error, refusal->message), request.id);
    return;
  }
  require(booth::api::may(role, request.method->method));

  const auto answered = std::make_shared<std::promise<Answer>>();
  auto answer = answered->get_future();
  const auto early = booth.dispatcher().dispatch(request.method->method, request.params, [answered](Answer given) {
    answered->set_value(std::move(given));  // throws when it is the second one
  });
  require(answer.wait_for(patience) == std::future_status::ready);
  const Answer given = answer.get();
  if (early) check_text(booth::api::result_text(request.id, early->result), request.id);
  if (!given) {
    require(given.error().code != booth::ErrorCode::internal);
    return check_text(
        booth::api::error_text(request.id, booth::api::rpc_error(given.error().code), given.error().message),
        request.id);
  }
  check_text(booth::api::result_text(request.id, given->result), request.id);
  if (given->bytes) require(given->bytes->size() <= booth::api::most_fetch_bytes);
}

}  // namespace

/// Some requests, one a line, of clients of any role: each is answered, once, none finds a fault of
/// the booth itself, and nobody does what its role may not.
extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  static DevicelessBooth booth;
  std::string_view rest(reinterpret_cast<const char*>(data), size);
  for (int i = 0; i < most_requests && !rest.empty(); ++i) {
    const size_t end = std::min(rest.find('\n'), rest.size());
    serve(booth, rest.substr(0, end));
    rest.remove_prefix(std::min(end + 1, rest.size()));
  }
  booth.forget_events();
  return 0;
}
