#include "daemon/api/server.h"

#include <pthread.h>
#include <spdlog/spdlog.h>
#include <sys/stat.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <map>
#include <mutex>
#include <nlohmann/json.hpp>
#include <optional>
#include <stop_token>
#include <thread>
#include <utility>
#include <vector>
#include <zmq.hpp>

#include "daemon/api/dispatcher.h"
#include "daemon/api/errors.h"
#include "daemon/api/event_codec.h"
#include "daemon/api/json_values.h"
#include "daemon/api/key_store.h"
#include "daemon/api/methods.h"
#include "daemon/api/requests.h"
#include "daemon/wakeup.h"

namespace booth::api {
namespace {

using Json = nlohmann::json;
using SteadyClock = std::chrono::steady_clock;
using Envelope = std::vector<zmq::message_t>;

constexpr size_t most_request_bytes = 64 * 1024;
/// A frame larger than that is not even received: its connection is closed. In between there is an answer.
constexpr int64_t most_received_bytes = 1024 * 1024;
constexpr size_t most_envelope_frames = 16;
constexpr int most_queued_messages = 1000;  ///< per peer
/// File pieces that slow clients have not taken yet.
constexpr size_t most_bytes_in_flight = 128UL * 1024 * 1024;
constexpr size_t most_pending = 4096;  ///< requests that wait for the disk
constexpr int requests_in_a_row = 64;  ///< before the events have their turn
constexpr std::chrono::milliseconds longest_sleep{500};
/// A request is answered within 100 ms; some of that is spent on the way.
constexpr std::chrono::milliseconds early_answer{85};
constexpr std::chrono::milliseconds farewell{200};  ///< for the last answers and events at the end

constexpr const char* key_was_used = "key: it was used for another request before";

/// The answers that other threads give.
struct Completions {
  std::mutex mutex;
  std::vector<std::pair<uint64_t, Answer>> answers;  ///< guarded by mutex; by the request's number
  Wakeup wakeup;
};

/// A request that was carried out, or is being carried out elsewhere.
struct Pending {
  Envelope envelope;
  Json id;
  bool notification = false;
  const MethodEntry* method = nullptr;
  std::optional<std::string> key;
  Json params;  ///< of a request with a key
  SteadyClock::time_point received;
  std::optional<Reply> early;    ///< what is answered when it takes long
  std::vector<Pending> repeats;  ///< of the same request, which get the same answer
};

struct Refusal {
  RpcError error;
  std::string message;
};

std::string error_text(const Json& id, const RpcError& error, const std::string& message) {
  return to_text({{"jsonrpc", "2.0"},
                  {"id", id},
                  {"error", {{"code", error.code}, {"message", message}, {"data", {{"kind", error.kind}}}}}});
}

std::string result_text(const Json& id, const Json& result) {
  return to_text({{"jsonrpc", "2.0"}, {"id", id}, {"result", result}});
}

bool is_id(const Json& id) { return id.is_string() || id.is_number() || id.is_null(); }

/// The file a client connects to, for ipc endpoints.
std::optional<std::string> socket_file(const std::string& endpoint) {
  constexpr std::string_view scheme = "ipc://";
  if (!endpoint.starts_with(scheme) || endpoint.starts_with("ipc://@")) return std::nullopt;
  return endpoint.substr(scheme.size());
}

}  // namespace

struct Server::Content {
  Content(const ApiConfig& config, Booth& the_booth, std::shared_ptr<KeyStore> key_store,
          std::function<void()> shut_down)
      : booth(the_booth), dispatcher(the_booth, std::move(shut_down)), keys(std::move(key_store)) {
    control.set(zmq::sockopt::maxmsgsize, most_received_bytes);
    control.set(zmq::sockopt::router_handover, true);
    control.set(zmq::sockopt::router_mandatory, true);  // so that a lost reply is seen
    events.set(zmq::sockopt::maxmsgsize, static_cast<int64_t>(most_request_bytes));
    bind(control, config.control);
    bind(events, config.events);
  }

  static void bind(zmq::socket_t& socket, const std::string& endpoint) {
    socket.set(zmq::sockopt::sndhwm, most_queued_messages);
    socket.set(zmq::sockopt::rcvhwm, most_queued_messages);
    socket.set(zmq::sockopt::linger, static_cast<int>(farewell.count()));
    socket.bind(endpoint);
    // The folder's permissions guard the socket; its group may use it.
    constexpr mode_t owner_and_group = 0660;
    if (const auto file = socket_file(endpoint); file && ::chmod(file->c_str(), owner_and_group) != 0)
      spdlog::warn("{}: its permissions cannot be set", *file);
  }

  void run(const std::stop_token& stop);
  void serve(const std::stop_token& stop);
  void receive();
  void accept(Envelope envelope, std::string_view text);
  std::optional<Refusal> read(const Json& message, Pending& request);
  void carry_out(Pending request);
  void complete(uint64_t number, const Answer& answer);
  void answer_early();
  void take_completions();
  void answer(Pending& request, const Answer& answer);
  void send(Envelope& envelope, const std::string& text, std::optional<std::vector<uint8_t>> bytes);
  void publish();
  std::chrono::milliseconds time_to_sleep() const;

  Booth& booth;
  Dispatcher dispatcher;
  std::shared_ptr<KeyStore> keys;
  Pulse pulse;
  std::shared_ptr<Completions> completions = std::make_shared<Completions>();
  std::shared_ptr<std::atomic<size_t>> bytes_in_flight = std::make_shared<std::atomic<size_t>>(0);
  std::map<uint64_t, Pending> pending;  ///< by number
  uint64_t requests = 0;

  zmq::context_t context;
  zmq::socket_t control{context, zmq::socket_type::router};
  zmq::socket_t events{context, zmq::socket_type::xpub};
  std::jthread thread;
};

Result<std::unique_ptr<Server>> Server::start(const ApiConfig& config, Booth& booth, std::function<void()> shut_down) {
  for (const std::string& endpoint : {config.control, config.events})
    if (!endpoint.starts_with("ipc://") && !endpoint.starts_with("inproc://"))
      return Error{ErrorCode::invalid_argument, endpoint + ": only ipc:// endpoints are offered by this version"};
  auto keys = KeyStore::open(booth.state_directory() / "keys.jsonl", KeyStore::Clock::now());
  if (!keys) return keys.error();
  try {
    auto content = std::make_unique<Content>(config, booth, std::move(*keys), std::move(shut_down));
    return std::unique_ptr<Server>(new Server(std::move(content)));
  } catch (const zmq::error_t& fault) {
    return Error{ErrorCode::io, config.control + ", " + config.events + ": cannot be bound: " + fault.what()};
  }
}

Server::Server(std::unique_ptr<Content> content) : content_(std::move(content)) {
  content_->thread = std::jthread([this](const std::stop_token& stop) { content_->run(stop); });
  pthread_setname_np(content_->thread.native_handle(), "api");
}

Server::~Server() {
  content_->thread.request_stop();
  content_->completions->wakeup.signal();
  content_->thread.join();
}

Pulse::TimePoint Server::last_pulse() const { return content_->pulse.last(); }

void Server::Content::run(const std::stop_token& stop) {
  while (!stop.stop_requested()) {
    try {
      serve(stop);
    } catch (const std::exception& fault) {
      // One bad message must not end the service.
      spdlog::error("the interface's thread: {}", fault.what());
    }
  }
  try {
    take_completions();
    publish();
  } catch (const std::exception& fault) {
    spdlog::warn("the last answers: {}", fault.what());
  }
}

void Server::Content::serve(const std::stop_token& stop) {
  while (!stop.stop_requested()) {
    pulse.beat();
    std::array<zmq::pollitem_t, 4> items{{{control.handle(), 0, ZMQ_POLLIN, 0},
                                          {events.handle(), 0, ZMQ_POLLIN, 0},
                                          {nullptr, booth.events().wakeup().fd(), ZMQ_POLLIN, 0},
                                          {nullptr, completions->wakeup.fd(), ZMQ_POLLIN, 0}}};
    try {
      zmq::poll(items.data(), items.size(), time_to_sleep());
    } catch (const zmq::error_t& fault) {
      if (fault.num() != EINTR) throw;
    }
    take_completions();
    receive();
    answer_early();
    publish();
  }
}

std::chrono::milliseconds Server::Content::time_to_sleep() const {
  auto until = SteadyClock::now() + longest_sleep;
  for (const auto& [number, request] : pending)
    if (request.early) until = std::min(until, request.received + early_answer);
  return std::max(std::chrono::milliseconds(0),
                  std::chrono::ceil<std::chrono::milliseconds>(until - SteadyClock::now()));
}

void Server::Content::receive() {
  for (int i = 0; i < requests_in_a_row; ++i) {
    Envelope frames(1);
    if (!control.recv(frames.back(), zmq::recv_flags::dontwait)) break;
    bool too_many = false;
    while (frames.back().more()) {
      // The frames of a message come together; a client that sends ever more of them gets no answer.
      zmq::message_t frame;
      if (!control.recv(frame, zmq::recv_flags::dontwait)) break;
      too_many = too_many || frames.size() > most_envelope_frames;
      if (too_many)
        frames.back() = std::move(frame);
      else
        frames.push_back(std::move(frame));
    }
    if (too_many || frames.size() < 2) continue;  // the first frame is the client's identity
    const std::string text = frames.back().to_string();
    frames.pop_back();
    accept(std::move(frames), text);
  }
  // Subscriptions come in as messages that nobody needs.
  zmq::message_t subscription;
  while (events.recv(subscription, zmq::recv_flags::dontwait)) {
  }
}

void Server::Content::accept(Envelope envelope, std::string_view text) {
  booth.metrics().add("requests");
  Pending request;
  request.envelope = std::move(envelope);
  request.received = SteadyClock::now();
  std::optional<Refusal> refusal;
  if (text.size() > most_request_bytes) {
    refusal =
        Refusal{invalid_request, "the request has " + std::to_string(text.size()) + " bytes, expected at most 65536"};
  } else {
    const Json message = Json::parse(text, nullptr, false);
    refusal =
        message.is_discarded() ? Refusal{parse_error, "the request is not JSON in UTF-8"} : read(message, request);
  }
  if (!refusal) return carry_out(std::move(request));
  booth.metrics().add("requests_failed");
  if (!request.notification) send(request.envelope, error_text(request.id, refusal->error, refusal->message), {});
}

/// Checks what every request has. The notification flag and the id are set where they can be told.
std::optional<Refusal> Server::Content::read(const Json& message, Pending& request) {
  if (message.is_array()) return Refusal{invalid_request, "batches are not offered: send one request per message"};
  if (!message.is_object()) return Refusal{invalid_request, "a request is a JSON object"};
  const auto id = message.find("id");
  if (id != message.end()) {
    if (!is_id(*id)) return Refusal{invalid_request, "id: expected a text or a number"};
    request.id = *id;
  }
  const auto version = message.find("jsonrpc");
  if (version == message.end() || *version != "2.0") return Refusal{invalid_request, "jsonrpc: expected \"2.0\""};
  const auto method = message.find("method");
  if (method == message.end() || !method->is_string()) return Refusal{invalid_request, "method: expected a text"};

  request.notification = id == message.end();
  request.method = find_method(method->get_ref<const std::string&>());
  if (request.method == nullptr) return Refusal{unknown_method, "there is no method " + to_text(*method)};
  const RpcError invalid_params = rpc_error(ErrorCode::invalid_argument);
  const auto params = message.find("params");
  request.params = params == message.end() ? Json::object() : *params;
  if (!request.params.is_object()) return Refusal{invalid_params, "params: expected an object"};
  if (request.method->changes) {
    auto key = take_key(request.params);
    if (!key) return Refusal{invalid_params, key.error().message};
    request.key = std::move(*key);
  }
  return std::nullopt;
}

void Server::Content::carry_out(Pending request) {
  if (request.key) {
    const auto found =
        keys->find(*request.key, std::string(request.method->name), request.params, KeyStore::Clock::now());
    if (std::holds_alternative<KeyStore::OtherRequest>(found)) {
      request.key.reset();
      return answer(request, Error{ErrorCode::invalid_argument, key_was_used});
    }
    if (const auto* result = std::get_if<std::string>(&found)) {
      request.key.reset();  // it is remembered already, and not for longer
      return answer(request, Reply{Json::parse(*result)});
    }
    const auto first = std::find_if(pending.begin(), pending.end(),
                                    [&](const auto& entry) { return entry.second.key == request.key; });
    if (first != pending.end()) {
      request.key.reset();
      if (first->second.method != request.method || first->second.params != request.params)
        return answer(request, Error{ErrorCode::invalid_argument, key_was_used});
      first->second.repeats.push_back(std::move(request));
      return;
    }
  }
  if (pending.size() >= most_pending)
    return answer(request, Error{ErrorCode::busy, "too many requests are waiting; try again in a moment"});

  const uint64_t number = ++requests;
  const Method method = request.method->method;
  const Json params = request.params;
  Pending& waiting = pending.emplace(number, std::move(request)).first->second;
  const Responder respond = [number, to = completions](Answer answer) {
    {
      const std::lock_guard lock(to->mutex);
      to->answers.emplace_back(number, std::move(answer));
    }
    to->wakeup.signal();
  };
  try {
    waiting.early = dispatcher.dispatch(method, params, respond);
  } catch (const std::exception& fault) {
    respond(Error{ErrorCode::internal, "the booth's program has a fault: " + std::string(fault.what())});
  }
  take_completions();
}

void Server::Content::take_completions() {
  completions->wakeup.clear();
  std::vector<std::pair<uint64_t, Answer>> answers;
  {
    const std::lock_guard lock(completions->mutex);
    answers.swap(completions->answers);
  }
  for (const auto& [number, given] : answers) {
    const auto found = pending.find(number);
    if (found == pending.end()) continue;  // answered early
    Pending request = std::move(found->second);
    pending.erase(found);
    answer(request, given);
  }
}

void Server::Content::answer_early() {
  const auto now = SteadyClock::now();
  for (auto entry = pending.begin(); entry != pending.end();) {
    Pending& request = entry->second;
    if (request.early && now >= request.received + early_answer) {
      answer(request, *request.early);
      entry = pending.erase(entry);
    } else {
      ++entry;
    }
  }
}

void Server::Content::answer(Pending& request, const Answer& given) {
  for (Pending& repeat : request.repeats) answer(repeat, given);
  const std::string method(request.method->name);
  booth.metrics().observe("request_seconds",
                          std::chrono::duration<double>(SteadyClock::now() - request.received).count());
  if (!given) {
    booth.metrics().add("requests_failed");
    spdlog::debug("{}: {}", method, given.error().message);
    if (!request.notification)
      send(request.envelope, error_text(request.id, rpc_error(given.error().code), given.error().message), {});
    return;
  }
  if (request.key) {
    keys->remember(*request.key, method, request.params, to_text(given->result), KeyStore::Clock::now());
    booth.disk().post([store = keys] { store->sync(); });
  }
  if (!request.notification) send(request.envelope, result_text(request.id, given->result), given->bytes);
}

void Server::Content::send(Envelope& envelope, const std::string& text, std::optional<std::vector<uint8_t>> bytes) {
  std::optional<zmq::message_t> binary;
  if (bytes) {
    if (*bytes_in_flight + bytes->size() > most_bytes_in_flight) {
      // Not an error of the file: the client may ask again when others have taken theirs.
      return send(envelope,
                  error_text(Json::parse(text)["id"], rpc_error(ErrorCode::busy),
                             "too many bytes wait for slow clients; try again in a moment"),
                  {});
    }
    struct Hold {
      std::vector<uint8_t> bytes;
      std::shared_ptr<std::atomic<size_t>> in_flight;
    };
    auto hold = std::make_unique<Hold>(Hold{std::move(*bytes), bytes_in_flight});
    *bytes_in_flight += hold->bytes.size();
    void* const data = hold->bytes.data();
    const size_t size = hold->bytes.size();
    binary.emplace(
        data, size,
        [](void*, void* hint) {
          const std::unique_ptr<Hold> held(static_cast<Hold*>(hint));
          *held->in_flight -= held->bytes.size();
        },
        hold.release());
  }
  try {
    bool sent = true;
    for (zmq::message_t& frame : envelope)
      sent = sent && control.send(frame, zmq::send_flags::sndmore | zmq::send_flags::dontwait).has_value();
    const auto last = binary ? zmq::send_flags::sndmore | zmq::send_flags::dontwait : zmq::send_flags::dontwait;
    sent = sent && control.send(zmq::buffer(text), last).has_value();
    if (binary) sent = sent && control.send(*binary, zmq::send_flags::dontwait).has_value();
    if (!sent) booth.metrics().add("replies_lost");
  } catch (const zmq::error_t& fault) {
    // The client has gone.
    booth.metrics().add("replies_lost");
    spdlog::debug("a reply could not be sent: {}", fault.what());
  }
}

void Server::Content::publish() {
  booth.events().wakeup().clear();
  for (const NumberedEvent& event : booth.events().take()) {
    const EncodedEvent encoded = encode(event, booth.events().boot());
    // Never blocks: a subscriber that does not keep up loses events.
    events.send(zmq::buffer(encoded.topic), zmq::send_flags::sndmore | zmq::send_flags::dontwait);
    events.send(zmq::buffer(encoded.json), zmq::send_flags::dontwait);
  }
  for (const PreviewPicture& picture : booth.take_previews()) {
    const EncodedEvent encoded = encode(picture, booth.events().boot());
    events.send(zmq::buffer(encoded.topic), zmq::send_flags::sndmore | zmq::send_flags::dontwait);
    events.send(zmq::buffer(encoded.json), zmq::send_flags::sndmore | zmq::send_flags::dontwait);
    events.send(zmq::buffer(picture.jpeg), zmq::send_flags::dontwait);
  }
}

}  // namespace booth::api
