#include <cstdlib>

#include "replay/recording_file.h"

/// What is read as a rig is a valid one and can be written and read again.
extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  const auto rig = booth::parse_rig("rig.json", {data, size});
  if (!rig) return 0;
  const std::string text = booth::write_rig_json(*rig);
  const auto again = booth::parse_rig("rig.json", {reinterpret_cast<const uint8_t*>(text.data()), text.size()});
  if (!booth::check(*rig) || !again || booth::write_rig_json(*again) != text) std::abort();
  return 0;
}
