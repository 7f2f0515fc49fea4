#include "pipeline/export/mesh_files.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <bit>
#include <cmath>

#include "pipeline/export/number_text.h"
#include "pipeline/export/seam_vertices.h"

namespace booth {
namespace {

/// Bytes that grow; numbers little-endian.
class Bytes {
 public:
  explicit Bytes(size_t expected) { bytes_.reserve(expected); }
  void put(const std::string& text) { bytes_.insert(bytes_.end(), text.begin(), text.end()); }
  void put(uint8_t byte) { bytes_.push_back(byte); }
  void put(uint16_t word) {
    for (int shift = 0; shift < 16; shift += 8) bytes_.push_back(static_cast<uint8_t>(word >> shift));
  }
  void put(uint32_t word) {
    for (int shift = 0; shift < 32; shift += 8) bytes_.push_back(static_cast<uint8_t>(word >> shift));
  }
  void put(const Eigen::Vector3f& v) {
    for (int axis = 0; axis < 3; ++axis) put(std::bit_cast<uint32_t>(v[axis]));
  }
  std::vector<uint8_t> take() { return std::move(bytes_); }

 private:
  std::vector<uint8_t> bytes_;
};

using Colour = std::array<uint8_t, 3>;

/// The texel under every vertex, from one of its corners.
std::vector<Colour> colours_at_vertices(const Avatar& avatar) {
  const Image& image = avatar.atlas.image;
  const auto texel = [](float share, int count) {
    return std::clamp(static_cast<int>(std::floor(share * static_cast<float>(count))), 0, count - 1);
  };
  std::vector<Colour> colours(avatar.mesh.positions.size(), Colour{0, 0, 0});
  for (size_t t = 0; t < avatar.mesh.triangles.size(); ++t)
    for (size_t corner = 0; corner < 3; ++corner) {
      const Eigen::Vector2f& uv = avatar.atlas.uv[t][corner];
      const uint8_t* p = image.pixel(texel(uv.x(), image.width), texel(uv.y(), image.height));
      colours[avatar.mesh.triangles[t][corner]] = {p[0], p[1], p[2]};
    }
  return colours;
}

}  // namespace

std::vector<uint8_t> write_stl(const Avatar& avatar) {
  constexpr size_t header_bytes = 80, triangle_bytes = 50;
  constexpr float mm_per_m = 1000;
  std::string header = "Avatar Booth, millimetres";  // may not begin with "solid", which marks the text variant
  header.resize(header_bytes, ' ');
  const Mesh& mesh = avatar.mesh;
  Bytes out(header_bytes + sizeof(uint32_t) + mesh.triangles.size() * triangle_bytes);
  out.put(header);
  out.put(static_cast<uint32_t>(mesh.triangles.size()));
  const auto for_printing = [](const Eigen::Vector3f& p) { return Eigen::Vector3f(p.x(), -p.z(), p.y()); };
  for (const auto& t : mesh.triangles) {
    std::array<Eigen::Vector3f, 3> p;
    for (size_t corner = 0; corner < 3; ++corner) p[corner] = mm_per_m * for_printing(mesh.positions[t[corner]]);
    out.put(Eigen::Vector3f((p[1] - p[0]).cross(p[2] - p[0]).stableNormalized()));
    for (const Eigen::Vector3f& corner : p) out.put(corner);
    out.put(uint16_t{0});
  }
  return out.take();
}

std::string write_obj(const Avatar& avatar, const std::string& material_file) {
  const SeamVertices split = split_at_seams(avatar);
  NumberText out;
  constexpr size_t vertex_bytes = 110, triangle_bytes = 60;
  out.reserve(avatar.mesh.positions.size() * vertex_bytes + avatar.mesh.triangles.size() * triangle_bytes);
  out << "# Avatar Booth: metres, +Y up\nmtllib " << material_file << "\no avatar\n";
  for (const Eigen::Vector3f& p : avatar.mesh.positions) out << "v " << p.x() << ' ' << p.y() << ' ' << p.z() << '\n';
  for (const Eigen::Vector2f& uv : split.uv) out << "vt " << uv.x() << ' ' << 1 - uv.y() << '\n';
  for (const Eigen::Vector3f& n : unit_normals(avatar.mesh))
    out << "vn " << n.x() << ' ' << n.y() << ' ' << n.z() << '\n';
  out << "usemtl avatar\n";
  for (size_t t = 0; t < avatar.mesh.triangles.size(); ++t) {
    out << 'f';
    for (size_t corner = 0; corner < 3; ++corner) {
      const uint32_t vertex = avatar.mesh.triangles[t][corner] + 1;  // counted from 1
      out << ' ' << vertex << '/' << split.triangles[t][corner] + 1 << '/' << vertex;
    }
    out << '\n';
  }
  return out.take();
}

std::string write_obj_material(const std::string& texture_file) {
  return "newmtl avatar\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd " + texture_file + "\n";
}

std::vector<uint8_t> write_ply(const Avatar& avatar) {
  const Mesh& mesh = avatar.mesh;
  const std::vector<Eigen::Vector3f> normals = unit_normals(mesh);
  const std::vector<Colour> colours = colours_at_vertices(avatar);
  std::string header = "ply\nformat binary_little_endian 1.0\ncomment Avatar Booth: metres, +Y up\n";
  header += "element vertex " + std::to_string(mesh.positions.size()) + "\n";
  for (const char* name : {"x", "y", "z", "nx", "ny", "nz"}) header += std::string("property float ") + name + "\n";
  for (const char* name : {"red", "green", "blue"}) header += std::string("property uchar ") + name + "\n";
  header += "element face " + std::to_string(mesh.triangles.size()) + "\n";
  header += "property list uchar uint vertex_indices\nend_header\n";
  constexpr size_t vertex_bytes = 27, triangle_bytes = 13;
  Bytes out(header.size() + mesh.positions.size() * vertex_bytes + mesh.triangles.size() * triangle_bytes);
  out.put(header);
  for (size_t v = 0; v < mesh.positions.size(); ++v) {
    out.put(mesh.positions[v]);
    out.put(normals[v]);
    for (const uint8_t channel : colours[v]) out.put(channel);
  }
  for (const auto& t : mesh.triangles) {
    out.put(uint8_t{3});
    for (const uint32_t vertex : t) out.put(vertex);
  }
  return out.take();
}

}  // namespace booth
