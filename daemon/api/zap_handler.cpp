#include "daemon/api/zap_handler.h"

#include <pthread.h>
#include <spdlog/spdlog.h>
#include <zmq.h>

#include <array>
#include <stop_token>
#include <utility>
#include <zmq.hpp>

#include "daemon/wakeup.h"

namespace booth::api {
namespace {

using SteadyClock = std::chrono::steady_clock;

constexpr const char* endpoint = "inproc://zeromq.zap.01";
constexpr std::chrono::milliseconds look_again{500};  ///< at the folder of keys
constexpr std::chrono::seconds log_pause{1};          ///< between two lines about clients that were refused
constexpr size_t least_frames = 6;                    ///< of a request, without credentials
constexpr size_t most_frames = 16;
constexpr size_t key_bytes = 32;
constexpr const char* version = "1.0";

/// Of what a stranger sent, for the log.
std::string printable(const std::string& text) {
  constexpr size_t longest = 64;
  std::string shown = text.substr(0, longest);
  for (char& c : shown)
    if (c < ' ' || c > '~') c = '?';
  return shown;
}

std::string z85(const std::string& bytes) {
  std::array<char, 41> text{};
  zmq_z85_encode(text.data(), reinterpret_cast<const uint8_t*>(bytes.data()), bytes.size());
  return text.data();
}

}  // namespace

ZapAnswer answer_zap(const std::vector<std::string>& frames, const ClientDirectory& clients) {
  const auto malformed = [](const char* text) { return ZapAnswer{"500", text, ""}; };
  const auto refused = [](const char* text) { return ZapAnswer{"400", text, ""}; };
  if (frames.size() < least_frames) return malformed("too few frames");
  if (frames[0] != version) return malformed("another version than 1.0");
  if (frames[2] != zap_domain) return refused("unknown domain");
  if (frames[5] != "CURVE") return refused("only CURVE is let in");
  if (frames.size() != least_frames + 1 || frames[6].size() != key_bytes)
    return malformed("expected one key of 32 bytes");
  const std::string key = z85(frames[6]);
  if (!clients.find(key)) return refused("unknown key");
  return {"200", "", key};
}

struct ZapHandler::Content {
  Content(zmq::context_t& context, ClientDirectory& the_clients, Metrics& the_metrics)
      : clients(the_clients), metrics(the_metrics), socket(context, zmq::socket_type::router) {
    socket.set(zmq::sockopt::linger, 0);
    socket.bind(endpoint);
  }

  void run(const std::stop_token& stop) {
    auto next_look = SteadyClock::now();
    while (!stop.stop_requested()) {
      pulse.beat();
      try {
        std::array<zmq::pollitem_t, 2> items{
            {{socket.handle(), 0, ZMQ_POLLIN, 0}, {nullptr, wakeup.fd(), ZMQ_POLLIN, 0}}};
        zmq::poll(items.data(), items.size(), look_again);
        if (SteadyClock::now() >= next_look) {
          clients.refresh();
          next_look = SteadyClock::now() + look_again;
        }
        while (take()) {
        }
      } catch (const std::exception& fault) {
        // Whatever one handshake brings, the next is answered.
        spdlog::warn("the clients' keys: {}", fault.what());
      }
    }
  }

  /// Answers one request. @return whether there was one
  bool take() {
    std::vector<zmq::message_t> route;
    std::vector<std::string> frames;
    bool delimited = false;
    for (bool more = true; more;) {
      zmq::message_t frame;
      if (!socket.recv(frame, zmq::recv_flags::dontwait)) return false;
      more = frame.more();
      if (delimited) {
        if (frames.size() < most_frames) frames.push_back(frame.to_string());
      } else {
        delimited = !route.empty() && frame.size() == 0;
        if (route.size() < most_frames) route.push_back(std::move(frame));
      }
    }
    if (!delimited) return true;  // not a request that could be answered
    const ZapAnswer answer = answer_zap(frames, clients);
    if (answer.status != "200") note(frames, answer);
    for (zmq::message_t& frame : route) socket.send(frame, zmq::send_flags::sndmore | zmq::send_flags::dontwait);
    const std::string request_id = frames.size() > 1 ? frames[1] : "";
    for (const std::string& frame : {std::string(version), request_id, answer.status, answer.text, answer.user_id})
      socket.send(zmq::buffer(frame), zmq::send_flags::sndmore | zmq::send_flags::dontwait);
    socket.send(zmq::message_t(), zmq::send_flags::dontwait);  // no metadata
    return true;
  }

  void note(const std::vector<std::string>& frames, const ZapAnswer& answer) {
    metrics.add("clients_refused");
    ++unnoted;
    const auto now = SteadyClock::now();
    if (now < next_note) return;
    spdlog::warn("a client at {} is not let in: {} ({} since the last such line)",
                 frames.size() > 3 ? printable(frames[3]) : "?", answer.text, unnoted);
    unnoted = 0;
    next_note = now + log_pause;
  }

  ClientDirectory& clients;
  Metrics& metrics;
  Pulse pulse;
  Wakeup wakeup;
  zmq::socket_t socket;
  uint64_t unnoted = 0;
  SteadyClock::time_point next_note{};
  std::jthread thread;
};

ZapHandler::ZapHandler(zmq::context_t& context, ClientDirectory& clients, Metrics& metrics)
    : content_(std::make_unique<Content>(context, clients, metrics)) {
  content_->thread = std::jthread([this](const std::stop_token& stop) { content_->run(stop); });
  pthread_setname_np(content_->thread.native_handle(), "zap");
}

ZapHandler::~ZapHandler() {
  content_->thread.request_stop();
  content_->wakeup.signal();
  content_->thread.join();
}

Pulse::TimePoint ZapHandler::last_pulse() const { return content_->pulse.last(); }

}  // namespace booth::api
