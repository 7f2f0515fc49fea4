#include "pipeline/image/codec.h"

#include <png.h>
#include <turbojpeg.h>

#include <csetjmp>
#include <cstring>
#include <memory>
#include <stdexcept>

namespace booth {
namespace {

constexpr uint64_t most_pixels = 100'000'000;
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
  std::span<const uint8_t> rest;
  std::string fault;

  explicit PngReader(std::span<const uint8_t> bytes) : rest(bytes) {
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
  request_plain_samples(reader);
  header->channels = png_get_channels(reader.png, reader.info);
  if (image == nullptr) return true;
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
  Image image(header->width, header->height, header->channels);
  // TJFLAG_STOPONWARNING: a truncated file is a fault, not a picture whose lower part is grey.
  if (tjDecompress2(turbo.get(), bytes.data(), bytes.size(), image.samples.data(), image.width, 0, image.height,
                    image.channels == 1 ? TJPF_GRAY : TJPF_RGB, TJFLAG_STOPONWARNING | TJFLAG_ACCURATEDCT) != 0)
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

struct PngWriter {
  png_structp png = nullptr;
  png_infop info = nullptr;
  std::vector<uint8_t> bytes;

  PngWriter() {
    png = png_create_write_struct(PNG_LIBPNG_VER_STRING, nullptr, nullptr, nullptr);
    if (png != nullptr) info = png_create_info_struct(png);
    if (info == nullptr) throw std::bad_alloc();
    png_set_write_fn(png, this, write, nullptr);
  }
  ~PngWriter() { png_destroy_write_struct(&png, &info); }
  PngWriter(const PngWriter&) = delete;
  PngWriter& operator=(const PngWriter&) = delete;

  static void write(png_structp png, png_bytep from, size_t count) {
    auto* self = static_cast<PngWriter*>(png_get_io_ptr(png));
    self->bytes.insert(self->bytes.end(), from, from + count);
  }
};

int png_colour_type(int channels) {
  switch (channels) {
    case 1: return PNG_COLOR_TYPE_GRAY;
    case 3: return PNG_COLOR_TYPE_RGB;
    case 4: return PNG_COLOR_TYPE_RGBA;
    default: throw std::invalid_argument("encode_png: needs 1, 3 or 4 channels");
  }
}

bool write_png(PngWriter& writer, const Image& image, int colour_type, int level) {
  if (setjmp(png_jmpbuf(writer.png)) != 0) return false;
  png_set_IHDR(writer.png, writer.info, static_cast<png_uint_32>(image.width), static_cast<png_uint_32>(image.height),
               8, colour_type, PNG_INTERLACE_NONE, PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
  png_set_compression_level(writer.png, level);
  if (level <= 2) png_set_filter(writer.png, PNG_FILTER_TYPE_BASE, PNG_FILTER_SUB);
  png_write_info(writer.png, writer.info);
  for (int y = 0; y < image.height; ++y) png_write_row(writer.png, image.pixel(0, y));
  png_write_end(writer.png, nullptr);
  return true;
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
  PngWriter writer;
  if (!write_png(writer, image, png_colour_type(image.channels), level))
    throw std::runtime_error("encode_png: libpng refused the image");
  return std::move(writer.bytes);
}

std::vector<uint8_t> encode_jpeg(const Image& image, int quality) {
  if (image.channels != 1 && image.channels != 3) throw std::invalid_argument("encode_jpeg: needs 1 or 3 channels");
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
