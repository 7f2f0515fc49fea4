// What storing a picture costs while capturing and again while reconstructing, by format, on the recording named by
// BOOTH_RECORDING (the small one of the repository by default): its first body picture in colour, the same as the grey
// mosaic that a camera would have sent, and, where it has a face scan, its first pattern. Processor time of encoding
// and decoding one, and its size.

#include <benchmark/benchmark.h>

#include <cstdlib>
#include <ctime>
#include <functional>
#include <iostream>
#include <string>
#include <vector>

#include "pipeline/image/codec.h"
#include "replay/recording.h"

namespace booth {
namespace {

double cpu_s() {
  timespec now{};
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

using Encode = std::function<std::vector<uint8_t>(const Image&)>;

void code(benchmark::State& state, const Image& image, const Encode& encode) {
  double encoding_s = 0, decoding_s = 0;
  size_t bytes = 0;
  for (auto _ : state) {
    const double begin = cpu_s();
    const std::vector<uint8_t> encoded = encode(image);
    const double middle = cpu_s();
    benchmark::DoNotOptimize(decode_image(encoded).value().samples.data());
    decoding_s += cpu_s() - middle;
    encoding_s += middle - begin;
    bytes = encoded.size();
  }
  const auto runs = static_cast<double>(state.iterations());
  state.counters["encode_ms"] = 1000 * encoding_s / runs;
  state.counters["decode_ms"] = 1000 * decoding_s / runs;
  state.counters["MB"] = static_cast<double>(bytes) / 1e6;
  state.counters["raw_MB"] = static_cast<double>(image.samples.size()) / 1e6;
}

Image first_picture(const Recording& recording, ShotRole role) {
  Shot first = *recording.find(role);
  first.frames.resize(1);
  return *load_shot(recording, first).sets.at(0).frames.at(0).pixels;
}

/// What a sensor behind red, green, green and blue filters would have sent.
Image mosaic_of(const Image& colours) {
  Image mosaic(colours.width, colours.height, 1);
  for (int y = 0; y < mosaic.height; ++y)
    for (int x = 0; x < mosaic.width; ++x) mosaic.at(x, y) = colours.at(x, y, x % 2 + y % 2);
  return mosaic;
}

void add(const std::string& name, const Image& image) {
  const auto with = [&](const std::string& format, const Encode& encode) {
    benchmark::RegisterBenchmark((name + "/" + format).c_str(), [image, encode](benchmark::State& state) {
      code(state, image, encode);
    })->Unit(benchmark::kMillisecond);
  };
  for (const int level : {0, 1, 3, 6})
    with("png_" + std::to_string(level), [level](const Image& i) { return encode_png(i, level); });
  for (const int quality : {90, 95})
    with("jpeg_" + std::to_string(quality), [quality](const Image& i) { return encode_jpeg(i, quality); });
}

}  // namespace
}  // namespace booth

int main(int argc, char** argv) {
  using namespace booth;
  const char* named = std::getenv("BOOTH_RECORDING");
  const auto recording = read_recording(named != nullptr ? named : BOOTH_SOURCE_DIR "/replay/recordings/mini");
  if (!recording) {
    std::cerr << recording.error().message << "\n";
    return 1;
  }
  const Image body = first_picture(*recording, ShotRole::body);
  add("body", body);
  if (body.channels == 3) add("mosaic", mosaic_of(body));
  if (recording->find(ShotRole::gray_code) != nullptr) add("pattern", first_picture(*recording, ShotRole::gray_code));
  benchmark::Initialize(&argc, argv);
  benchmark::RunSpecifiedBenchmarks();
  return 0;
}
