#include <cstdlib>
#include <string_view>

#include "replay/durable_folder.h"
#include "replay/recording_file.h"

namespace {

constexpr std::string_view rig = R"({"format": "booth-rig", "version": 1,
  "volume": {"min": [-1, 0, -1], "max": [1, 2, 1]}, "cameras": [
  {"id": "body-00", "width": 480, "height": 640, "K": [[500, 0, 240], [0, 500, 320], [0, 0, 1]],
   "distortion": [0, 0, 0, 0, 0], "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "t": [0, 0, 2]}]})";

}  // namespace

/// What is read as a recording names only files inside its folder.
extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  const auto recording = booth::parse_recording({data, size}, [](const std::string&) {
    return booth::Result<std::vector<uint8_t>>(std::vector<uint8_t>(rig.begin(), rig.end()));
  });
  if (!recording) return 0;
  for (const booth::Shot& shot : recording->shots)
    for (const booth::FrameRecord& frame : shot.frames)
      if (!booth::is_safe_relative_path(frame.file)) std::abort();
  return 0;
}
