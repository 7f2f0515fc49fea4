#include "daemon/api/client.h"

#include <algorithm>
#include <array>
#include <stdexcept>
#include <zmq.hpp>

namespace booth::api {

using Json = nlohmann::json;
using SteadyClock = std::chrono::steady_clock;

struct Client::Sockets {
  zmq::context_t context;
  zmq::socket_t control{context, zmq::socket_type::dealer};
  zmq::socket_t events{context, zmq::socket_type::sub};
};

namespace {

bool wait_readable(zmq::socket_t& socket, SteadyClock::time_point deadline) {
  const auto left = std::chrono::ceil<std::chrono::milliseconds>(deadline - SteadyClock::now());
  std::array<zmq::pollitem_t, 1> items{{{socket.handle(), 0, ZMQ_POLLIN, 0}}};
  return zmq::poll(items.data(), items.size(), std::max(left, std::chrono::milliseconds(0))) > 0;
}

void encrypt(zmq::socket_t& socket, const ClientCredentials& credentials) {
  socket.set(zmq::sockopt::curve_serverkey, credentials.server_key);
  socket.set(zmq::sockopt::curve_publickey, credentials.keys.public_key);
  socket.set(zmq::sockopt::curve_secretkey, credentials.keys.secret_key);
}

std::vector<zmq::message_t> receive(zmq::socket_t& socket) {
  std::vector<zmq::message_t> frames;
  do {
    zmq::message_t frame;
    static_cast<void>(socket.recv(frame, zmq::recv_flags::none));
    frames.push_back(std::move(frame));
  } while (frames.back().more());
  return frames;
}

}  // namespace

Client::Client(const std::string& control, const std::string& events, std::chrono::milliseconds patience,
               const std::optional<ClientCredentials>& credentials)
    : sockets_(std::make_unique<Sockets>()), events_endpoint_(events), patience_(patience) {
  sockets_->control.set(zmq::sockopt::linger, 0);
  sockets_->events.set(zmq::sockopt::linger, 0);
  try {
    if (credentials) encrypt(sockets_->control, *credentials);
    if (credentials) encrypt(sockets_->events, *credentials);
    sockets_->control.connect(control);
  } catch (const zmq::error_t& fault) {
    throw std::runtime_error(control + ": " + fault.what());
  }
}

Client::~Client() = default;

std::variant<CallReply, CallError> Client::call(const std::string& method, const Json& params) {
  const uint64_t id = ++calls_;
  const std::string request = Json{{"jsonrpc", "2.0"}, {"id", id}, {"method", method}, {"params", params}}.dump(
      -1, ' ', false, Json::error_handler_t::replace);
  sockets_->control.send(zmq::buffer(request), zmq::send_flags::none);
  const auto deadline = SteadyClock::now() + patience_;
  while (wait_readable(sockets_->control, deadline)) {
    const auto frames = receive(sockets_->control);
    const Json reply = Json::parse(frames.front().to_string_view(), nullptr, false);
    // An answer to an earlier call that came too late is not for this one.
    if (!reply.is_object() || reply.value("id", Json()) != id) continue;
    if (const auto error = reply.find("error"); error != reply.end())
      return CallError{false, error->value("code", 0), error->value("/data/kind"_json_pointer, std::string()),
                       error->value("message", std::string())};
    CallReply answer{reply.value("result", Json::object()), {}};
    if (frames.size() > 1) {
      const auto* bytes = frames[1].data<uint8_t>();
      answer.bytes.assign(bytes, bytes + frames[1].size());
    }
    return answer;
  }
  return CallError{true, 0, "", "the booth does not answer; is boothd running, and is this its endpoint?"};
}

void Client::subscribe() {
  sockets_->events.set(zmq::sockopt::subscribe, "");
  try {
    sockets_->events.connect(events_endpoint_);
  } catch (const zmq::error_t& fault) {
    throw std::runtime_error(events_endpoint_ + ": " + fault.what());
  }
}

std::optional<ReceivedEvent> Client::next_event(std::chrono::milliseconds patience) {
  if (!wait_readable(sockets_->events, SteadyClock::now() + patience)) return std::nullopt;
  const auto frames = receive(sockets_->events);
  if (frames.size() < 2) return std::nullopt;
  ReceivedEvent event{frames[0].to_string(), Json::parse(frames[1].to_string_view(), nullptr, false)};
  if (frames.size() > 2) {
    const auto* bytes = frames[2].data<uint8_t>();
    event.bytes.assign(bytes, bytes + frames[2].size());
  }
  return event;
}

}  // namespace booth::api
