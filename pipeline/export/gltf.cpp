#include "pipeline/export/gltf.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cstring>
#include <limits>
#include <nlohmann/json.hpp>

#include "pipeline/export/seam_vertices.h"
#include "pipeline/export/skin_tables.h"

namespace booth {
namespace {

using Json = nlohmann::ordered_json;

// Numbers of the specification.
constexpr int byte_type = 5121, short_type = 5123, int_type = 5125, float_type = 5126;  // unsigned, but for float
constexpr int vertex_target = 34962, index_target = 34963;
constexpr int linear_filter = 9729, linear_mipmap_filter = 9987, clamp_to_edge = 33071;
constexpr size_t alignment = 4;

/// The document and its one buffer while they grow together. Chunks and accessors begin at multiples of four bytes.
class Document {
 public:
  Json json;

  /// Appends bytes as a new buffer view; `target` 0 for data that is not for vertices.
  size_t add_view(std::span<const uint8_t> bytes, int target) {
    buffer_.resize((buffer_.size() + alignment - 1) / alignment * alignment, 0);
    Json view = {{"buffer", 0}, {"byteOffset", buffer_.size()}, {"byteLength", bytes.size()}};
    if (target != 0) view["target"] = target;
    buffer_.insert(buffer_.end(), bytes.begin(), bytes.end());
    return append("bufferViews", std::move(view));
  }

  /// Appends an array of items of the kind `type` ("VEC3") with components of `component_type`.
  template <class Item>
  size_t add_accessor(const std::vector<Item>& items, int component_type, const char* type, int target) {
    const std::span<const uint8_t> bytes(reinterpret_cast<const uint8_t*>(items.data()), items.size() * sizeof(Item));
    const size_t view = add_view(bytes, target);
    return append("accessors",
                  {{"bufferView", view}, {"componentType", component_type}, {"count", items.size()}, {"type", type}});
  }

  /// Appends to an array of the document's root and returns the new item's index.
  size_t append(const char* array, Json item) {
    json[array].push_back(std::move(item));
    return json[array].size() - 1;
  }

  /// Header, JSON chunk, binary chunk. Little-endian, as the processors are that this is built for.
  std::vector<uint8_t> to_glb() {
    buffer_.resize((buffer_.size() + alignment - 1) / alignment * alignment, 0);
    json["buffers"] = Json::array({{{"byteLength", buffer_.size()}}});
    std::string text = json.dump(-1, ' ', false, Json::error_handler_t::replace);
    text.resize((text.size() + alignment - 1) / alignment * alignment, ' ');
    constexpr uint32_t magic = 0x46546C67, version = 2, json_chunk = 0x4E4F534A, binary_chunk = 0x004E4942;
    constexpr size_t header_bytes = 12, chunk_header_bytes = 8;
    const size_t length = header_bytes + chunk_header_bytes + text.size() + chunk_header_bytes + buffer_.size();
    std::vector<uint8_t> glb;
    glb.reserve(length);
    const auto put = [&](uint32_t word) {
      for (int shift = 0; shift < 32; shift += 8) glb.push_back(static_cast<uint8_t>(word >> shift));
    };
    put(magic), put(version), put(static_cast<uint32_t>(length));
    put(static_cast<uint32_t>(text.size())), put(json_chunk);
    glb.insert(glb.end(), text.begin(), text.end());
    put(static_cast<uint32_t>(buffer_.size())), put(binary_chunk);
    glb.insert(glb.end(), buffer_.begin(), buffer_.end());
    return glb;
  }

 private:
  std::vector<uint8_t> buffer_;
};

/// The values of `per_vertex` for every copy of a mesh vertex.
template <class Item>
std::vector<Item> spread(const std::vector<Item>& per_vertex, const SeamVertices& split) {
  std::vector<Item> items;
  items.reserve(split.mesh_vertex.size());
  for (const uint32_t vertex : split.mesh_vertex) items.push_back(per_vertex[vertex]);
  return items;
}

Json to_json(const Eigen::Vector3f& v) { return {v.x(), v.y(), v.z()}; }

size_t add_positions(Document& document, const Mesh& mesh, const SeamVertices& split) {
  const std::vector<Eigen::Vector3f> positions = spread(mesh.positions, split);
  Eigen::AlignedBox3f box;
  for (const Eigen::Vector3f& p : positions) box.extend(p);
  const size_t accessor = document.add_accessor(positions, float_type, "VEC3", vertex_target);
  document.json["accessors"][accessor]["min"] = to_json(box.min());
  document.json["accessors"][accessor]["max"] = to_json(box.max());
  return accessor;
}

/// An accessor of vectors that are zero but at `at`, ascending and not empty.
template <class Index>
size_t add_sparse_as(Document& document, size_t count, const std::vector<uint32_t>& at,
                     const std::vector<Eigen::Vector3f>& values, int index_type) {
  const std::vector<Index> indices(at.begin(), at.end());
  const auto bytes = [](const auto& items) {
    return std::span<const uint8_t>(reinterpret_cast<const uint8_t*>(items.data()), items.size() * sizeof(items[0]));
  };
  const size_t index_view = document.add_view(bytes(indices), 0), value_view = document.add_view(bytes(values), 0);
  Eigen::AlignedBox3f box;
  for (const Eigen::Vector3f& v : values) box.extend(v);
  if (values.size() < count) box.extend(Eigen::Vector3f::Zero());
  return document.append("accessors", {{"componentType", float_type},
                                       {"count", count},
                                       {"type", "VEC3"},
                                       {"min", to_json(box.min())},
                                       {"max", to_json(box.max())},
                                       {"sparse",
                                        {{"count", at.size()},
                                         {"indices", {{"bufferView", index_view}, {"componentType", index_type}}},
                                         {"values", {{"bufferView", value_view}}}}}});
}

size_t add_sparse(Document& document, size_t count, const std::vector<uint32_t>& at,
                  const std::vector<Eigen::Vector3f>& values) {
  return count <= size_t{std::numeric_limits<uint16_t>::max()} + 1
             ? add_sparse_as<uint16_t>(document, count, at, values, short_type)
             : add_sparse_as<uint32_t>(document, count, at, values, int_type);
}

/// A morph target's differences of positions and normals.
Json add_morph(Document& document, const Avatar& avatar, const std::vector<Eigen::Vector3f>& normals,
               const SeamVertices& split, const MorphTarget& morph) {
  Mesh moved = avatar.mesh;
  for (size_t i = 0; i < morph.vertices.size(); ++i) moved.positions[morph.vertices[i]] += morph.offsets[i];
  const std::vector<Eigen::Vector3f> moved_normals = unit_normals(moved);
  // A sparse accessor has an entry at least.
  std::vector<uint32_t> position_at, normal_at;
  std::vector<Eigen::Vector3f> position_by, normal_by;
  for (uint32_t i = 0; i < split.mesh_vertex.size(); ++i) {
    const uint32_t v = split.mesh_vertex[i];
    const bool last = i + 1 == split.mesh_vertex.size();
    const auto at = std::lower_bound(morph.vertices.begin(), morph.vertices.end(), v);
    const bool moves = at != morph.vertices.end() && *at == v;
    if (moves || (last && position_at.empty())) {
      position_at.push_back(i);
      position_by.push_back(moves ? morph.offsets[static_cast<size_t>(at - morph.vertices.begin())]
                                  : Eigen::Vector3f(Eigen::Vector3f::Zero()));
    }
    const Eigen::Vector3f turned = moved_normals[v] - normals[v];
    constexpr float visible = 1e-3F;
    if (turned.norm() > visible || (last && normal_at.empty())) {
      normal_at.push_back(i);
      normal_by.push_back(turned);
    }
  }
  const size_t count = split.mesh_vertex.size();
  return {{"POSITION", add_sparse(document, count, position_at, position_by)},
          {"NORMAL", add_sparse(document, count, normal_at, normal_by)}};
}

template <class Index>
size_t add_indices_as(Document& document, const SeamVertices& split, int component_type) {
  std::vector<Index> indices;
  indices.reserve(split.triangles.size() * 3);
  for (const auto& triangle : split.triangles)
    for (const uint32_t vertex : triangle) indices.push_back(static_cast<Index>(vertex));
  return document.add_accessor(indices, component_type, "SCALAR", index_target);
}

/// The smallest type that holds the indices; its largest number is not an index, by the specification.
size_t add_indices(Document& document, const SeamVertices& split) {
  return split.mesh_vertex.size() <= std::numeric_limits<uint16_t>::max()
             ? add_indices_as<uint16_t>(document, split, short_type)
             : add_indices_as<uint32_t>(document, split, int_type);
}

template <class Index>
size_t add_joints_as(Document& document, const SkinTables& tables, const SeamVertices& split, int component_type) {
  std::vector<std::array<Index, 4>> joints;
  joints.reserve(split.mesh_vertex.size());
  for (const uint32_t vertex : split.mesh_vertex) {
    auto& entry = joints.emplace_back();
    for (size_t k = 0; k < 4; ++k) entry[k] = static_cast<Index>(tables.influences[vertex].joint[k]);
  }
  return document.add_accessor(joints, component_type, "VEC4", vertex_target);
}

size_t add_weights(Document& document, const SkinTables& tables, const SeamVertices& split) {
  std::vector<std::array<float, 4>> weights;
  weights.reserve(split.mesh_vertex.size());
  for (const uint32_t vertex : split.mesh_vertex) {
    auto& entry = weights.emplace_back();
    for (size_t k = 0; k < 4; ++k)
      entry[k] =
          static_cast<float>(static_cast<double>(tables.influences[vertex].weight[k]) / WholeInfluences::weight_unit);
  }
  return document.add_accessor(weights, float_type, "VEC4", vertex_target);
}

/// The material: matt, in the colours of the texture.
size_t add_material(Document& document, std::span<const uint8_t> encoded, ImageFormat format) {
  const size_t view = document.add_view(encoded, 0);
  const char* mime_type = format == ImageFormat::png ? "image/png" : "image/jpeg";
  const size_t image = document.append("images", {{"name", "atlas"}, {"bufferView", view}, {"mimeType", mime_type}});
  const size_t sampler = document.append("samplers", {{"magFilter", linear_filter},
                                                      {"minFilter", linear_mipmap_filter},
                                                      {"wrapS", clamp_to_edge},
                                                      {"wrapT", clamp_to_edge}});
  const size_t texture = document.append("textures", {{"sampler", sampler}, {"source", image}});
  const Json surface = {{"baseColorTexture", {{"index", texture}}}, {"metallicFactor", 0.0}, {"roughnessFactor", 1.0}};
  return document.append("materials", {{"name", "avatar"}, {"pbrMetallicRoughness", surface}});
}

/// A node for every joint, moved and turned so that each can be animated. Returns the node of joint 0.
size_t add_joint_nodes(Document& document, const Skeleton& skeleton) {
  const size_t first = document.json["nodes"].size();
  for (const Joint& joint : skeleton.joints) {
    const Eigen::Vector3f t = joint.parent_from_joint.translation().cast<float>();
    const Eigen::Quaternionf q = Eigen::Quaterniond(joint.parent_from_joint.linear()).normalized().cast<float>();
    const size_t node = document.append(
        "nodes", {{"name", joint.name}, {"translation", to_json(t)}, {"rotation", {q.x(), q.y(), q.z(), q.w()}}});
    if (joint.parent >= 0)
      document.json["nodes"][first + static_cast<size_t>(joint.parent)]["children"].push_back(node);
  }
  return first;
}

size_t add_skin(Document& document, const SkinTables& tables, size_t first_joint) {
  std::vector<Eigen::Matrix4f> matrices = tables.joint_from_world;  // column by column, as glTF and Eigen have them
  const size_t accessor = document.add_accessor(matrices, float_type, "MAT4", 0);
  Json joints = Json::array();
  for (size_t j = 0; j < matrices.size(); ++j) joints.push_back(first_joint + j);
  return document.append("skins", {{"inverseBindMatrices", accessor}, {"skeleton", first_joint}, {"joints", joints}});
}

/// The rotations of a track as x, y, z, w, each on the same half of the sphere as the one before.
std::vector<std::array<float, 4>> rotations_of(const JointTrack& track) {
  std::vector<std::array<float, 4>> rotations;
  Eigen::Quaterniond before = Eigen::Quaterniond::Identity();
  for (const Eigen::Isometry3d& pose : track.parent_from_joint) {
    Eigen::Quaterniond q = Eigen::Quaterniond(pose.linear()).normalized();
    if (q.dot(before) < 0) q.coeffs() = -q.coeffs();
    before = q;
    const Eigen::Quaternionf rounded = q.cast<float>();
    rotations.push_back({rounded.x(), rounded.y(), rounded.z(), rounded.w()});
  }
  return rotations;
}

void add_animation(Document& document, const AnimationClip& clip, size_t first_joint) {
  std::vector<float> times(clip.times_s.begin(), clip.times_s.end());
  const size_t input = document.add_accessor(times, float_type, "SCALAR", 0);
  document.json["accessors"][input]["min"] = {times.front()};
  document.json["accessors"][input]["max"] = {times.back()};
  Json samplers = Json::array(), channels = Json::array();
  const auto add_channel = [&](size_t joint, const char* path, size_t output) {
    channels.push_back({{"sampler", samplers.size()}, {"target", {{"node", first_joint + joint}, {"path", path}}}});
    samplers.push_back({{"input", input}, {"interpolation", "LINEAR"}, {"output", output}});
  };
  for (const JointTrack& track : clip.tracks) {
    add_channel(track.joint, "rotation", document.add_accessor(rotations_of(track), float_type, "VEC4", 0));
    const auto& poses = track.parent_from_joint;
    const bool moves = std::any_of(poses.begin(), poses.end(), [&](const Eigen::Isometry3d& pose) {
      return pose.translation() != poses.front().translation();
    });
    if (!moves) continue;
    std::vector<Eigen::Vector3f> places;
    for (const Eigen::Isometry3d& pose : poses) places.push_back(pose.translation().cast<float>());
    add_channel(track.joint, "translation", document.add_accessor(places, float_type, "VEC3", 0));
  }
  document.append("animations", {{"name", clip.name}, {"samplers", samplers}, {"channels", channels}});
}

}  // namespace

std::vector<uint8_t> write_glb(const Avatar& avatar, std::span<const AnimationClip> clips,
                               std::span<const uint8_t> texture, const GltfOptions& options) {
  const SeamVertices split = split_at_seams(avatar);
  Document document;
  document.json["asset"] = {{"version", "2.0"}, {"generator", options.generator}};
  document.json["scene"] = 0;

  const std::vector<Eigen::Vector3f> normals = unit_normals(avatar.mesh);
  Json attributes = {{"POSITION", add_positions(document, avatar.mesh, split)},
                     {"NORMAL", document.add_accessor(spread(normals, split), float_type, "VEC3", vertex_target)},
                     {"TEXCOORD_0", document.add_accessor(split.uv, float_type, "VEC2", vertex_target)}};
  Json body = {{"name", "avatar"}, {"mesh", 0}};
  Json roots = Json::array();
  if (const size_t joints = avatar.skeleton.joints.size(); joints > 0) {
    const SkinTables tables = make_skin_tables(avatar);
    attributes["JOINTS_0"] = joints <= size_t{std::numeric_limits<uint8_t>::max()} + 1
                                 ? add_joints_as<uint8_t>(document, tables, split, byte_type)
                                 : add_joints_as<uint16_t>(document, tables, split, short_type);
    attributes["WEIGHTS_0"] = add_weights(document, tables, split);
    const size_t root = add_joint_nodes(document, avatar.skeleton);
    roots.push_back(root);
    body["skin"] = add_skin(document, tables, root);
    for (const AnimationClip& clip : clips) add_animation(document, clip, root);
  }
  Json primitive = {{"attributes", attributes},
                    {"indices", add_indices(document, split)},
                    {"material", add_material(document, texture, options.texture_format)}};
  Json mesh = {{"name", "avatar"}};
  for (const MorphTarget& morph : avatar.morphs) {
    primitive["targets"].push_back(add_morph(document, avatar, normals, split, morph));
    mesh["weights"].push_back(0);
    mesh["extras"]["targetNames"].push_back(morph.name);  // where all importers look for them
  }
  mesh["primitives"] = Json::array({primitive});
  document.append("meshes", mesh);
  roots.push_back(document.append("nodes", body));
  document.append("scenes", {{"nodes", roots}});
  return document.to_glb();
}

}  // namespace booth
