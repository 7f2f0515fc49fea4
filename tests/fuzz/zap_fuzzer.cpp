#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <string>
#include <vector>

#include "daemon/api/zap_handler.h"

namespace {

/// Of the one client that is let in: the example key of rfc.zeromq.org/spec/26.
constexpr const char* allowed = "Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID";

const booth::api::ClientDirectory& clients() {
  static const auto directory = [] {
    const auto folder = std::filesystem::temp_directory_path() / "booth-zap-fuzzer";
    std::filesystem::create_directories(folder);
    std::ofstream(folder / "one.json") << R"({"public_key": ")" << allowed << R"(", "role": "viewer"})";
    auto read = std::make_unique<booth::api::ClientDirectory>(folder);
    if (!read->find(allowed)) std::abort();
    return read;
  }();
  return *directory;
}

}  // namespace

/// Frames, each behind a byte that says how long it is. Whatever they are, there is an answer, and only the one key
/// lets anybody in.
extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  std::vector<std::string> frames;
  for (size_t at = 0; at < size;) {
    const size_t wanted = data[at++];
    const size_t length = std::min(wanted, size - at);
    frames.emplace_back(reinterpret_cast<const char*>(data) + at, length);
    at += length;
  }
  const auto answer = booth::api::answer_zap(frames, clients());
  if (answer.status == "200" ? answer.user_id != allowed || frames.at(5) != "CURVE"
                             : (answer.status != "400" && answer.status != "500") || !answer.user_id.empty())
    std::abort();
  return 0;
}
