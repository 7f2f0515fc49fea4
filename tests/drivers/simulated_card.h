#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

namespace booth {

/// A graphics card of which a test says what goes wrong. Whoever links simulated_card.cpp has its functions in the
/// place of libdrm's; the card's node is an ordinary file, which can be opened and mapped. There is one card at a time.
class SimulatedCard {
 public:
  struct Connector {
    uint32_t number = 1;  ///< "HDMI-A-1"
    bool connected = true;
    bool has_modes = true;  ///< 32 x 16 at about 60 Hz
    bool has_crtc = true;
  };

  SimulatedCard();
  ~SimulatedCard();
  SimulatedCard(const SimulatedCard&) = delete;
  SimulatedCard& operator=(const SimulatedCard&) = delete;

  /// Of its node.
  const std::string& path() const { return path_; }

  std::vector<Connector> connectors = {{}};
  bool drives_displays = true;
  bool has_dumb_buffers = true;
  bool stamps_with_monotonic_clock = true;
  bool flips = true;  ///< else a flip is taken, but never completes
  /// errno of a call; 0: it works.
  int master_error = 0;
  int create_error = 0;
  int add_error = 0;
  int map_error = 0;
  int mode_error = 0;
  int flip_error = 0;
  int event_error = 0;

  /// What the driver did last.
  uint32_t shown_buffer = 0;
  void* flip_waits = nullptr;  ///< what the driver gave along with a flip that has not completed
  uint32_t buffers = 0;        ///< that are lent

 private:
  std::string path_;
};

}  // namespace booth
