#include "daemon/api/server.h"

#include <pthread.h>
#include <spdlog/spdlog.h>
#include <sys/stat.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <list>
#include <map>
#include <mutex>
#include <nlohmann/json.hpp>
#include <optional>
#include <stop_token>
#include <thread>
#include <utility>
#include <vector>
#include <zmq.hpp>

#include "daemon/api/curve_keys.h"
#include "daemon/api/dispatcher.h"
#include "daemon/api/errors.h"
#include "daemon/api/event_codec.h"
#include "daemon/api/json_rpc.h"
#include "daemon/api/json_values.h"
#include "daemon/api/key_store.h"
#include "daemon/api/methods.h"
#include "daemon/api/rate_limiter.h"
#include "daemon/api/requests.h"
#include "daemon/api/roles.h"
#include "daemon/api/zap_handler.h"
#include "daemon/wakeup.h"

namespace booth::api {
namespace {

using Json = nlohmann::json;
using SteadyClock = std::chrono::steady_clock;
using Envelope = std::vector<zmq::message_t>;

/// A frame larger than that is not even received: its connection is closed. In between there is an answer.
constexpr int64_t most_received_bytes = 128 * 1024;
constexpr size_t most_envelope_frames = 16;
constexpr int most_queued_messages = 1000;  ///< to a peer
constexpr int most_queued_requests = 64;    ///< of a peer: what it sends beyond stays with it
/// Pictures that slow clients have not taken yet; further ones are skipped meanwhile.
constexpr size_t most_preview_bytes = 64UL * 1024 * 1024;
/// File pieces that slow clients have not taken yet.
constexpr size_t most_bytes_in_flight = 128UL * 1024 * 1024;
constexpr size_t most_pending = 4096;  ///< requests that wait for the disk
constexpr int requests_in_a_row = 64;  ///< before the events have their turn
constexpr std::chrono::milliseconds longest_sleep{500};
/// A request is answered within 100 ms; some of that is spent on the way.
constexpr std::chrono::milliseconds early_answer{85};
constexpr std::chrono::milliseconds farewell{200};  ///< for the last answers and events at the end
// Of remote clients: a stranger who does not come to the point, and a client that is gone without a word, are let go.
constexpr std::chrono::milliseconds longest_handshake{3000};
constexpr std::chrono::milliseconds ping_pause{5000};
constexpr std::chrono::milliseconds longest_silence{15'000};
constexpr std::chrono::milliseconds bind_again{50};  ///< until an endpoint that was closed is free again
constexpr RateLimiter::Options request_rates{.per_second = 1000, .burst = 5000};

constexpr const char* key_was_used = "key: it was used for another request before";

/// The answers that other threads give.
struct Completions {
  std::mutex mutex;
  std::vector<std::pair<uint64_t, Answer>> answers;  ///< guarded by mutex; by the request's number
  Wakeup wakeup;
};

/// A request that was carried out, or is being carried out elsewhere.
struct Pending : Request {
  zmq::socket_t* socket = nullptr;  ///< that it came from
  Envelope envelope;
  SteadyClock::time_point received;
  std::optional<Reply> early;    ///< what is answered when it takes long
  std::vector<Pending> repeats;  ///< of the same request, which get the same answer
};

/// The file a client connects to, for ipc endpoints.
std::optional<std::string> socket_file(const std::string& endpoint) {
  constexpr std::string_view scheme = "ipc://";
  if (!endpoint.starts_with(scheme) || endpoint.starts_with("ipc://@")) return std::nullopt;
  return endpoint.substr(scheme.size());
}

bool is_remote(const std::string& endpoint) { return endpoint.starts_with("tcp://"); }

/// The endpoints that the configuration names, for requests and for events.
std::vector<std::string> endpoints_of(const std::string& first, const std::string& remote) {
  std::vector<std::string> endpoints{first};
  if (!remote.empty()) endpoints.push_back(remote);
  return endpoints;
}

/// A message that counts its bytes until the last client has taken it.
zmq::message_t counted_message(std::vector<uint8_t> bytes, std::shared_ptr<std::atomic<size_t>> in_flight) {
  struct Hold {
    std::vector<uint8_t> bytes;
    std::shared_ptr<std::atomic<size_t>> in_flight;
  };
  auto hold = std::make_unique<Hold>(Hold{std::move(bytes), std::move(in_flight)});
  *hold->in_flight += hold->bytes.size();
  void* const data = hold->bytes.data();
  const size_t size = hold->bytes.size();
  return {data, size,
          [](void*, void* hint) {
            const std::unique_ptr<Hold> held(static_cast<Hold*>(hint));
            *held->in_flight -= held->bytes.size();
          },
          hold.release()};
}

}  // namespace

struct Server::Content {
  /// Where requests come in.
  struct Receiver {
    bool remote;
    zmq::socket_t socket;
  };
  /// Where events go out.
  struct Publisher {
    std::string endpoint;
    zmq::socket_t socket;
    bool bound = false;
  };

  Content(const ApiConfig& config, Booth& the_booth, std::shared_ptr<KeyStore> key_store,
          std::optional<CurveKeyPair> key_pair, std::function<void()> shut_down)
      : booth(the_booth),
        dispatcher(the_booth, std::move(shut_down)),
        keys(std::move(key_store)),
        server_keys(std::move(key_pair)) {
    if (server_keys) {
      clients.emplace(config.client_keys);
      closed_revocations = clients->revocations();
      zap.emplace(context, *clients, booth.metrics());  // before anything is bound
    }
    for (const std::string& endpoint : endpoints_of(config.control, config.remote_control)) {
      zmq::socket_t& socket =
          receivers.emplace_back(Receiver{is_remote(endpoint), {context, zmq::socket_type::router}}).socket;
      socket.set(zmq::sockopt::maxmsgsize, most_received_bytes);
      socket.set(zmq::sockopt::router_handover, true);
      socket.set(zmq::sockopt::router_mandatory, true);  // so that a lost reply is seen
      bind(socket, endpoint);
    }
    for (const std::string& endpoint : endpoints_of(config.events, config.remote_events)) {
      publishers.push_back({endpoint, {}, false});
      open(publishers.back());
    }
  }

  void open(Publisher& publisher) {
    publisher.socket = zmq::socket_t(context, zmq::socket_type::xpub);
    publisher.socket.set(zmq::sockopt::maxmsgsize, static_cast<int64_t>(most_request_bytes));
    bind(publisher.socket, publisher.endpoint);
    publisher.bound = true;
  }

  void bind(zmq::socket_t& socket, const std::string& endpoint) {
    socket.set(zmq::sockopt::sndhwm, most_queued_messages);
    socket.set(zmq::sockopt::rcvhwm, most_queued_requests);
    socket.set(zmq::sockopt::linger, static_cast<int>(farewell.count()));
    if (is_remote(endpoint)) {
      socket.set(zmq::sockopt::curve_server, true);
      socket.set(zmq::sockopt::curve_secretkey, server_keys->secret_key);
      socket.set(zmq::sockopt::zap_domain, zap_domain);
      socket.set(zmq::sockopt::handshake_ivl, static_cast<int>(longest_handshake.count()));
      socket.set(zmq::sockopt::heartbeat_ivl, static_cast<int>(ping_pause.count()));
      socket.set(zmq::sockopt::heartbeat_timeout, static_cast<int>(longest_silence.count()));
      socket.set(zmq::sockopt::ipv6, true);
    }
    socket.bind(endpoint);
    // The folder's permissions guard the socket; its group may use it.
    constexpr mode_t owner_and_group = 0660;
    if (const auto file = socket_file(endpoint); file && ::chmod(file->c_str(), owner_and_group) != 0)
      spdlog::warn("{}: its permissions cannot be set", *file);
  }

  void run(const std::stop_token& stop);
  void serve(const std::stop_token& stop);
  void receive(Receiver& receiver);
  void close_revoked();
  std::optional<Role> role_of(zmq::message_t& message, std::string& client) const;
  void accept(zmq::socket_t& control, Envelope envelope, std::string_view text, Role role);
  void carry_out(Pending request);
  void complete(uint64_t number, const Answer& answer);
  void answer_early();
  void take_completions();
  void answer(Pending& request, const Answer& answer);
  void send(zmq::socket_t& control, Envelope& envelope, const std::string& text,
            std::optional<std::vector<uint8_t>> bytes);
  void publish();
  std::chrono::milliseconds time_to_sleep() const;

  Booth& booth;
  Dispatcher dispatcher;
  std::shared_ptr<KeyStore> keys;
  Pulse pulse;
  std::shared_ptr<Completions> completions = std::make_shared<Completions>();
  std::shared_ptr<std::atomic<size_t>> bytes_in_flight = std::make_shared<std::atomic<size_t>>(0);
  std::map<uint64_t, Pending> pending;  ///< by number
  std::shared_ptr<std::atomic<size_t>> preview_bytes = std::make_shared<std::atomic<size_t>>(0);
  uint64_t requests = 0;
  RateLimiter rates{request_rates};

  const std::optional<CurveKeyPair> server_keys;  ///< where there is a tcp:// endpoint
  std::optional<ClientDirectory> clients;         ///< likewise
  uint64_t closed_revocations = 0;                ///< up to there nobody listens whose key was revoked
  zmq::context_t context;
  std::optional<ZapHandler> zap;
  std::list<Receiver> receivers;
  std::list<Publisher> publishers;
  std::jthread thread;
};

Result<std::unique_ptr<Server>> Server::start(const ApiConfig& config, Booth& booth, std::function<void()> shut_down) {
  std::optional<CurveKeyPair> server_keys;
  for (const std::string& endpoint : {config.control, config.events, config.remote_control, config.remote_events}) {
    if (!is_remote(endpoint) || server_keys) continue;
    auto read = read_server_keys(config.server_key);
    if (!read)
      return Error{ErrorCode::invalid_argument,
                   read.error().message + "; " + endpoint + " needs a key: make one with boothctl keys server"};
    server_keys = std::move(*read);
  }
  auto keys = KeyStore::open(booth.state_directory() / "keys.jsonl", KeyStore::Clock::now());
  if (!keys) return keys.error();
  try {
    auto content =
        std::make_unique<Content>(config, booth, std::move(*keys), std::move(server_keys), std::move(shut_down));
    return std::unique_ptr<Server>(new Server(std::move(content)));
  } catch (const zmq::error_t& fault) {
    std::string endpoints = config.control + ", " + config.events;
    for (const std::string& endpoint : {config.remote_control, config.remote_events})
      if (!endpoint.empty()) endpoints += ", " + endpoint;
    return Error{ErrorCode::io, endpoints + ": cannot be bound: " + fault.what()};
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

Pulse::TimePoint Server::last_pulse() const {
  const auto last = content_->pulse.last();
  return content_->zap ? std::min(last, content_->zap->last_pulse()) : last;
}

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
    std::vector<zmq::pollitem_t> items{{nullptr, booth.events().wakeup().fd(), ZMQ_POLLIN, 0},
                                       {nullptr, completions->wakeup.fd(), ZMQ_POLLIN, 0}};
    for (Receiver& receiver : receivers) items.push_back({receiver.socket.handle(), 0, ZMQ_POLLIN, 0});
    for (Publisher& publisher : publishers) items.push_back({publisher.socket.handle(), 0, ZMQ_POLLIN, 0});
    try {
      zmq::poll(items.data(), items.size(), time_to_sleep());
    } catch (const zmq::error_t& fault) {
      if (fault.num() != EINTR) throw;
    }
    take_completions();
    for (Receiver& receiver : receivers) receive(receiver);
    close_revoked();
    answer_early();
    publish();
  }
}

std::chrono::milliseconds Server::Content::time_to_sleep() const {
  auto until = SteadyClock::now() + longest_sleep;
  for (const auto& [number, request] : pending)
    if (request.early) until = std::min(until, request.received + early_answer);
  for (const Publisher& publisher : publishers)
    if (!publisher.bound) until = std::min(until, SteadyClock::now() + bind_again);
  return std::max(std::chrono::milliseconds(0),
                  std::chrono::ceil<std::chrono::milliseconds>(until - SteadyClock::now()));
}

/// Who is no longer let in hears nothing more either: the connections of its events are closed, those of others too,
/// which come back by themselves. Requests are checked one by one.
void Server::Content::close_revoked() {
  const bool revoked = clients && clients->revocations() != closed_revocations;
  if (revoked) closed_revocations = clients->revocations();
  for (Publisher& publisher : publishers) {
    if (revoked && is_remote(publisher.endpoint)) {
      publisher.socket.set(zmq::sockopt::linger, 0);
      publisher.bound = false;
    }
    if (publisher.bound) continue;
    publisher.socket.close();
    try {
      open(publisher);
    } catch (const zmq::error_t& fault) {
      if (fault.num() != EADDRINUSE) throw;  // it is free in a moment
    }
  }
}

/// @param client  becomes what its requests are counted by
/// @return nothing: the key with which it connected is no longer let in
std::optional<Role> Server::Content::role_of(zmq::message_t& message, std::string& client) const {
  const char* const key = zmq_msg_gets(message.handle(), "User-Id");
  if (key == nullptr || !clients) return std::nullopt;
  client = key;
  const auto found = clients->find(client);
  if (!found) return std::nullopt;
  return found->role;
}

void Server::Content::receive(Receiver& receiver) {
  zmq::socket_t& control = receiver.socket;
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
    std::string client = frames.front().to_string();
    // Who came over the local socket has passed its folder's permissions.
    const auto role = receiver.remote ? role_of(frames.back(), client) : Role::operate;
    const std::string text = frames.back().to_string();
    frames.pop_back();
    if (!role) {
      booth.metrics().add("requests_failed");
      send(control, frames, error_text(nullptr, forbidden, "this key is no longer let in: ask the booth's operator"),
           {});
    } else if (!rates.take(client, SteadyClock::now())) {
      // Refused without a look at it, so that it costs next to nothing.
      booth.metrics().add("requests_over_rate");
      send(control, frames,
           error_text(nullptr, rpc_error(ErrorCode::busy), "too many requests in a short time; wait a moment"), {});
    } else {
      accept(control, std::move(frames), text, *role);
    }
  }
  // Subscriptions come in as messages that nobody needs.
  zmq::message_t subscription;
  for (Publisher& publisher : publishers)
    for (int i = 0; i < requests_in_a_row && publisher.socket.recv(subscription, zmq::recv_flags::dontwait); ++i) {
    }
}

void Server::Content::accept(zmq::socket_t& control, Envelope envelope, std::string_view text, Role role) {
  booth.metrics().add("requests");
  Pending request;
  request.socket = &control;
  request.envelope = std::move(envelope);
  request.received = SteadyClock::now();
  const auto refusal = read_request(text, role, request);
  if (!refusal) return carry_out(std::move(request));
  booth.metrics().add("requests_failed");
  if (!request.notification)
    send(control, request.envelope, error_text(request.id, refusal->error, refusal->message), {});
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
    // A refusal may repeat what the client wrote, which may be somebody's name.
    const ErrorCode code = given.error().code;
    const bool of_client = code == ErrorCode::invalid_argument || code == ErrorCode::not_found;
    spdlog::debug("{}: {}", method, of_client ? std::string(rpc_error(code).kind) : given.error().message);
    if (!request.notification)
      send(*request.socket, request.envelope,
           error_text(request.id, rpc_error(given.error().code), given.error().message), {});
    return;
  }
  if (request.key) {
    keys->remember(*request.key, method, request.params, to_text(given->result), KeyStore::Clock::now());
    booth.disk().post([store = keys] { store->sync(); });
  }
  if (!request.notification)
    send(*request.socket, request.envelope, result_text(request.id, given->result), given->bytes);
}

void Server::Content::send(zmq::socket_t& control, Envelope& envelope, const std::string& text,
                           std::optional<std::vector<uint8_t>> bytes) {
  std::optional<zmq::message_t> binary;
  if (bytes) {
    if (*bytes_in_flight + bytes->size() > most_bytes_in_flight) {
      // Not an error of the file: the client may ask again when others have taken theirs.
      return send(control, envelope,
                  error_text(Json::parse(text)["id"], rpc_error(ErrorCode::busy),
                             "too many bytes wait for slow clients; try again in a moment"),
                  {});
    }
    binary = counted_message(std::move(*bytes), bytes_in_flight);
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
  // Never blocks: a subscriber that does not keep up loses events.
  const auto send = [this](std::array<zmq::message_t, 3> frames, size_t count) {
    for (Publisher& publisher : publishers) {
      if (!publisher.bound) continue;
      for (size_t i = 0; i < count; ++i) {
        zmq::message_t frame;
        frame.copy(frames[i]);
        publisher.socket.send(
            frame, (i + 1 < count ? zmq::send_flags::sndmore : zmq::send_flags::none) | zmq::send_flags::dontwait);
      }
    }
  };
  for (const NumberedEvent& event : booth.events().take()) {
    const EncodedEvent encoded = encode(event, booth.events().boot());
    send({zmq::message_t(encoded.topic), zmq::message_t(encoded.json)}, 2);
  }
  for (PreviewPicture& picture : booth.take_previews()) {
    if (*preview_bytes + picture.jpeg.size() > most_preview_bytes) continue;
    const EncodedEvent encoded = encode(picture, booth.events().boot());
    send({zmq::message_t(encoded.topic), zmq::message_t(encoded.json),
          counted_message(std::move(picture.jpeg), preview_bytes)},
         3);
  }
}

}  // namespace booth::api
