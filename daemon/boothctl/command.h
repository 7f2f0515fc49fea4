#pragma once

#include <string>

namespace booth {

// What every subcommand of boothctl ends with.
inline constexpr int exit_ok = 0;
inline constexpr int exit_refused = 1;
inline constexpr int exit_usage = 2;
inline constexpr int exit_unreachable = 3;

/// Ends the program with a sentence for the operator.
struct Failure {
  int status;
  std::string message;
};

/// What a terminal should not be made to interpret is shown as '?'.
inline std::string printable(std::string text) {
  for (char& c : text)
    if (static_cast<unsigned char>(c) < 0x20 || c == 0x7f) c = '?';
  return text;
}

}  // namespace booth
