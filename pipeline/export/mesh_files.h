#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "pipeline/types/avatar.h"

namespace booth {

/// Files of the mesh alone, as it was captured.
enum class MeshFormat { stl, obj, ply };

/// Binary STL for printing: the closed mesh in millimetres, +Z up, facing −Y, as slicers expect it. The format has no
/// place for colours.
/// @pre check(avatar) holds
/// Source: 3D Systems, "StereoLithography interface specification", 1989.
std::vector<uint8_t> write_stl(const Avatar& avatar);

/// Wavefront OBJ: metres, +Y up, the closed mesh with uvs (v upwards) and normals; its material is "avatar" in the
/// library `material_file`.
/// @pre check(avatar) holds
std::string write_obj(const Avatar& avatar, const std::string& material_file);

/// The material library of write_obj: matt, in the colours of the texture.
std::string write_obj_material(const std::string& texture_file);

/// Binary little-endian PLY: metres, +Y up, the closed mesh with a normal and a colour (sRGB, from the atlas) at each
/// vertex.
/// @pre check(avatar) holds
/// Source: G. Turk, "The PLY polygon file format", 1994.
std::vector<uint8_t> write_ply(const Avatar& avatar);

}  // namespace booth
