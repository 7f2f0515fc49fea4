#include "drivers/v4l2/mjpeg.h"

namespace booth {
namespace {

// Markers, ITU-T T.81 table B.1: each is a byte after 0xFF.
constexpr uint8_t soi = 0xD8;
constexpr uint8_t eoi = 0xD9;
constexpr uint8_t sos = 0xDA;
constexpr uint8_t tem = 0x01;
bool is_restart(uint8_t marker) { return marker >= 0xD0 && marker <= 0xD7; }

}  // namespace

std::optional<size_t> whole_jpeg(std::span<const uint8_t> bytes) {
  if (bytes.size() < 4 || bytes[0] != 0xFF || bytes[1] != soi) return std::nullopt;
  bool scanned = false;
  size_t at = 2;
  while (at + 1 < bytes.size()) {
    if (bytes[at] != 0xFF) return std::nullopt;
    const uint8_t marker = bytes[at + 1];
    if (marker == 0xFF) {  // a fill byte
      ++at;
      continue;
    }
    at += 2;
    if (marker == eoi) return scanned ? std::optional<size_t>(at) : std::nullopt;
    if (marker == soi || marker == 0x00) return std::nullopt;
    if (marker == tem || is_restart(marker)) continue;
    if (at + 2 > bytes.size()) return std::nullopt;
    const size_t length = static_cast<size_t>(bytes[at]) << 8 | bytes[at + 1];
    if (length < 2 || at + length > bytes.size()) return std::nullopt;
    at += length;
    if (marker != sos) continue;
    scanned = true;
    // Entropy-coded data ends at the next marker; 0xFF 0x00 is a sample, restart markers lie within.
    while (at + 1 < bytes.size() && (bytes[at] != 0xFF || bytes[at + 1] == 0x00 || is_restart(bytes[at + 1]))) ++at;
  }
  return std::nullopt;
}

}  // namespace booth
