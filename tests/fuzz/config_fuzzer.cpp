#include <cstdlib>

#include "config/booth_config.h"

/// A configuration without faults can be written and read again; a fault is one line.
extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  const auto reading = booth::parse_config({reinterpret_cast<const char*>(data), size}, "/etc/booth");
  for (const booth::ConfigFault& fault : reading.faults)
    if (fault.to_string().find('\n') != std::string::npos) std::abort();
  if (!reading.faults.empty()) return 0;
  const std::string text = booth::write_config(reading.config);
  const auto again = booth::parse_config(text, "/etc/booth");
  if (!again.faults.empty() || booth::write_config(again.config) != text) std::abort();
  return 0;
}
