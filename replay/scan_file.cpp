#include "replay/scan_file.h"

#include <algorithm>
#include <array>
#include <bit>
#include <charconv>
#include <cmath>
#include <cstring>
#include <limits>
#include <optional>
#include <string_view>
#include <system_error>
#include <vector>

#include "replay/durable_folder.h"

namespace booth {
namespace {

constexpr uint64_t most_vertices = 10'000'000, most_triangles = 20'000'000;

Error fault(const std::string& name, const std::string& what) { return {ErrorCode::invalid_file, name + ": " + what}; }

/// Words of a line, as they come.
class Words {
 public:
  explicit Words(std::string_view line) : rest_(line) {}
  std::string_view next() {
    const size_t start = rest_.find_first_not_of(" \t\r");
    if (start == std::string_view::npos) return rest_ = {};
    rest_.remove_prefix(start);
    const std::string_view word = rest_.substr(0, rest_.find_first_of(" \t\r"));
    rest_.remove_prefix(word.size());
    return word;
  }

 private:
  std::string_view rest_;
};

template <class T>
std::optional<T> number(std::string_view word) {
  T value{};
  const auto [end, error] = std::from_chars(word.data(), word.data() + word.size(), value);
  if (error != std::errc{} || end != word.data() + word.size()) return std::nullopt;
  return value;
}

class Lines {
 public:
  explicit Lines(std::string_view text) : rest_(text) {}
  bool ended() const { return rest_.empty(); }
  std::string_view next() {
    ++number_;
    const size_t end = std::min(rest_.find('\n'), rest_.size());
    const std::string_view line = rest_.substr(0, end);
    rest_.remove_prefix(std::min(end + 1, rest_.size()));
    return line;
  }
  std::string_view rest() const { return rest_; }
  size_t number() const { return number_; }  ///< of the last line

 private:
  std::string_view rest_;
  size_t number_ = 0;
};

/// Adds a polygon as a fan. @return what is wrong with it, or nothing
std::optional<std::string> add_polygon(std::span<const int64_t> corners, Mesh* mesh) {
  const auto count = static_cast<int64_t>(mesh->positions.size());
  for (const int64_t corner : corners)
    if (corner < 0 || corner >= count)
      return "a face has the vertex " + std::to_string(corner) + ", which is not there";
  for (size_t k = 1; k + 1 < corners.size(); ++k) {
    const auto a = static_cast<uint32_t>(corners[0]), b = static_cast<uint32_t>(corners[k]),
               c = static_cast<uint32_t>(corners[k + 1]);
    if (a == b || b == c || c == a) continue;
    if (mesh->triangles.size() >= most_triangles) return "more than 20 million triangles";
    mesh->triangles.push_back({a, b, c});
  }
  return std::nullopt;
}

// --- PLY ---

enum class Encoding { ascii, little, big };

struct Property {
  char kind = 'f';  ///< i, u or f
  size_t bytes = 4;
  char count_kind = 0;  ///< of a list; 0: it is none
  size_t count_bytes = 0;
  std::string name;
};

struct Element {
  std::string name;
  uint64_t count = 0;
  std::vector<Property> properties;
};

struct Header {
  Encoding encoding = Encoding::ascii;
  std::vector<Element> elements;
  size_t size = 0;  ///< bytes
};

bool scalar_type(std::string_view word, char* kind, size_t* bytes) {
  struct Type {
    std::string_view name;
    char kind;
    size_t bytes;
  };
  constexpr std::array<Type, 16> types{{{"char", 'i', 1},
                                        {"int8", 'i', 1},
                                        {"uchar", 'u', 1},
                                        {"uint8", 'u', 1},
                                        {"short", 'i', 2},
                                        {"int16", 'i', 2},
                                        {"ushort", 'u', 2},
                                        {"uint16", 'u', 2},
                                        {"int", 'i', 4},
                                        {"int32", 'i', 4},
                                        {"uint", 'u', 4},
                                        {"uint32", 'u', 4},
                                        {"float", 'f', 4},
                                        {"float32", 'f', 4},
                                        {"double", 'f', 8},
                                        {"float64", 'f', 8}}};
  const auto found = std::find_if(types.begin(), types.end(), [&](const Type& type) { return type.name == word; });
  if (found == types.end()) return false;
  *kind = found->kind;
  *bytes = found->bytes;
  return true;
}

Result<Header> read_header(const std::string& name, std::string_view text) {
  Lines lines(text);
  Header header;
  bool has_format = false;
  if (Words(lines.next()).next() != "ply") return fault(name, "the first line is not \"ply\"");
  while (!lines.ended()) {
    const std::string line(lines.next());
    const auto wrong = [&] {
      return fault(name, "line " + std::to_string(lines.number()) + " of the header is \"" + line.substr(0, 60) +
                             "\", which is not understood");
    };
    Words words(line);
    const std::string_view key = words.next();
    if (key == "end_header") {
      if (!has_format) return fault(name, "the header has no format");
      header.size = text.size() - lines.rest().size();
      return header;
    }
    if (key == "comment" || key == "obj_info" || key.empty()) continue;
    if (key == "format") {
      const std::string_view word = words.next();
      if (word == "ascii")
        header.encoding = Encoding::ascii;
      else if (word == "binary_little_endian")
        header.encoding = Encoding::little;
      else if (word == "binary_big_endian")
        header.encoding = Encoding::big;
      else
        return wrong();
      has_format = true;
    } else if (key == "element") {
      Element element;
      element.name = words.next();
      const auto count = number<uint64_t>(words.next());
      if (!count) return wrong();
      element.count = *count;
      header.elements.push_back(std::move(element));
    } else if (key == "property" && !header.elements.empty()) {
      Property property;
      std::string_view type = words.next();
      if (type == "list") {
        if (!scalar_type(words.next(), &property.count_kind, &property.count_bytes) || property.count_kind == 'f')
          return wrong();
        type = words.next();
      }
      if (!scalar_type(type, &property.kind, &property.bytes)) return wrong();
      property.name = words.next();
      header.elements.back().properties.push_back(std::move(property));
    } else {
      return wrong();
    }
  }
  return fault(name, "the header has no end");
}

/// The values behind the header, one after the other.
class Values {
 public:
  Values(std::span<const uint8_t> bytes, Encoding encoding) : rest_(bytes), encoding_(encoding) {}
  size_t left() const { return rest_.size(); }

  std::optional<double> next(char kind, size_t bytes) {
    if (encoding_ == Encoding::ascii) return next_word();
    if (rest_.size() < bytes) return std::nullopt;
    std::array<uint8_t, 8> raw{};
    std::copy_n(rest_.begin(), bytes, raw.begin());
    rest_ = rest_.subspan(bytes);
    const bool swap = (encoding_ == Encoding::big) != (std::endian::native == std::endian::big);
    if (swap) std::reverse(raw.begin(), raw.begin() + static_cast<std::ptrdiff_t>(bytes));
    if (kind == 'f') return bytes == 4 ? static_cast<double>(as<float>(raw)) : as<double>(raw);
    if (bytes == 1) return kind == 'i' ? as<int8_t>(raw) : as<uint8_t>(raw);
    if (bytes == 2) return kind == 'i' ? as<int16_t>(raw) : as<uint16_t>(raw);
    return kind == 'i' ? static_cast<double>(as<int32_t>(raw)) : static_cast<double>(as<uint32_t>(raw));
  }

 private:
  template <class T>
  static T as(const std::array<uint8_t, 8>& raw) {
    T value;
    std::memcpy(&value, raw.data(), sizeof value);
    return value;
  }
  std::optional<double> next_word() {
    const auto blank = [](uint8_t c) { return c == ' ' || c == '\t' || c == '\r' || c == '\n'; };
    const auto start = std::find_if_not(rest_.begin(), rest_.end(), blank);
    const auto end = std::find_if(start, rest_.end(), blank);
    const std::string_view word(reinterpret_cast<const char*>(rest_.data()) + (start - rest_.begin()),
                                static_cast<size_t>(end - start));
    rest_ = rest_.subspan(static_cast<size_t>(end - rest_.begin()));
    return number<double>(word);
  }

  std::span<const uint8_t> rest_;
  Encoding encoding_;
};

Result<Mesh> parse_ply(const std::string& name, std::span<const uint8_t> bytes) {
  const auto header = read_header(name, {reinterpret_cast<const char*>(bytes.data()), bytes.size()});
  if (!header) return header.error();
  Values values(bytes.subspan(header->size), header->encoding);
  Mesh mesh;
  std::vector<int64_t> corners;
  for (const Element& element : header->elements) {
    const bool vertices = element.name == "vertex", faces = element.name == "face";
    if (vertices && (element.count > most_vertices || !mesh.positions.empty()))
      return fault(name, element.count > most_vertices ? "more than 10 million vertices" : "two elements \"vertex\"");
    // Every value takes a byte at least: a count that the file is too short for ends here.
    if (element.count > 0 && element.properties.empty())
      return fault(name, "the element \"" + element.name.substr(0, 40) + "\" has no property");
    if (element.count > values.left())
      return fault(name, "the file is too short for its " + std::to_string(element.count) + " of \"" +
                             element.name.substr(0, 40) + "\"");
    for (uint64_t i = 0; i < element.count; ++i) {
      std::array<double, 3> position;
      position.fill(std::numeric_limits<double>::quiet_NaN());
      for (const Property& property : element.properties) {
        uint64_t count = 1;
        if (property.count_kind != 0) {
          const auto listed = values.next(property.count_kind, property.count_bytes);
          if (!listed || !(*listed >= 0) || *listed > static_cast<double>(values.left()))
            return fault(name, "the file ends within \"" + element.name.substr(0, 40) + "\" " + std::to_string(i));
          count = static_cast<uint64_t>(*listed);
        }
        const bool polygon =
            faces && property.count_kind != 0 && (property.name == "vertex_indices" || property.name == "vertex_index");
        corners.clear();
        for (uint64_t k = 0; k < count; ++k) {
          const auto value = values.next(property.kind, property.bytes);
          if (!value)
            return fault(name, "the file ends, or holds no number, within \"" + element.name.substr(0, 40) + "\" " +
                                   std::to_string(i));
          constexpr double largest_index = 4e9;
          if (polygon) corners.push_back(std::abs(*value) < largest_index ? static_cast<int64_t>(*value) : -1);
          if (vertices && property.count_kind == 0 && property.name.size() == 1 && property.name[0] >= 'x' &&
              property.name[0] <= 'z')
            position[static_cast<size_t>(property.name[0] - 'x')] = *value;
        }
        if (polygon)
          if (const auto wrong = add_polygon(corners, &mesh)) return fault(name, *wrong);
      }
      if (!vertices) continue;
      const Eigen::Vector3f p = Eigen::Vector3d(position[0], position[1], position[2]).cast<float>();
      if (!p.allFinite()) return fault(name, "vertex " + std::to_string(i) + " has no finite position");
      mesh.positions.push_back(p);
    }
  }
  return mesh;
}

// --- OBJ ---

Result<Mesh> parse_obj(const std::string& name, std::span<const uint8_t> bytes) {
  Lines lines({reinterpret_cast<const char*>(bytes.data()), bytes.size()});
  Mesh mesh;
  std::vector<int64_t> corners;
  while (!lines.ended()) {
    Words words(lines.next());
    const auto wrong = [&](const std::string& what) {
      return fault(name, "line " + std::to_string(lines.number()) + ": " + what);
    };
    const std::string_view key = words.next();
    if (key == "v") {
      Eigen::Vector3f p;
      for (int axis = 0; axis < 3; ++axis) {
        const auto value = number<double>(words.next());
        if (!value || !std::isfinite(static_cast<float>(*value))) return wrong("a vertex without a finite position");
        p[axis] = static_cast<float>(*value);
      }
      if (mesh.positions.size() >= most_vertices) return wrong("more than 10 million vertices");
      mesh.positions.push_back(p);
    } else if (key == "f") {
      corners.clear();
      for (std::string_view word = words.next(); !word.empty(); word = words.next()) {
        const auto index = number<int64_t>(word.substr(0, word.find('/')));
        if (!index || *index == 0) return wrong("a face with the vertex \"" + std::string(word.substr(0, 40)) + "\"");
        // Negative ones count back from the last vertex.
        corners.push_back(*index > 0 ? *index - 1 : static_cast<int64_t>(mesh.positions.size()) + *index);
      }
      if (corners.size() < 3) return wrong("a face with fewer than three vertices");
      if (const auto fault_of = add_polygon(corners, &mesh)) return wrong(*fault_of);
    }
  }
  return mesh;
}

}  // namespace

Result<Mesh> parse_scan_file(const std::string& name, std::span<const uint8_t> bytes) {
  auto mesh = name.ends_with(".obj") ? parse_obj(name, bytes) : parse_ply(name, bytes);
  if (mesh && mesh->positions.empty()) return fault(name, "it holds no vertex");
  return mesh;
}

Result<std::optional<ScanFile>> find_scan_file(const std::filesystem::path& recording) {
  constexpr size_t most_bytes = size_t{1} << 30;
  for (const char* name : {"face.ply", "face.obj"}) {
    std::error_code ignored;  // what cannot be looked at is not there; what cannot be read, read_file says
    if (!std::filesystem::exists(recording / name, ignored)) continue;
    const auto bytes = read_file(recording / name, most_bytes);
    if (!bytes) return bytes.error();
    auto mesh = parse_scan_file(name, *bytes);
    if (!mesh) return mesh.error();
    return std::optional(ScanFile{name, *std::move(mesh)});
  }
  return std::optional<ScanFile>();
}

}  // namespace booth
