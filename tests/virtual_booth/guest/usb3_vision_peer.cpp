#include "tests/virtual_booth/guest/usb3_vision_peer.h"

#include <arpa/inet.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <bit>
#include <cerrno>
#include <chrono>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <functional>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <utility>

namespace booth {
namespace {

namespace fs = std::filesystem;
using Clock = std::chrono::steady_clock;
using Bytes = std::vector<uint8_t>;

constexpr const char* controller = "/sys/devices/platform/vhci_hcd.0";
constexpr std::chrono::milliseconds free_running_period{100};

// USB/IP commands.
constexpr uint32_t cmd_submit = 1, cmd_unlink = 2, ret_submit = 3, ret_unlink = 4;
constexpr size_t message_size = 48;

constexpr uint32_t control_endpoint = 1, stream_endpoint = 2;

// GenCP commands, and the magic words of control, leader and trailer.
constexpr uint16_t read_memory = 0x0800, write_memory = 0x0802;
constexpr uint32_t control_magic = 0x43563355, leader_magic = 0x4C563355, trailer_magic = 0x54563355;
constexpr size_t command_header = 12;
constexpr uint16_t invalid_address = 0x8003;

// Bootstrap registers: technology agnostic, technology specific (SBRM), of the stream (SIRM), and the manifest.
constexpr uint32_t manufacturer_name = 0x04, model_name = 0x44, serial_number = 0x144, response_time = 0x1cc,
                   manifest_address = 0x1d0, sbrm_address = 0x1d8;
constexpr uint32_t sbrm = 0x1000, most_command = sbrm + 0x14, most_answer = sbrm + 0x18, sirm_address = sbrm + 0x20;
constexpr uint32_t sirm = 0x2000, payload_size = sirm + 0x08, leader_size = sirm + 0x10, trailer_size = sirm + 0x14,
                   block_size = sirm + 0x1c;
constexpr uint32_t manifest = 0x3000, description = 0x10000, memory_size = 0x20000;
constexpr uint32_t most_transfer = 16384, response_ms = 2000;
constexpr uint32_t leader_bytes = 52, trailer_bytes = 28;

// Features' registers, as camera.xml has them.
constexpr uint32_t sensor_width = 0x8000, sensor_height = 0x8004, width = 0x8008, height = 0x800c,
                   pixel_format = 0x8018, acquisition = 0x8020, trigger_selector = 0x802c, trigger_mode = 0x8030,
                   trigger_source = 0x8038, trigger_software = 0x8044, exposure_time = 0x8050, exposure_limit = 0x8054,
                   frame_rate = 0x8028, balance_ratio = 0x8068, gamma_value = 0x8070, latch = 0x944, latched = 0x948;
constexpr uint32_t mono8 = 0x01080001, line1 = 1;

template <class Value>
void append(Bytes& bytes, Value value) {
  for (size_t i = 0; i < sizeof value; ++i)
    bytes.push_back(static_cast<uint8_t>(static_cast<uint64_t>(value) >> (8 * i)));
}
uint64_t little(const uint8_t* bytes, size_t size) {
  uint64_t value = 0;
  for (size_t i = size; i-- > 0;) value = value << 8 | bytes[i];
  return value;
}
int64_t now_ns() { return Clock::now().time_since_epoch().count(); }

bool read_all(int fd, void* data, size_t size) {
  auto* at = static_cast<uint8_t*>(data);
  while (size > 0) {
    const ssize_t got = ::read(fd, at, size);
    if (got <= 0) return false;
    at += got;
    size -= static_cast<size_t>(got);
  }
  return true;
}
void write_all(int fd, const Bytes& data) {
  for (size_t at = 0; at < data.size();) {
    const ssize_t put = ::send(fd, data.data() + at, data.size() - at, MSG_NOSIGNAL);
    if (put <= 0) return;  // the next read ends the thread
    at += static_cast<size_t>(put);
  }
}

bool is_plugged_in(const std::string& serial) {
  std::error_code error;
  for (fs::directory_iterator entry("/sys/bus/usb/devices", error), end; !error && entry != end;
       entry.increment(error)) {
    std::string text;
    std::ifstream(entry->path() / "serial") >> text;
    if (text == serial) return true;
  }
  return false;
}

bool eventually(const std::function<bool()>& holds) {
  const auto deadline = Clock::now() + std::chrono::seconds(120);
  while (!holds()) {
    if (Clock::now() > deadline) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
  return true;
}

/// The GigE camera's description, whose names are elsewhere here.
std::string genicam_description() {
  std::stringstream text;
  text << std::ifstream(BOOTH_SOURCE_DIR "/tests/virtual_booth/gige/camera.xml").rdbuf();
  std::string xml = text.str();
  const std::pair<const char*, const char*> moved[] = {
      {"<Address>0x48</Address><Length>32", "<Address>0x4</Address><Length>64"},
      {"<Address>0x68</Address><Length>32", "<Address>0x44</Address><Length>64"},
      {"<Address>0xd8</Address><Length>16", "<Address>0x144</Address><Length>64"}};
  for (const auto& [from, to] : moved) {
    const size_t at = xml.find(from);
    if (at == std::string::npos) throw std::runtime_error("camera.xml has other addresses");
    xml.replace(at, std::strlen(from), to);
  }
  return xml;
}

}  // namespace

Usb3VisionPeer::Usb3VisionPeer(std::string serial, std::vector<std::shared_ptr<const Image>> pictures)
    : serial_(std::move(serial)), pictures_(std::move(pictures)) {}

Usb3VisionPeer::~Usb3VisionPeer() { unplug(); }

uint32_t Usb3VisionPeer::word(uint32_t address) const {
  uint32_t value = 0;
  std::memcpy(&value, memory_.data() + address, sizeof value);
  return ntohl(value);
}

void Usb3VisionPeer::set_word(uint32_t address, uint32_t value) {
  value = htonl(value);
  std::memcpy(memory_.data() + address, &value, sizeof value);
}

double Usb3VisionPeer::float_register(uint32_t address) const {
  const std::lock_guard lock(mutex_);
  return std::bit_cast<float>(word(address));
}

/// As it is when it is switched on.
void Usb3VisionPeer::reset() {
  memory_.assign(memory_size, 0);
  const auto put_text = [&](uint32_t address, const std::string& text) {
    std::copy(text.begin(), text.end(), memory_.begin() + address);
  };
  const auto put_little = [&](uint32_t address, uint64_t value, size_t size) {
    for (size_t i = 0; i < size; ++i) memory_[address + i] = static_cast<uint8_t>(value >> (8 * i));
  };
  const auto put_float = [&](uint32_t address, float value) { set_word(address, std::bit_cast<uint32_t>(value)); };
  const std::string xml = genicam_description();
  const auto columns = static_cast<uint32_t>(pictures_[0]->width), rows = static_cast<uint32_t>(pictures_[0]->height);
  put_text(manufacturer_name, "VirtualBooth");
  put_text(model_name, "USB3");
  put_text(serial_number, serial_);
  put_little(response_time, response_ms, 4);
  put_little(manifest_address, manifest, 8);
  put_little(sbrm_address, sbrm, 8);
  put_little(most_command, most_transfer, 4);
  put_little(most_answer, most_transfer, 4);
  put_little(sirm_address, sirm, 8);
  put_little(payload_size, uint64_t{columns} * rows, 8);
  put_little(leader_size, leader_bytes, 4);
  put_little(trailer_size, trailer_bytes, 4);
  put_little(manifest, 1, 8);  // one entry, not compressed
  put_little(manifest + 16, description, 8);
  put_little(manifest + 24, xml.size(), 8);
  put_text(description, xml);
  for (const uint32_t address : {sensor_width, width}) set_word(address, columns);
  for (const uint32_t address : {sensor_height, height}) set_word(address, rows);
  set_word(pixel_format, mono8);
  set_word(trigger_source, line1);
  put_float(exposure_time, 5000);
  put_float(exposure_limit, 1e6);
  put_float(frame_rate, 10);
  put_float(gamma_value, 1);
  for (const uint32_t colour : {0u, 4u}) put_float(balance_ratio + colour, 1);
  pending_.clear();
  answers_.clear();
  sending_.clear();
  frame_id_ = 0;
}

bool Usb3VisionPeer::plug_in() {
  int pair[2];
  if (::socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, pair) != 0) throw std::runtime_error("no socket pair");
  {
    const std::lock_guard lock(mutex_);
    socket_ = pair[1];
    reset();
  }
  std::ifstream status(std::string(controller) + "/status");
  int port = -1;
  for (std::string line; port < 0 && std::getline(status, line);) {
    int number = 0, state = 0;
    constexpr int port_is_free = 4;
    if (std::sscanf(line.c_str(), "hs %d %d", &number, &state) == 2 && state == port_is_free) port = number;
  }
  constexpr int high_speed = 3;
  std::ofstream attach(std::string(controller) + "/attach");
  attach << port << " " << pair[0] << " " << (0x10000 + port + 1) << " " << high_speed << std::flush;
  ::close(pair[0]);
  if (port < 0 || !attach) throw std::runtime_error("vhci-hcd has no port for " + serial_);
  thread_ = std::jthread([this] { run(); });
  return eventually([&] { return is_plugged_in(serial_); });
}

void Usb3VisionPeer::unplug() {
  if (!thread_.joinable()) return;
  {
    const std::lock_guard lock(mutex_);
    ::shutdown(socket_, SHUT_RDWR);
  }
  thread_.join();
  {
    const std::lock_guard lock(mutex_);
    ::close(std::exchange(socket_, -1));
    set_word(acquisition, 0);
  }
  eventually([&] { return !is_plugged_in(serial_); });
}

void Usb3VisionPeer::expose() {
  const std::lock_guard lock(mutex_);
  if (word(trigger_mode + 4 * word(trigger_selector)) != 0 && word(trigger_source) == line1) begin_frame();
}

void Usb3VisionPeer::cut_next_frame() {
  const std::lock_guard lock(mutex_);
  cut_next_ = true;
}

void Usb3VisionPeer::run() {
  auto due = Clock::now();
  while (true) {
    pollfd polled{socket_, POLLIN, 0};
    const int ready = ::poll(&polled, 1, 10);
    if (ready > 0 && !serve()) return;
    const std::lock_guard lock(mutex_);
    if (word(trigger_mode + 4 * word(trigger_selector)) == 0 && Clock::now() >= due) {
      due = Clock::now() + free_running_period;
      begin_frame();
    }
  }
}

bool Usb3VisionPeer::serve() {
  Request request;
  static_assert(sizeof request == message_size);
  if (!read_all(socket_, &request, sizeof request)) return false;
  for (uint32_t* word : {&request.command, &request.sequence, &request.direction, &request.endpoint})
    *word = ntohl(*word);
  for (uint32_t& word : request.words) word = ntohl(word);
  const bool to_host = request.direction == 1;
  Bytes data;
  if (request.command == cmd_submit && !to_host) {
    data.resize(request.words[1]);
    if (!data.empty() && !read_all(socket_, data.data(), data.size())) return false;
  }
  const std::lock_guard lock(mutex_);
  if (request.command == cmd_unlink) {
    bool found = false;
    for (auto& [endpoint, waiting] : pending_)
      found |= std::erase_if(waiting, [&](const Pending& one) { return one.sequence == request.words[0]; }) > 0;
    Bytes message(message_size, 0);
    const uint32_t words[] = {
        htonl(ret_unlink), htonl(request.sequence), 0, 0, 0, htonl(static_cast<uint32_t>(found ? -ECONNRESET : 0))};
    std::memcpy(message.data(), words, sizeof words);
    write_all(socket_, message);
    return true;
  }
  if (request.command != cmd_submit) return false;
  if (request.endpoint == 0) {
    answer_standard_request(request);
  } else if (to_host) {
    pending_[request.endpoint].push_back({request.sequence, request.words[1]});
  } else {
    reply(request.sequence, 0, {}, request.words[1]);
    answers_.push_back(execute(data));
  }
  pump();
  return true;
}

void Usb3VisionPeer::reply(uint32_t sequence, int status, const Bytes& data, uint32_t length) {
  Bytes message(message_size, 0);
  const uint32_t words[] = {htonl(ret_submit),
                            htonl(sequence),
                            0,
                            0,
                            0,
                            htonl(static_cast<uint32_t>(status)),
                            htonl(length),
                            0,
                            htonl(static_cast<uint32_t>(-1))};
  std::memcpy(message.data(), words, sizeof words);
  message.insert(message.end(), data.begin(), data.end());
  write_all(socket_, message);
}

void Usb3VisionPeer::answer_standard_request(const Request& request) {
  constexpr uint8_t get_descriptor = 6, get_status = 0, get_configuration = 8;
  constexpr uint8_t device = 1, configuration = 2, string = 3;
  const uint8_t type = request.setup[3], index = request.setup[2];
  std::optional<Bytes> answer;
  if (request.setup[1] == get_descriptor && type == device) {
    answer = Bytes{18, 1, 0, 2, 0xEF, 2, 1, 64, 0x09, 0x12, 2, 0, 0, 1, 1, 2, 3, 1};
  } else if (request.setup[1] == get_descriptor && type == configuration) {
    // Two interfaces: control with its device information, of which the fourth text is the GUID, and stream.
    answer = Bytes{9, 2, 0, 0, 2, 1, 0, 0x80, 250};
    for (const Bytes& part :
         {Bytes{9, 4, 0, 0, 2, 0xEF, 5, 0, 0}, Bytes{20, 0x24, 1, 1, 1, 0, 0, 0, 1, 0, 0, 4, 1, 2, 0, 0, 2, 0, 3, 0},
          Bytes{7, 5, 0x81, 2, 0, 2, 0}, Bytes{7, 5, 0x01, 2, 0, 2, 0}, Bytes{9, 4, 1, 0, 1, 0xEF, 5, 2, 0},
          Bytes{7, 5, 0x82, 2, 0, 2, 0}})
      answer->insert(answer->end(), part.begin(), part.end());
    (*answer)[2] = static_cast<uint8_t>(answer->size());
  } else if (request.setup[1] == get_descriptor && type == string) {
    const std::string texts[] = {"VirtualBooth", "USB3", serial_, "GUID" + serial_};
    if (index == 0) answer = Bytes{4, 3, 9, 4};  // US English
    if (index >= 1 && index <= std::size(texts)) {
      answer = Bytes{0, string};
      for (const char letter : texts[index - 1]) answer->insert(answer->end(), {static_cast<uint8_t>(letter), 0});
      (*answer)[0] = static_cast<uint8_t>(answer->size());
    }
  } else if (request.setup[1] == get_status) {
    answer = Bytes{0, 0};
  } else if (request.setup[1] == get_configuration) {
    answer = Bytes{1};
  } else if ((request.setup[0] & 0x80) == 0) {
    return reply(request.sequence, 0, {}, request.words[1]);
  }
  if (!answer) return reply(request.sequence, -EPIPE, {}, 0);
  answer->resize(std::min<size_t>(answer->size(), request.words[1]));
  reply(request.sequence, 0, *answer, static_cast<uint32_t>(answer->size()));
}

/// The answer to a command of the control channel.
Bytes Usb3VisionPeer::execute(const Bytes& command) {
  if (command.size() < command_header + 8 || little(command.data(), 4) != control_magic) return {};
  const auto what = static_cast<uint16_t>(little(command.data() + 6, 2));
  const uint64_t address = little(command.data() + command_header, 8);
  const size_t size =
      what == read_memory ? little(command.data() + command_header + 10, 2) : command.size() - command_header - 8;
  const bool fits = address + size <= memory_.size();
  Bytes payload;
  if (fits && what == read_memory)
    payload.assign(memory_.begin() + static_cast<std::ptrdiff_t>(address),
                   memory_.begin() + static_cast<std::ptrdiff_t>(address + size));
  if (fits && what == write_memory) {
    std::copy(command.begin() + command_header + 8, command.end(),
              memory_.begin() + static_cast<std::ptrdiff_t>(address));
    written(static_cast<uint32_t>(address));
    append(payload, uint16_t{0});
    append(payload, static_cast<uint16_t>(size));
  }
  Bytes answer;
  append(answer, control_magic);
  append(answer, fits ? uint16_t{0} : invalid_address);
  append(answer, static_cast<uint16_t>(what + 1));
  append(answer, static_cast<uint16_t>(payload.size()));
  answer.insert(answer.end(), command.begin() + 10, command.begin() + 12);
  answer.insert(answer.end(), payload.begin(), payload.end());
  return answer;
}

/// What happens when the host has written a register.
void Usb3VisionPeer::written(uint32_t address) {
  if (address == trigger_software) begin_frame();
  if (address == acquisition && word(acquisition) == 0) sending_.clear();
  if (address != latch) return;
  const auto now = static_cast<uint64_t>(now_ns());
  set_word(latched, static_cast<uint32_t>(now >> 32));
  set_word(latched + 4, static_cast<uint32_t>(now));
}

void Usb3VisionPeer::begin_frame() {
  if (socket_ < 0 || word(acquisition) == 0 || !sending_.empty()) return;
  const Image& picture = *pictures_[next_picture_++ % pictures_.size()];
  const uint64_t id = frame_id_++;
  Bytes leader, trailer;
  append(leader, leader_magic);
  append(leader, uint16_t{0});
  append(leader, static_cast<uint16_t>(leader_bytes));
  append(leader, id);
  append(leader, uint16_t{0});
  append(leader, uint16_t{1});  // an image
  append(leader, static_cast<uint64_t>(now_ns()));
  append(leader, mono8);
  append(leader, static_cast<uint32_t>(picture.width));
  append(leader, static_cast<uint32_t>(picture.height));
  leader.resize(leader_bytes, 0);
  const bool cut = std::exchange(cut_next_, false);
  append(trailer, trailer_magic);
  append(trailer, uint16_t{0});
  append(trailer, static_cast<uint16_t>(trailer_bytes));
  append(trailer, id);
  append(trailer, uint32_t{0});
  append(trailer, static_cast<uint64_t>(picture.samples.size() / (cut ? 2 : 1)));
  trailer.resize(trailer_bytes, 0);
  sending_.push_back(leader);
  size_t block = little(memory_.data() + block_size, 4);
  if (block == 0) block = picture.samples.size();
  const size_t size = picture.samples.size() / (cut ? 2 : 1);
  for (size_t at = 0; at < size; at += block)
    sending_.emplace_back(picture.samples.begin() + static_cast<std::ptrdiff_t>(at),
                          picture.samples.begin() + static_cast<std::ptrdiff_t>(std::min(size, at + block)));
  sending_.push_back(trailer);
  pump();
}

/// Hands answers and the frame to the transfers that the host waits for.
void Usb3VisionPeer::pump() {
  for (auto& [endpoint, parts] : {std::pair<uint32_t, std::deque<Bytes>&>{control_endpoint, answers_},
                                  std::pair<uint32_t, std::deque<Bytes>&>{stream_endpoint, sending_}}) {
    std::deque<Pending>& waiting = pending_[endpoint];
    while (!waiting.empty() && !parts.empty()) {
      Bytes& part = parts.front();
      const size_t size = std::min<size_t>(part.size(), waiting.front().length);
      reply(waiting.front().sequence, 0, Bytes(part.begin(), part.begin() + static_cast<std::ptrdiff_t>(size)),
            static_cast<uint32_t>(size));
      waiting.pop_front();
      part.erase(part.begin(), part.begin() + static_cast<std::ptrdiff_t>(size));
      if (part.empty()) parts.pop_front();
    }
  }
}

}  // namespace booth
