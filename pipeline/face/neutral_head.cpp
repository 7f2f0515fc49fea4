#include "pipeline/face/neutral_head.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <nlohmann/json.hpp>
#include <set>
#include <sstream>
#include <stdexcept>
#include <utility>

// The files as the assembler put them into the program (neutral_head_data.S).
extern "C" {
extern const char booth_neutral_head_obj[], booth_neutral_head_obj_end[];
extern const char booth_neutral_head_landmarks[], booth_neutral_head_landmarks_end[];
extern const char booth_neutral_head_regions[], booth_neutral_head_regions_end[];
extern const char booth_neutral_head_symmetry[], booth_neutral_head_symmetry_end[];
extern const char booth_neutral_head_expressions[], booth_neutral_head_expressions_end[];
}

namespace booth {
namespace {

using Json = nlohmann::json;

/// What is wrong with a file; leaves parse_neutral_head as its error.
struct Fault : std::runtime_error {
  using std::runtime_error::runtime_error;
};

std::string_view between(const char* begin, const char* end) { return {begin, static_cast<size_t>(end - begin)}; }

/// A value of a JSON file that knows where it is, so that every fault names its place.
class Node {
 public:
  Node(const Json& json, std::string place) : json_(json), place_(std::move(place)) {}

  [[noreturn]] void fail(const std::string& expected) const { throw Fault(place_ + ": expected " + expected); }

  Node operator[](const char* key) const {
    if (!json_.is_object() || !json_.contains(key)) fail("an object with \"" + std::string(key) + "\"");
    return {json_[key], place_ + (place_.ends_with(':') ? " " : ".") + key};
  }
  Node operator[](size_t index) const { return {json_[index], place_ + "[" + std::to_string(index) + "]"}; }
  size_t size() const {
    if (!json_.is_array()) fail("an array");
    return json_.size();
  }
  size_t size(size_t expected) const {
    if (size() != expected) fail(std::to_string(expected) + " entries, not " + std::to_string(size()));
    return expected;
  }
  uint32_t below(size_t limit) const {
    if (!json_.is_number_integer() || json_ < 0 || json_ >= limit) {
      fail("a whole number below " + std::to_string(limit) + ", not " + json_.dump());
    }
    return json_.get<uint32_t>();
  }
  bool flag() const {
    if (!json_.is_boolean()) fail("true or false");
    return json_.get<bool>();
  }
  Eigen::Vector3f vector() const {
    size(3);
    Eigen::Vector3f v;
    for (size_t axis = 0; axis < 3; ++axis) {
      if (!json_[axis].is_number()) fail("three numbers");
      v[static_cast<Eigen::Index>(axis)] = json_[axis].get<float>();
    }
    if (!v.allFinite()) fail("three finite numbers");
    return v;
  }
  std::string text() const {
    if (!json_.is_string()) fail("a text");
    return json_.get<std::string>();
  }
  /// Different whole numbers below `limit`.
  std::vector<uint32_t> indices(size_t limit) const {
    std::vector<uint32_t> list(size());
    for (size_t i = 0; i < list.size(); ++i) list[i] = (*this)[i].below(limit);
    std::vector<uint32_t> sorted = list;
    std::sort(sorted.begin(), sorted.end());
    if (std::adjacent_find(sorted.begin(), sorted.end()) != sorted.end()) fail("no number twice");
    return list;
  }
  template <class Visit>
  void for_each_member(Visit&& visit) const {
    if (!json_.is_object()) fail("an object");
    for (const auto& [key, value] : json_.items()) visit(key, Node(value, place_ + "." + key));
  }

 private:
  const Json& json_;
  std::string place_;
};

Json parse_json(std::string_view text, const char* file) {
  Json json = Json::parse(text, nullptr, /*allow_exceptions=*/false);
  if (json.is_discarded()) throw Fault(std::string(file) + ": not JSON");
  return json;
}

Mesh parse_obj(std::string_view text) {
  Mesh mesh;
  std::istringstream lines{std::string(text)};
  std::string line;
  for (size_t number = 1; std::getline(lines, line); ++number) {
    const auto fail = [&](const char* expected) {
      throw Fault("head.obj: line " + std::to_string(number) + ": expected " + expected);
    };
    const char *at = line.data(), *const end = line.data() + line.size();
    const auto skip_blanks = [&] {
      while (at != end && (*at == ' ' || *at == '\t' || *at == '\r')) ++at;
    };
    const auto read = [&](auto* value) {
      skip_blanks();
      const auto [next, fault] = std::from_chars(at, end, *value);
      at = next;
      return fault == std::errc{};
    };
    if (line.starts_with("v ")) {
      at += 2;
      Eigen::Vector3f p;
      if (!read(&p.x()) || !read(&p.y()) || !read(&p.z())) fail("three numbers after v");
      mesh.positions.push_back(p);
    } else if (line.starts_with("f ")) {
      at += 2;
      std::array<uint32_t, 3> triangle{};
      for (uint32_t& corner : triangle) {
        if (!read(&corner) || corner == 0) fail("three vertex numbers from 1 after f");
        --corner;
      }
      mesh.triangles.push_back(triangle);
    } else {
      skip_blanks();
      if (at != end && *at != '#' && *at != 'o') fail("v, f, o or a comment");
      continue;
    }
    skip_blanks();
    if (at != end) fail("nothing after three values");
  }
  if (mesh.triangles.empty()) throw Fault("head.obj: expected triangles");
  if (const auto checked = check(mesh); !checked) throw Fault("head.obj: " + checked.error().message);
  const MeshTopology found = topology(mesh);
  if (found.nonmanifold_edges + found.inconsistent_edges + found.nonmanifold_vertices + found.unreferenced_vertices >
          0 ||
      found.components != 1 || found.euler_number != 1 || found.boundary_edges == 0)
    throw Fault("head.obj: expected one manifold disk, open at the neck alone");
  return mesh;
}

void read_landmarks(const Json& json, NeutralHead* head) {
  const Node list = Node(json, "landmarks.json:")["landmarks"];
  list.size(NeutralHead::landmark_count);
  for (size_t i = 0; i < NeutralHead::landmark_count; ++i) {
    const Node entry = list[i];
    if (entry["index"].below(NeutralHead::landmark_count) != i) entry["index"].fail(std::to_string(i));
    HeadLandmark& landmark = head->landmarks[i];
    landmark.triangle = entry["triangle"].below(head->mesh.triangles.size());
    landmark.weights = entry["weights"].vector();
    constexpr float rounding = 1e-4F;
    if (landmark.weights.minCoeff() < -rounding || std::abs(landmark.weights.sum() - 1) > rounding)
      entry["weights"].fail("three weights of 0 … 1 with sum 1");
    landmark.mirror = entry["mirror"].below(NeutralHead::landmark_count);
    landmark.contour = entry["contour"].flag();
    constexpr float same_place_m = 1e-4F;
    if ((head->landmark(i, head->mesh.positions) - entry["position"].vector()).norm() > same_place_m)
      entry["position"].fail("the place in the triangle that the weights give");
  }
  for (size_t i = 0; i < NeutralHead::landmark_count; ++i)
    if (head->landmarks[head->landmarks[i].mirror].mirror != i) list[i]["mirror"].fail("a landmark that mirrors back");
}

void read_symmetry(const Json& json, NeutralHead* head) {
  const Node list = Node(json, "symmetry.json:")["mirror"];
  const size_t vertices = list.size(head->mesh.positions.size());
  head->mirror.resize(vertices);
  for (size_t v = 0; v < vertices; ++v) head->mirror[v] = list[v].below(vertices);
  for (size_t v = 0; v < vertices; ++v)
    if (head->mirror[head->mirror[v]] != v) list[v].fail("a vertex that mirrors back");
}

void read_regions(const Json& json, NeutralHead* head) {
  const Node file(json, "regions.json:");
  const size_t vertices = head->mesh.positions.size();
  static constexpr std::array<std::pair<std::string_view, HeadPart>, 7> part_names{{{"face", HeadPart::face},
                                                                                    {"eye", HeadPart::eye},
                                                                                    {"lips", HeadPart::lips},
                                                                                    {"nose", HeadPart::nose},
                                                                                    {"ear", HeadPart::ear},
                                                                                    {"scalp", HeadPart::scalp},
                                                                                    {"neck", HeadPart::neck}}};
  const Node labels = file["labels"];
  std::vector<HeadPart> parts;
  for (size_t i = 0; i < labels.size(); ++i) {
    const auto* known = std::find_if(part_names.begin(), part_names.end(),
                                     [name = labels[i].text()](const auto& entry) { return entry.first == name; });
    if (known == part_names.end()) labels[i].fail("face, eye, lips, nose, ear, scalp or neck");
    parts.push_back(known->second);
  }
  const Node label_of = file["vertex_label"];
  label_of.size(vertices);
  for (size_t v = 0; v < vertices; ++v) head->part.push_back(parts[label_of[v].below(parts.size())]);

  head->face_front.assign(vertices, 0);
  for (const uint32_t v : file["face_front"].indices(vertices)) head->face_front[v] = 1;
  head->eyeball.assign(vertices, 0);
  for (const char* side : {"eyeball_left", "eyeball_right"})
    for (const uint32_t v : file[side].indices(vertices)) head->eyeball[v] = 1;
  const Node loop = file["face_front_loop"];
  head->face_front_loop = loop.indices(vertices);
  std::set<std::pair<uint32_t, uint32_t>> edges;
  for (const auto& corner : head->mesh.triangles)
    for (size_t k = 0; k < 3; ++k) edges.insert(std::minmax(corner[k], corner[(k + 1) % 3]));
  const size_t border = head->face_front_loop.size();
  for (size_t i = 0; i < border; ++i) {
    const uint32_t from = head->face_front_loop[i], to = head->face_front_loop[(i + 1) % border];
    if (!head->face_front[from]) loop[i].fail("a vertex of face_front");
    if (!edges.contains(std::minmax(from, to))) loop[i].fail("a vertex with an edge to the next one");
  }
}

void read_expressions(const Json& json, NeutralHead* head) {
  const Node shapes = Node(json, "expressions.json:")["shapes"];
  shapes.for_each_member([&](const std::string& name, const Node& shape) {
    Expression expression{name, shape["vertices"].indices(head->mesh.positions.size()), {}};
    if (!std::is_sorted(expression.vertices.begin(), expression.vertices.end()))
      shape["vertices"].fail("ascending numbers");
    const Node offsets = shape["offsets"];
    offsets.size(expression.vertices.size());
    for (size_t i = 0; i < expression.vertices.size(); ++i) expression.offsets.push_back(offsets[i].vector());
    head->expressions.push_back(std::move(expression));
  });
}

}  // namespace

NeutralHeadFiles built_in_neutral_head() {
  return {.mesh = between(booth_neutral_head_obj, booth_neutral_head_obj_end),
          .landmarks = between(booth_neutral_head_landmarks, booth_neutral_head_landmarks_end),
          .regions = between(booth_neutral_head_regions, booth_neutral_head_regions_end),
          .symmetry = between(booth_neutral_head_symmetry, booth_neutral_head_symmetry_end),
          .expressions = between(booth_neutral_head_expressions, booth_neutral_head_expressions_end)};
}

Result<NeutralHead> parse_neutral_head(const NeutralHeadFiles& files) {
  try {
    NeutralHead head;
    head.mesh = parse_obj(files.mesh);
    read_landmarks(parse_json(files.landmarks, "landmarks.json"), &head);
    read_symmetry(parse_json(files.symmetry, "symmetry.json"), &head);
    read_regions(parse_json(files.regions, "regions.json"), &head);
    read_expressions(parse_json(files.expressions, "expressions.json"), &head);
    return head;
  } catch (const Fault& fault) {
    return Error{ErrorCode::invalid_file, std::string("neutral head: ") + fault.what()};
  }
}

}  // namespace booth
