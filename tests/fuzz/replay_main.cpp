// Runs a fuzzer on files, one after the other, without libFuzzer: its corpus and what it once found are tests of every
// build, under every sanitizer.
//
//   rig_replay FOLDER …

#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <iterator>
#include <vector>

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);

namespace {

/// Whole, and without the end and with one byte turned over, at some places: damage that a disk or a network does.
void try_file(const std::filesystem::path& file) {
  std::ifstream stream(file, std::ios::binary);
  std::vector<char> text((std::istreambuf_iterator<char>(stream)), {});
  std::vector<uint8_t> bytes(text.begin(), text.end());
  LLVMFuzzerTestOneInput(bytes.data(), bytes.size());
  constexpr size_t places = 64;
  for (size_t place = 0; place < places; ++place) {
    const size_t at = bytes.size() * place / places;
    if (at >= bytes.size()) continue;
    const std::vector<uint8_t> cut(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(at));
    LLVMFuzzerTestOneInput(cut.data(), cut.size());
    std::vector<uint8_t> damaged = bytes;
    damaged[at] = static_cast<uint8_t>(~damaged[at]);
    LLVMFuzzerTestOneInput(damaged.data(), damaged.size());
  }
}

}  // namespace

int main(int argc, char** argv) {
  size_t count = 0;
  for (int i = 1; i < argc; ++i)
    for (const auto& entry : std::filesystem::recursive_directory_iterator(argv[i]))
      if (entry.is_regular_file()) try_file(entry.path()), ++count;
  std::cout << count << " files\n";
  return count > 0 ? 0 : 1;
}
