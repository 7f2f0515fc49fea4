#include "pipeline/image/codec.h"

#include <libdeflate.h>
#include <png.h>
#include <turbojpeg.h>

#include <algorithm>
#include <array>
#include <csetjmp>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <string_view>

namespace booth {
namespace {

constexpr uint64_t most_pixels = 100'000'000;
// What can at most come out of a byte of the file, so that a short one cannot make us fill memory for a huge picture:
// deflate's longest match is 258 bytes in 2 bits; each 8 × 8 block of a JPEG takes a bit or more in its first scan.
constexpr uint64_t most_png_bytes_a_byte = 1032;
constexpr uint64_t most_jpeg_pixels_a_byte = 64 * 8;
constexpr uint8_t png_signature[] = {0x89, 'P', 'N', 'G', '\r', '\n', 0x1a, '\n'};

Error damaged(const std::string& what) { return {ErrorCode::invalid_file, what}; }

bool has_signature(std::span<const uint8_t> bytes, std::span<const uint8_t> signature) {
  return bytes.size() >= signature.size() && std::memcmp(bytes.data(), signature.data(), signature.size()) == 0;
}
bool is_png(std::span<const uint8_t> bytes) { return has_signature(bytes, png_signature); }
bool is_jpeg(std::span<const uint8_t> bytes) {
  constexpr uint8_t start_of_image[] = {0xff, 0xd8, 0xff};
  return has_signature(bytes, start_of_image);
}

Result<void> check_size(uint64_t width, uint64_t height) {
  if (width == 0 || height == 0 || width * height > most_pixels)
    return damaged("says it has " + std::to_string(width) + " × " + std::to_string(height) + " pixels");
  return {};
}

/// libpng's reader with its state; every fault becomes an exception-free error through png_reader::fault.
struct PngReader {
  png_structp png = nullptr;
  png_infop info = nullptr;
  uint64_t size;  ///< of the whole file, bytes
  std::span<const uint8_t> rest;
  std::string fault;

  explicit PngReader(std::span<const uint8_t> bytes) : size(bytes.size()), rest(bytes) {
    png = png_create_read_struct(PNG_LIBPNG_VER_STRING, this, on_error, on_warning);
    if (png != nullptr) info = png_create_info_struct(png);
    if (info == nullptr) throw std::bad_alloc();
    png_set_read_fn(png, this, read);
    constexpr png_uint_32 longest_side = 1U << 20;
    png_set_user_limits(png, longest_side, longest_side);
  }
  ~PngReader() { png_destroy_read_struct(&png, &info, nullptr); }
  PngReader(const PngReader&) = delete;
  PngReader& operator=(const PngReader&) = delete;

  static void read(png_structp png, png_bytep to, size_t count) {
    auto* self = static_cast<PngReader*>(png_get_io_ptr(png));
    if (count > self->rest.size()) png_error(png, "ends early");
    std::memcpy(to, self->rest.data(), count);
    self->rest = self->rest.subspan(count);
  }
  [[noreturn]] static void on_error(png_structp png, png_const_charp message) {
    static_cast<PngReader*>(png_get_error_ptr(png))->fault = message;
    png_longjmp(png, 1);
  }
  static void on_warning(png_structp, png_const_charp) {}
};

/// Asks libpng for 8-bit grey, RGB or RGBA.
void request_plain_samples(PngReader& reader) {
  png_set_expand(reader.png);
  png_set_scale_16(reader.png);
  if ((png_get_color_type(reader.png, reader.info) & PNG_COLOR_MASK_ALPHA) != 0 &&
      (png_get_color_type(reader.png, reader.info) & PNG_COLOR_MASK_COLOR) == 0)
    png_set_gray_to_rgb(reader.png);
  png_set_interlace_handling(reader.png);
  png_read_update_info(reader.png, reader.info);
}

/// Reads header and, where `image` is given, pixels. Only trivially destructible locals live across longjmp.
bool read_png(PngReader& reader, ImageHeader* header, Image* image, std::vector<png_bytep>* rows) {
  if (setjmp(png_jmpbuf(reader.png)) != 0) return false;
  png_read_info(reader.png, reader.info);
  header->width = static_cast<int>(png_get_image_width(reader.png, reader.info));
  header->height = static_cast<int>(png_get_image_height(reader.png, reader.info));
  if (static_cast<uint64_t>(header->width) * static_cast<uint64_t>(header->height) > most_pixels)
    png_error(reader.png, "has more than 100 million pixels");
  const uint64_t content = uint64_t{png_get_rowbytes(reader.png, reader.info)} * static_cast<uint64_t>(header->height);
  request_plain_samples(reader);
  header->channels = png_get_channels(reader.png, reader.info);
  if (image == nullptr) return true;
  if (content > reader.size * most_png_bytes_a_byte) png_error(reader.png, "ends early");
  *image = Image(header->width, header->height, header->channels);
  rows->resize(static_cast<size_t>(header->height));
  for (int y = 0; y < header->height; ++y) (*rows)[static_cast<size_t>(y)] = image->pixel(0, y);
  png_read_image(reader.png, rows->data());
  png_read_end(reader.png, nullptr);
  return true;
}

struct CloseTurbo {
  void operator()(void* handle) const { tjDestroy(handle); }
};
using Turbo = std::unique_ptr<void, CloseTurbo>;

Result<ImageHeader> jpeg_header(tjhandle handle, std::span<const uint8_t> bytes) {
  ImageHeader header{.format = ImageFormat::jpeg};
  int subsampling = 0, colourspace = 0;
  if (tjDecompressHeader3(handle, bytes.data(), bytes.size(), &header.width, &header.height, &subsampling,
                          &colourspace) != 0)
    return damaged(tjGetErrorStr2(handle));
  header.channels = colourspace == TJCS_GRAY ? 1 : 3;
  if (const auto sized = check_size(static_cast<uint64_t>(header.width), static_cast<uint64_t>(header.height)); !sized)
    return sized.error();
  return header;
}

Result<Image> decode_jpeg(std::span<const uint8_t> bytes) {
  const Turbo turbo(tjInitDecompress());
  if (!turbo) throw std::bad_alloc();
  const auto header = jpeg_header(turbo.get(), bytes);
  if (!header) return header.error();
  if (static_cast<uint64_t>(header->width) * static_cast<uint64_t>(header->height) >
      bytes.size() * most_jpeg_pixels_a_byte)
    return damaged("ends early");
  Image image(header->width, header->height, header->channels);
  // TJFLAG_STOPONWARNING: a truncated file is a fault, not a picture whose lower part is grey.
  // TJFLAG_LIMITSCANS: no file can keep us busy by repeating scans.
  if (tjDecompress2(turbo.get(), bytes.data(), bytes.size(), image.samples.data(), image.width, 0, image.height,
                    image.channels == 1 ? TJPF_GRAY : TJPF_RGB,
                    TJFLAG_STOPONWARNING | TJFLAG_LIMITSCANS | TJFLAG_ACCURATEDCT) != 0)
    return damaged(tjGetErrorStr2(turbo.get()));
  return image;
}

Result<Image> decode_png(std::span<const uint8_t> bytes) {
  PngReader reader(bytes);
  ImageHeader header;
  Image image;
  std::vector<png_bytep> rows;
  if (!read_png(reader, &header, &image, &rows)) return damaged(reader.fault);
  return image;
}

// ---- writing PNG ----------------------------------------------------------------------------------------------------
// By hand, as libpng deflates with zlib, which takes several times as long as libdeflate for the same size.

int png_colour_type(int channels) {
  switch (channels) {
    case 1: return PNG_COLOR_TYPE_GRAY;
    case 3: return PNG_COLOR_TYPE_RGB;
    case 4: return PNG_COLOR_TYPE_RGBA;
    default: throw std::invalid_argument("encode_png: needs 1, 3 or 4 channels");
  }
}

/// Paeth's predictor: of left, up and up-left the one nearest to left + up − up-left.
int paeth(int left, int up, int up_left) {
  const int to_left = std::abs(up - up_left), to_up = std::abs(left - up_left),
            to_up_left = std::abs(left + up - 2 * up_left);
  if (to_left <= to_up && to_left <= to_up_left) return left;
  return to_up <= to_up_left ? up : up_left;
}

/// Writes `row` less what `predict(left, up, up_left)` makes of its neighbours, and returns how far the differences
/// are from zero in sum, by which libpng too judges filters. `above` is the row before, zeros above the first.
template <class Predict>
uint64_t filter_row(std::span<const uint8_t> row, const uint8_t* above, size_t channels, uint8_t* out,
                    const Predict& predict) {
  uint64_t sum = 0;
  const auto put = [&](size_t i, int left, int up_left) {
    out[i] = static_cast<uint8_t>(row[i] - predict(left, above[i], up_left));
    sum += static_cast<uint64_t>(std::abs(static_cast<int8_t>(out[i])));
  };
  for (size_t i = 0; i < channels; ++i) put(i, 0, 0);
  for (size_t i = channels; i < row.size(); ++i) put(i, row[i - channels], above[i - channels]);
  return sum;
}

/// Every row with the filter that leaves the least, each behind the byte that names it.
std::vector<uint8_t> filter_rows(const Image& image) {
  const auto channels = static_cast<size_t>(image.channels);
  const size_t row_bytes = static_cast<size_t>(image.width) * channels;
  std::vector<uint8_t> filtered;
  filtered.reserve((row_bytes + 1) * static_cast<size_t>(image.height));
  const std::vector<uint8_t> zeros(row_bytes, 0);
  std::array<std::vector<uint8_t>, PNG_FILTER_VALUE_LAST> candidates;
  for (auto& candidate : candidates) candidate.resize(row_bytes);
  for (int y = 0; y < image.height; ++y) {
    const std::span<const uint8_t> row(image.pixel(0, y), row_bytes);
    const uint8_t* above = y > 0 ? image.pixel(0, y - 1) : zeros.data();
    const auto apply = [&](int type, const auto& predict) {
      return filter_row(row, above, channels, candidates[static_cast<size_t>(type)].data(), predict);
    };
    std::array<uint64_t, PNG_FILTER_VALUE_LAST> left_over{};
    left_over[PNG_FILTER_VALUE_NONE] = apply(PNG_FILTER_VALUE_NONE, [](int, int, int) { return 0; });
    left_over[PNG_FILTER_VALUE_SUB] = apply(PNG_FILTER_VALUE_SUB, [](int left, int, int) { return left; });
    left_over[PNG_FILTER_VALUE_UP] = apply(PNG_FILTER_VALUE_UP, [](int, int up, int) { return up; });
    left_over[PNG_FILTER_VALUE_AVG] =
        apply(PNG_FILTER_VALUE_AVG, [](int left, int up, int) { return (left + up) / 2; });
    left_over[PNG_FILTER_VALUE_PAETH] = apply(PNG_FILTER_VALUE_PAETH, paeth);
    const auto best = std::min_element(left_over.begin(), left_over.end()) - left_over.begin();
    filtered.push_back(static_cast<uint8_t>(best));
    const auto& chosen = candidates[static_cast<size_t>(best)];
    filtered.insert(filtered.end(), chosen.begin(), chosen.end());
  }
  return filtered;
}

struct FreeCompressor {
  void operator()(libdeflate_compressor* compressor) const { libdeflate_free_compressor(compressor); }
};

std::vector<uint8_t> deflate(std::span<const uint8_t> bytes, int level) {
  const std::unique_ptr<libdeflate_compressor, FreeCompressor> compressor(libdeflate_alloc_compressor(level));
  if (!compressor) throw std::invalid_argument("encode_png: needs a level of 0 … 12");
  std::vector<uint8_t> out(libdeflate_zlib_compress_bound(compressor.get(), bytes.size()));
  out.resize(libdeflate_zlib_compress(compressor.get(), bytes.data(), bytes.size(), out.data(), out.size()));
  return out;
}

void put_big_endian(std::vector<uint8_t>& out, uint32_t word) {
  for (int shift = 24; shift >= 0; shift -= 8) out.push_back(static_cast<uint8_t>(word >> shift));
}

void put_chunk(std::vector<uint8_t>& out, std::string_view type, std::span<const uint8_t> content) {
  put_big_endian(out, static_cast<uint32_t>(content.size()));
  const size_t checked_from = out.size();
  out.insert(out.end(), type.begin(), type.end());
  out.insert(out.end(), content.begin(), content.end());
  put_big_endian(out, libdeflate_crc32(0, out.data() + checked_from, out.size() - checked_from));
}

}  // namespace

Result<ImageHeader> read_image_header(std::span<const uint8_t> bytes) {
  if (is_png(bytes)) {
    PngReader reader(bytes);
    ImageHeader header;
    if (!read_png(reader, &header, nullptr, nullptr)) return damaged(reader.fault);
    return header;
  }
  if (is_jpeg(bytes)) {
    const Turbo turbo(tjInitDecompress());
    if (!turbo) throw std::bad_alloc();
    return jpeg_header(turbo.get(), bytes);
  }
  return damaged("is neither a PNG nor a JPEG");
}

Result<Image> decode_image(std::span<const uint8_t> bytes) {
  if (is_png(bytes)) return decode_png(bytes);
  if (is_jpeg(bytes)) return decode_jpeg(bytes);
  return damaged("is neither a PNG nor a JPEG");
}

std::vector<uint8_t> encode_png(const Image& image, int level) {
  std::vector<uint8_t> header;
  put_big_endian(header, static_cast<uint32_t>(image.width));
  put_big_endian(header, static_cast<uint32_t>(image.height));
  constexpr uint8_t bits_a_sample = 8;
  header.insert(header.end(), {bits_a_sample, static_cast<uint8_t>(png_colour_type(image.channels)),
                               PNG_COMPRESSION_TYPE_BASE, PNG_FILTER_TYPE_BASE, PNG_INTERLACE_NONE});
  if (image.empty()) throw std::invalid_argument("encode_png: needs an image with pixels");
  const std::vector<uint8_t> pixels = deflate(filter_rows(image), level);
  std::vector<uint8_t> png(std::begin(png_signature), std::end(png_signature));
  constexpr size_t chunk_overheads = 3 * 12, header_bytes = 13;
  png.reserve(png.size() + chunk_overheads + header_bytes + pixels.size());
  put_chunk(png, "IHDR", header);
  put_chunk(png, "IDAT", pixels);
  put_chunk(png, "IEND", {});
  return png;
}

std::vector<uint8_t> encode_jpeg(const Image& image, int quality) {
  if (image.channels != 1 && image.channels != 3) throw std::invalid_argument("encode_jpeg: needs 1 or 3 channels");
  if (image.empty()) throw std::invalid_argument("encode_jpeg: needs an image with pixels");
  const Turbo turbo(tjInitCompress());
  if (!turbo) throw std::bad_alloc();
  const bool grey = image.channels == 1;
  constexpr int full_colour_from = 90;
  const int subsampling = grey ? TJSAMP_GRAY : quality >= full_colour_from ? TJSAMP_444 : TJSAMP_420;
  unsigned char* buffer = nullptr;
  unsigned long size = 0;
  const int status = tjCompress2(turbo.get(), image.samples.data(), image.width, 0, image.height,
                                 grey ? TJPF_GRAY : TJPF_RGB, &buffer, &size, subsampling, quality, TJFLAG_ACCURATEDCT);
  const std::unique_ptr<unsigned char, void (*)(unsigned char*)> owner(buffer, tjFree);
  if (status != 0) throw std::runtime_error(std::string("encode_jpeg: ") + tjGetErrorStr2(turbo.get()));
  return {buffer, buffer + size};
}

}  // namespace booth
