#include <cstdlib>

#include "replay/scan_file.h"

/// What is read as a scan is a valid mesh or cloud, whichever of the formats it is taken for.
extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  for (const char* name : {"face.ply", "face.obj"}) {
    const auto mesh = booth::parse_scan_file(name, {data, size});
    if (mesh && (mesh->positions.empty() || !booth::check(*mesh))) std::abort();
  }
  return 0;
}
