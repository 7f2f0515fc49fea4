#include "daemon/empty_view_store.h"

#include <fcntl.h>
#include <libdeflate.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cstring>
#include <fstream>
#include <map>
#include <sstream>
#include <utility>
#include <vector>

#include "pipeline/export/sha256.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

constexpr std::array<char, 8> magic{'b', 'o', 'o', 't', 'h', 'e', 'v', '1'};
constexpr const char* extension = ".view";
constexpr uint32_t largest_side = 1 << 16;

/// What a file begins with, in the machine's own byte order: it stays on the machine.
struct Header {
  std::array<char, 8> magic;
  uint32_t width, height, channels, cells;
  uint32_t checksum;  ///< CRC-32 of what follows
};

/// Names these files as they are now: links to a file are the same file, one that was written to is another.
std::optional<std::string> key_of(const Recording& recording, std::span<const FrameRecord> frames) {
  std::ostringstream text;
  for (const FrameRecord& frame : frames) {
    struct stat info {};
    if (::stat((recording.folder / frame.file).c_str(), &info) != 0) return std::nullopt;
    text << info.st_dev << ' ' << info.st_ino << ' ' << info.st_size << ' ' << info.st_mtim.tv_sec << ' '
         << info.st_mtim.tv_nsec << ' ' << (frame.mosaic ? static_cast<int>(frame.mosaic->pattern) : -1)
         << (frame.mosaic && frame.mosaic->linear) << '\n';
  }
  const std::string bytes = text.str();
  return sha256_hex(std::vector<uint8_t>(bytes.begin(), bytes.end()));
}

uint32_t checksum_of(const Image& mean, const std::vector<float>& flicker) {
  const uint32_t first = libdeflate_crc32(0, mean.samples.data(), mean.samples.size());
  // Of no bytes at all, whose address is null, it would forget the first.
  return flicker.empty() ? first : libdeflate_crc32(first, flicker.data(), flicker.size() * sizeof(float));
}

}  // namespace

EmptyViewStore::EmptyViewStore(fs::path folder, uint64_t most_bytes)
    : folder_(std::move(folder)), most_bytes_(most_bytes) {}

std::optional<EmptyView> EmptyViewStore::find(const Recording& recording, std::span<const FrameRecord> frames) const {
  const auto key = key_of(recording, frames);
  if (!key || frames.empty()) return std::nullopt;
  const fs::path path = folder_ / (*key + extension);
  std::ifstream file(path, std::ios::binary);
  Header header{};
  if (!file.read(reinterpret_cast<char*>(&header), sizeof header) || header.magic != magic) return std::nullopt;
  if (header.width > largest_side || header.height > largest_side || (header.channels != 1 && header.channels != 3))
    return std::nullopt;
  const uint64_t samples = uint64_t{header.width} * header.height * header.channels;
  std::error_code code;
  if (fs::file_size(path, code) != sizeof header + samples + uint64_t{header.cells} * sizeof(float))
    return std::nullopt;
  EmptyView view{
      frames.front().camera,
      Image(static_cast<int>(header.width), static_cast<int>(header.height), static_cast<int>(header.channels)),
      std::vector<float>(header.cells)};
  file.read(reinterpret_cast<char*>(view.mean.samples.data()), static_cast<std::streamsize>(samples));
  file.read(reinterpret_cast<char*>(view.flicker.data()), static_cast<std::streamsize>(header.cells * sizeof(float)));
  if (!file || checksum_of(view.mean, view.flicker) != header.checksum) return std::nullopt;
  ::utimensat(AT_FDCWD, path.c_str(), nullptr, 0);  // used now; where that fails, it is only forgotten sooner
  return view;
}

Result<void> EmptyViewStore::keep(const Recording& recording, std::span<const FrameRecord> frames,
                                  const EmptyView& view) const {
  const auto key = key_of(recording, frames);
  if (!key) return Error{ErrorCode::io, recording.folder.string() + ": a frame of the empty booth cannot be looked at"};
  std::error_code code;
  fs::create_directories(folder_, code);
  const Header header{magic,
                      static_cast<uint32_t>(view.mean.width),
                      static_cast<uint32_t>(view.mean.height),
                      static_cast<uint32_t>(view.mean.channels),
                      static_cast<uint32_t>(view.flicker.size()),
                      checksum_of(view.mean, view.flicker)};
  const fs::path path = folder_ / (*key + extension);
  const fs::path partial = folder_ / ("." + *key + "-" + std::to_string(::getpid()));
  {
    std::ofstream file(partial, std::ios::binary | std::ios::trunc);
    file.write(reinterpret_cast<const char*>(&header), sizeof header);
    file.write(reinterpret_cast<const char*>(view.mean.samples.data()),
               static_cast<std::streamsize>(view.mean.samples.size()));
    file.write(reinterpret_cast<const char*>(view.flicker.data()),
               static_cast<std::streamsize>(view.flicker.size() * sizeof(float)));
    file.close();
    if (!file) code = std::make_error_code(std::errc::io_error);
  }
  // Not flushed: a file torn by a power cut is found by its checksum and learned anew.
  if (!code) fs::rename(partial, path, code);
  if (code) {
    std::error_code ignored;  // the write failed for a reason of its own, which is told
    fs::remove(partial, ignored);
    return Error{ErrorCode::io, path.string() + ": cannot be written: " + code.message()};
  }
  make_room();
  return {};
}

void EmptyViewStore::make_room() const {
  struct Kept {
    fs::path path;
    fs::file_time_type used;
    uint64_t bytes;
  };
  std::vector<Kept> kept;
  uint64_t total = 0;
  std::error_code code;
  for (const auto& entry : fs::directory_iterator(folder_, code)) {
    const Kept file{entry.path(), entry.last_write_time(code), entry.file_size(code)};
    if (code) continue;  // another process removed it meanwhile
    kept.push_back(file);
    total += file.bytes;
  }
  std::sort(kept.begin(), kept.end(), [](const Kept& a, const Kept& b) { return a.used < b.used; });
  for (const Kept& file : kept) {
    if (total <= most_bytes_) return;
    fs::remove(file.path, code);
    total -= file.bytes;
  }
}

EmptyBooth learn_background(const Recording& recording, const Shot& background, const EmptyViewStore* store,
                            const Work& work) {
  std::map<std::string, Shot> by_camera;
  for (const FrameRecord& frame : background.frames) {
    Shot& shot = by_camera[frame.camera];
    shot.role = background.role;
    shot.frames.push_back(frame);
  }
  const std::vector<std::pair<std::string, Shot>> cameras(by_camera.begin(), by_camera.end());
  std::vector<EmptyBooth> learned(cameras.size());
  work.parallel_for(cameras.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !work.stopped(); ++i) {
      const Shot& shot = cameras[i].second;
      EmptyBooth& of_camera = learned[i];
      if (auto kept = store != nullptr ? store->find(recording, shot.frames) : std::nullopt) {
        of_camera.views.push_back(std::move(*kept));
        continue;
      }
      LoadedShot loaded = load_shot(recording, shot, work);
      EmptyBooth booth = learn_empty_booth(loaded.sets, work);
      of_camera.views = std::move(booth.views);
      of_camera.faults = std::move(loaded.faults);
      of_camera.faults.insert(of_camera.faults.end(), booth.faults.begin(), booth.faults.end());
      // With a fault it is learned again, so that the fault is told again.
      if (store == nullptr || !of_camera.faults.empty() || of_camera.views.empty()) continue;
      if (const auto kept = store->keep(recording, shot.frames, of_camera.views.front()); !kept)
        of_camera.faults.push_back("the learned background is not kept: " + kept.error().message);
    }
  });
  EmptyBooth all;
  for (EmptyBooth& of_camera : learned) {
    for (EmptyView& view : of_camera.views) all.views.push_back(std::move(view));
    all.faults.insert(all.faults.end(), of_camera.faults.begin(), of_camera.faults.end());
  }
  return all;
}

}  // namespace booth
