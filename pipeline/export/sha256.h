#pragma once

#include <cstdint>
#include <span>
#include <string>

namespace booth {

/// The SHA-256 digest of some bytes as 64 lower-case hexadecimal digits.
/// Source: NIST, FIPS 180-4, "Secure Hash Standard".
std::string sha256_hex(std::span<const uint8_t> bytes);

}  // namespace booth
