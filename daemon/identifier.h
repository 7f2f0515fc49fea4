#pragma once

#include <chrono>
#include <cstddef>
#include <optional>
#include <string>

namespace booth {

/// That many random lower-case hexadecimal digits, from the operating system.
std::string random_hex(size_t digits);

/// "2026-11-22T10:15:00Z"; with `milliseconds`, "2026-11-22T10:15:00.042Z".
std::string iso8601(std::chrono::system_clock::time_point time, bool milliseconds = false);

/// The instant that such a text names; what follows its seconds is left out.
/// @return nothing where it names none, or one that the clock does not hold: it ends some 292 years from 1970
std::optional<std::chrono::system_clock::time_point> parse_iso8601(const std::string& text);

/// A new capture's id, safe as a file name: "2026-11-22T10-15-00.042Z-7f3a". Ids sort by their time.
std::string make_capture_id(std::chrono::system_clock::time_point time);

}  // namespace booth
