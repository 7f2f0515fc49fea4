#include "pipeline/export/collada.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <set>
#include <string_view>
#include <vector>

#include "pipeline/export/number_text.h"
#include "pipeline/export/seam_vertices.h"
#include "pipeline/export/skin_tables.h"

namespace booth {
namespace {

/// Text for an element or a quoted attribute. Control characters, which XML 1.0 cannot hold, become U+FFFD.
std::string escaped(std::string_view text) {
  std::string result;
  for (const char c : text) {
    switch (c) {
      case '&': result += "&amp;"; break;
      case '<': result += "&lt;"; break;
      case '>': result += "&gt;"; break;
      case '"': result += "&quot;"; break;
      case '\'': result += "&apos;"; break;
      default:
        if (static_cast<unsigned char>(c) < ' ')
          result += "\xef\xbf\xbd";
        else
          result += c;
    }
  }
  return result;
}

bool is_letter(char c) { return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z'); }
bool is_letter_or_digit(char c) { return is_letter(c) || (c >= '0' && c <= '9'); }

/// A relative path as a URI (RFC 3986): what is not unreserved is written as %XX.
std::string to_uri(std::string_view path) {
  constexpr std::string_view unreserved = "-._~/", digits = "0123456789ABCDEF";
  std::string uri;
  for (const char c : path) {
    if (is_letter_or_digit(c) || unreserved.find(c) != std::string_view::npos) {
      uri += c;
    } else {
      const auto byte = static_cast<unsigned char>(c);
      uri += '%';
      uri += digits[byte >> 4];
      uri += digits[byte & 15];
    }
  }
  return uri;
}

// Ids of the document all begin like this; readers show them to people as the names of things.
constexpr std::string_view own_prefix = "avatar";
constexpr std::string_view geometry_id = "avatar-mesh", controller_id = "avatar-skin", material_id = "avatar-material",
                           effect_id = "avatar-effect", image_id = "avatar-texture", scene_id = "avatar-scene",
                           node_id = "avatar";

/// What may stand in an XML name after its first letter.
std::string name_characters(std::string_view text) {
  std::string name;
  for (const char c : text) name += is_letter_or_digit(c) || c == '-' || c == '.' ? c : '_';
  return name;
}

/// The name with a number behind it where it is taken; then it is, too.
std::string unique_id(const std::string& name, std::set<std::string>& taken) {
  std::string id = name;
  for (int copy = 2; !taken.insert(id).second; ++copy) {
    id = name;
    id += '_';
    id += std::to_string(copy);
  }
  return id;
}

/// An id for every joint: its name, made an XML name where it is none, and unique in the document.
std::vector<std::string> joint_ids(const Skeleton& skeleton) {
  std::set<std::string> taken;
  std::vector<std::string> ids;
  for (const Joint& joint : skeleton.joints) {
    const char first = joint.name.front();
    const bool usable = (is_letter(first) || first == '_') && !joint.name.starts_with(own_prefix);
    std::string name(usable ? "" : "_");
    name += name_characters(joint.name);
    ids.push_back(unique_id(name, taken));
  }
  return ids;
}

/// An id for the shape of every morph target.
std::vector<std::string> shape_ids(std::span<const MorphTarget> morphs) {
  std::set<std::string> taken;
  std::vector<std::string> ids;
  for (const MorphTarget& morph : morphs)
    ids.push_back(unique_id("avatar-shape-" + name_characters(morph.name), taken));
  return ids;
}

/// Normals to a ten-thousandth: a hundredth of a degree, at half the text.
float rounded_normal(float component) {
  constexpr float steps = 10'000;
  return std::round(component * steps) / steps;
}

/// `<source>` of `count` numbers, `params` of them an item, named by letters: "XYZ".
template <class WriteNumbers>
void write_source(NumberText& out, std::string_view id, size_t items, std::string_view params,
                  const WriteNumbers& numbers) {
  out << "      <source id=\"" << id << "\">\n        <float_array id=\"" << id << "-array\" count=\""
      << items * params.size() << "\">";
  numbers();
  out << "</float_array>\n        <technique_common><accessor source=\"#" << id << "-array\" count=\"" << items
      << "\" stride=\"" << params.size() << "\">";
  for (const char param : params) out << "<param name=\"" << param << "\" type=\"float\"/>";
  out << "</accessor></technique_common>\n      </source>\n";
}

void write_header(NumberText& out, const ColladaOptions& options) {
  out << R"(<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset>
    <contributor><authoring_tool>)"
      << escaped(options.authoring_tool) << "</authoring_tool></contributor>\n    <created>" << escaped(options.created)
      << "</created>\n    <modified>" << escaped(options.created) << R"(</modified>
    <unit name="meter" meter="1"/>
    <up_axis>Y_UP</up_axis>
  </asset>
)";
}

/// Image, effect and material: matt, in the colours of the texture.
void write_material(NumberText& out, const ColladaOptions& options) {
  out << "  <library_images>\n    <image id=\"" << image_id << "\" name=\"" << image_id << "\"><init_from>"
      << to_uri(options.texture_file) << "</init_from></image>\n  </library_images>\n";
  out << "  <library_effects>\n    <effect id=\"" << effect_id << "\">\n      <profile_COMMON>\n"
      << "        <newparam sid=\"avatar-surface\"><surface type=\"2D\"><init_from>" << image_id
      << "</init_from></surface></newparam>\n"
      << "        <newparam sid=\"avatar-sampler\"><sampler2D><source>avatar-surface</source>"
      << "<minfilter>LINEAR_MIPMAP_LINEAR</minfilter><magfilter>LINEAR</magfilter></sampler2D></newparam>\n"
      << "        <technique sid=\"common\"><lambert>\n"
      << "          <emission><color>0 0 0 1</color></emission>\n"
      << "          <diffuse><texture texture=\"avatar-sampler\" texcoord=\"UVMap\"/></diffuse>\n"
      << "          <index_of_refraction><float>1.45</float></index_of_refraction>\n"
      << "        </lambert></technique>\n      </profile_COMMON>\n    </effect>\n  </library_effects>\n";
  out << "  <library_materials>\n    <material id=\"" << material_id << "\" name=\"" << material_id
      << "\"><instance_effect url=\"#" << effect_id << "\"/></material>\n  </library_materials>\n";
}

void write_geometry(NumberText& out, const Avatar& avatar) {
  const SeamVertices split = split_at_seams(avatar);
  const std::vector<Eigen::Vector3f> normals = unit_normals(avatar.mesh);
  out << "    <geometry id=\"" << geometry_id << "\" name=\"" << geometry_id << "\"><mesh>\n";
  write_source(out, "avatar-positions", avatar.mesh.positions.size(), "XYZ", [&] {
    for (const Eigen::Vector3f& p : avatar.mesh.positions) out << p.x() << ' ' << p.y() << ' ' << p.z() << '\n';
  });
  write_source(out, "avatar-normals", normals.size(), "XYZ", [&] {
    for (const Eigen::Vector3f& n : normals)
      out << rounded_normal(n.x()) << ' ' << rounded_normal(n.y()) << ' ' << rounded_normal(n.z()) << '\n';
  });
  write_source(out, "avatar-uvs", split.uv.size(), "ST", [&] {
    for (const Eigen::Vector2f& uv : split.uv) out << uv.x() << ' ' << 1 - uv.y() << '\n';
  });
  out << R"(      <vertices id="avatar-vertices"><input semantic="POSITION" source="#avatar-positions"/></vertices>
      <triangles material="avatar" count=")"
      << avatar.mesh.triangles.size() << R"(">
        <input semantic="VERTEX" source="#avatar-vertices" offset="0"/>
        <input semantic="NORMAL" source="#avatar-normals" offset="1"/>
        <input semantic="TEXCOORD" source="#avatar-uvs" offset="2" set="0"/>
        <p>)";
  for (size_t t = 0; t < avatar.mesh.triangles.size(); ++t) {
    for (size_t corner = 0; corner < 3; ++corner) {
      const uint32_t vertex = avatar.mesh.triangles[t][corner];
      out << vertex << ' ' << vertex << ' ' << split.triangles[t][corner] << (corner < 2 ? ' ' : '\n');
    }
  }
  out << "</p>\n      </triangles>\n    </mesh></geometry>\n";
}

/// What the mesh becomes where a morph target has its whole weight. Without triangles readers refuse it.
void write_shape(NumberText& out, const Mesh& mesh, const MorphTarget& morph, const std::string& id) {
  out << "    <geometry id=\"" << id << "\" name=\"" << escaped(morph.name) << "\"><mesh>\n";
  write_source(out, id + "-positions", mesh.positions.size(), "XYZ", [&] {
    size_t next = 0;
    for (size_t v = 0; v < mesh.positions.size(); ++v) {
      Eigen::Vector3f p = mesh.positions[v];
      if (next < morph.vertices.size() && morph.vertices[next] == v) p += morph.offsets[next++];
      out << p.x() << ' ' << p.y() << ' ' << p.z() << '\n';
    }
  });
  out << "      <vertices id=\"" << id << "-vertices\"><input semantic=\"POSITION\" source=\"#" << id
      << "-positions\"/></vertices>\n      <triangles count=\"" << mesh.triangles.size()
      << "\"><input semantic=\"VERTEX\" source=\"#" << id << "-vertices\" offset=\"0\"/>\n        <p>";
  for (const auto& triangle : mesh.triangles) out << triangle[0] << ' ' << triangle[1] << ' ' << triangle[2] << '\n';
  out << "</p>\n      </triangles>\n    </mesh></geometry>\n";
}

void write_geometries(NumberText& out, const Avatar& avatar, std::span<const std::string> shapes) {
  out << "  <library_geometries>\n";
  write_geometry(out, avatar);
  for (size_t i = 0; i < shapes.size(); ++i) write_shape(out, avatar.mesh, avatar.morphs[i], shapes[i]);
  out << "  </library_geometries>\n";
}

/// Row by row, as COLLADA has matrices.
template <class Matrix>
void write_matrix(NumberText& out, const Matrix& matrix, char separator) {
  for (int row = 0; row < 4; ++row)
    for (int column = 0; column < 4; ++column)
      out << static_cast<float>(matrix(row, column)) << (row == 3 && column == 3 ? separator : ' ');
}

/// The pairs of joint and weight of every vertex, weights by their place in a table of those that occur.
void write_vertex_weights(NumberText& out, const SkinTables& tables) {
  constexpr int unit = WholeInfluences::weight_unit;
  std::vector<uint32_t> place_of(unit + 1, 0);
  for (const WholeInfluences& influences : tables.influences)
    for (const int weight : influences.weight) place_of[static_cast<size_t>(weight)] = 1;
  place_of[0] = 0;  // places that are not used have no pair
  std::vector<int> occurring;
  for (int weight = 0; weight <= unit; ++weight) {
    uint32_t& place = place_of[static_cast<size_t>(weight)];
    if (place == 0) continue;
    place = static_cast<uint32_t>(occurring.size());
    occurring.push_back(weight);
  }
  out << "      <source id=\"avatar-weights\">\n        <float_array id=\"avatar-weights-array\" count=\""
      << occurring.size() << "\">";
  for (size_t i = 0; i < occurring.size(); ++i)
    out << static_cast<double>(occurring[i]) / unit << (i + 1 < occurring.size() ? ' ' : '\n');
  out << "</float_array>\n        <technique_common><accessor source=\"#avatar-weights-array\" count=\""
      << occurring.size()
      << "\" stride=\"1\"><param name=\"WEIGHT\" type=\"float\"/></accessor></technique_common>\n      </source>\n"
      << "      <joints><input semantic=\"JOINT\" source=\"#avatar-joints\"/>"
      << "<input semantic=\"INV_BIND_MATRIX\" source=\"#avatar-inverse-bind\"/></joints>\n"
      << "      <vertex_weights count=\"" << tables.influences.size() << "\">\n"
      << "        <input semantic=\"JOINT\" source=\"#avatar-joints\" offset=\"0\"/>\n"
      << "        <input semantic=\"WEIGHT\" source=\"#avatar-weights\" offset=\"1\"/>\n        <vcount>";
  for (const WholeInfluences& influences : tables.influences)
    out << std::count_if(influences.weight.begin(), influences.weight.end(), [](int weight) { return weight > 0; })
        << ' ';
  out << "</vcount>\n        <v>";
  for (const WholeInfluences& influences : tables.influences) {
    for (size_t k = 0; k < 4; ++k)
      if (influences.weight[k] > 0)
        out << influences.joint[k] << ' ' << place_of[static_cast<size_t>(influences.weight[k])] << ' ';
    out << '\n';
  }
  out << "</v>\n      </vertex_weights>\n";
}

void write_skin(NumberText& out, const Avatar& avatar, const std::vector<std::string>& ids) {
  const SkinTables tables = make_skin_tables(avatar);
  out << "    <controller id=\"" << controller_id << "\" name=\"" << controller_id << "\"><skin source=\"#"
      << geometry_id << "\">\n"
      << "      <bind_shape_matrix>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</bind_shape_matrix>\n"
      << "      <source id=\"avatar-joints\">\n        <Name_array id=\"avatar-joints-array\" count=\"" << ids.size()
      << "\">";
  for (size_t j = 0; j < ids.size(); ++j) out << ids[j] << (j + 1 < ids.size() ? " " : "");
  out << "</Name_array>\n        <technique_common><accessor source=\"#avatar-joints-array\" count=\"" << ids.size()
      << "\" stride=\"1\"><param name=\"JOINT\" type=\"name\"/></accessor></technique_common>\n      </source>\n"
      << "      <source id=\"avatar-inverse-bind\">\n        <float_array id=\"avatar-inverse-bind-array\" count=\""
      << ids.size() * 16 << "\">";
  for (const Eigen::Matrix4f& matrix : tables.joint_from_world) write_matrix(out, matrix, '\n');
  out << "</float_array>\n        <technique_common><accessor source=\"#avatar-inverse-bind-array\" count=\""
      << ids.size() << "\" stride=\"16\"><param name=\"TRANSFORM\" type=\"float4x4\"/></accessor></technique_common>\n"
      << "      </source>\n";
  write_vertex_weights(out, tables);
  out << "    </skin></controller>\n";
}

/// The shapes about the mesh, all at rest.
void write_morph(NumberText& out, std::span<const std::string> shapes) {
  out << "    <controller id=\"avatar-morph\" name=\"avatar-morph\"><morph source=\"#" << geometry_id
      << "\" method=\"NORMALIZED\">\n      <source id=\"avatar-morph-targets\">\n        <IDREF_array "
         "id=\"avatar-morph-targets-array\" count=\""
      << shapes.size() << "\">";
  for (size_t i = 0; i < shapes.size(); ++i) out << shapes[i] << (i + 1 < shapes.size() ? " " : "");
  out << "</IDREF_array>\n        <technique_common><accessor source=\"#avatar-morph-targets-array\" count=\""
      << shapes.size()
      << "\" stride=\"1\"><param name=\"MORPH_TARGET\" type=\"IDREF\"/></accessor></technique_common>\n      "
         "</source>\n      <source id=\"avatar-morph-weights\">\n        <float_array "
         "id=\"avatar-morph-weights-array\" count=\""
      << shapes.size() << "\">";
  for (size_t i = 0; i < shapes.size(); ++i) out << (i == 0 ? "0" : " 0");
  out << "</float_array>\n        <technique_common><accessor source=\"#avatar-morph-weights-array\" count=\""
      << shapes.size()
      << "\" stride=\"1\"><param name=\"MORPH_WEIGHT\" type=\"float\"/></accessor></technique_common>\n      "
         "</source>\n      <targets><input semantic=\"MORPH_TARGET\" source=\"#avatar-morph-targets\"/>"
         "<input semantic=\"MORPH_WEIGHT\" source=\"#avatar-morph-weights\"/></targets>\n    "
         "</morph></controller>\n";
}

void write_controllers(NumberText& out, const Avatar& avatar, const std::vector<std::string>& ids,
                       std::span<const std::string> shapes) {
  if (ids.empty() && shapes.empty()) return;
  out << "  <library_controllers>\n";
  if (!ids.empty()) write_skin(out, avatar, ids);
  if (!shapes.empty()) write_morph(out, shapes);
  out << "  </library_controllers>\n";
}

/// The clips as one timeline: the matrix of every moving joint, key by key.
void write_animation(NumberText& out, std::span<const AnimationClip> clips, const std::vector<std::string>& ids) {
  std::vector<double> times;
  // A clip's first key is the last one of the clip before.
  const auto first_key = [&](const AnimationClip& clip) { return &clip == clips.data() ? size_t{0} : size_t{1}; };
  for (const AnimationClip& clip : clips) {
    const double start = times.empty() ? 0 : times.back();
    for (size_t key = first_key(clip); key < clip.times_s.size(); ++key) times.push_back(start + clip.times_s[key]);
  }
  out << "  <library_animations>\n";
  for (size_t track = 0; track < clips.front().tracks.size(); ++track) {
    const std::string& joint = ids[clips.front().tracks[track].joint];
    const std::string id = std::string(own_prefix) + "-motion-" + joint;
    const auto source = [&](const char* name, const char* array, size_t count, const auto& write_values,
                            const char* accessor) {
      out << "      <source id=\"" << id << name << "\"><" << array << " id=\"" << id << name << "-array\" count=\""
          << count << "\">";
      write_values();
      out << "</" << array << "><technique_common><accessor source=\"#" << id << name << "-array\" count=\""
          << times.size() << "\" " << accessor << "</accessor></technique_common></source>\n";
    };
    out << "    <animation id=\"" << id << "\">\n";
    source(
        "-input", "float_array", times.size(),
        [&] {
          for (const double time : times) out << static_cast<float>(time) << ' ';
        },
        "stride=\"1\"><param name=\"TIME\" type=\"float\"/>");
    source(
        "-output", "float_array", times.size() * 16,
        [&] {
          for (const AnimationClip& clip : clips)
            for (size_t key = first_key(clip); key < clip.times_s.size(); ++key)
              write_matrix(out, clip.tracks[track].parent_from_joint[key].matrix(), '\n');
        },
        "stride=\"16\"><param name=\"TRANSFORM\" type=\"float4x4\"/>");
    source(
        "-interpolation", "Name_array", times.size(),
        [&] {
          for (size_t key = 0; key < times.size(); ++key) out << "LINEAR ";
        },
        "stride=\"1\"><param name=\"INTERPOLATION\" type=\"name\"/>");
    out << "      <sampler id=\"" << id << "-sampler\">";
    for (const auto& [semantic, name] :
         {std::pair{"INPUT", "-input"}, {"OUTPUT", "-output"}, {"INTERPOLATION", "-interpolation"}})
      out << "<input semantic=\"" << semantic << "\" source=\"#" << id << name << "\"/>";
    out << "</sampler>\n      <channel source=\"#" << id << "-sampler\" target=\"" << joint << "/transform\"/>\n"
        << "    </animation>\n";
  }
  out << "  </library_animations>\n";
}

/// The joint and all below it.
void write_joint(NumberText& out, const Skeleton& skeleton, const std::vector<std::string>& ids, size_t joint,
                 int depth) {
  const std::string indent(size_t{2} * static_cast<size_t>(depth), ' ');
  out << indent << "<node id=\"" << ids[joint] << "\" name=\"" << escaped(skeleton.joints[joint].name) << "\" sid=\""
      << ids[joint] << "\" type=\"JOINT\">\n"
      << indent << "  <matrix sid=\"transform\">";
  write_matrix(out, skeleton.joints[joint].parent_from_joint.matrix(), '<');
  out << "/matrix>\n";
  for (size_t child = joint + 1; child < skeleton.joints.size(); ++child)
    if (skeleton.joints[child].parent == static_cast<int>(joint)) write_joint(out, skeleton, ids, child, depth + 1);
  out << indent << "</node>\n";
}

void write_scene(NumberText& out, const Skeleton& skeleton, const std::vector<std::string>& ids) {
  const bool rigged = !ids.empty();
  out << "  <library_visual_scenes>\n    <visual_scene id=\"" << scene_id << "\" name=\"" << scene_id << "\">\n";
  constexpr int scene_depth = 3;
  if (rigged) write_joint(out, skeleton, ids, 0, scene_depth);
  const std::string_view instance = rigged ? "instance_controller" : "instance_geometry";
  out << "      <node id=\"" << node_id << "\" name=\"" << node_id << "\" type=\"NODE\">\n        <" << instance
      << " url=\"#" << (rigged ? controller_id : geometry_id) << "\">\n";
  if (rigged) out << "          <skeleton>#" << ids.front() << "</skeleton>\n";
  out << "          <bind_material><technique_common><instance_material symbol=\"avatar\" target=\"#" << material_id
      << "\"><bind_vertex_input semantic=\"UVMap\" input_semantic=\"TEXCOORD\" input_set=\"0\"/>"
      << "</instance_material></technique_common></bind_material>\n        </" << instance
      << ">\n      </node>\n    </visual_scene>\n  </library_visual_scenes>\n"
      << "  <scene><instance_visual_scene url=\"#" << scene_id << "\"/></scene>\n</COLLADA>\n";
}

}  // namespace

std::string write_collada(const Avatar& avatar, std::span<const AnimationClip> clips, const ColladaOptions& options) {
  const std::vector<std::string> ids = joint_ids(avatar.skeleton);
  const std::vector<std::string> shapes = options.morphs ? shape_ids(avatar.morphs) : std::vector<std::string>();
  NumberText out;
  constexpr size_t vertex_bytes = 130, triangle_bytes = 60;  // a little more than they take, to grow only once
  out.reserve(avatar.mesh.positions.size() * vertex_bytes + avatar.mesh.triangles.size() * triangle_bytes);
  write_header(out, options);
  write_material(out, options);
  write_geometries(out, avatar, shapes);
  write_controllers(out, avatar, ids, shapes);
  if (!clips.empty()) write_animation(out, clips, ids);
  write_scene(out, avatar.skeleton, ids);
  return out.take();
}

}  // namespace booth
