#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>
#include <span>
#include <string>

#include "pipeline/types/mesh.h"
#include "pipeline/types/result.h"

namespace booth {

/// A face that another scanner measured, dropped beside a recording.
struct ScanFile {
  std::string name;  ///< of the file
  Mesh mesh;         ///< without triangles where the file holds a cloud of points; in the file's own frame and unit
};

/// A Stanford PLY file (ASCII, or binary of either byte order) or, by its name's ending, a Wavefront OBJ file. Of
/// everything in it, positions and faces are taken; polygons become fans of triangles, those with a repeated corner
/// are left out.
///
/// @param name  for messages; what ends in ".obj" is read as OBJ
/// @error invalid_file  one sentence with the file's name: what cannot be read, is not finite or out of range; no
///                      vertex; more than 10 million vertices or 20 million triangles
/// Source: G. Turk, "The PLY polygon file format", 1994; Wavefront, "Object files (.obj)", appendix B1.
Result<Mesh> parse_scan_file(const std::string& name, std::span<const uint8_t> bytes);

/// The recording folder's face.ply or face.obj, the first of them that is there; nothing where neither is.
/// @error as parse_scan_file; io where it cannot be read or is larger than 1 GiB
Result<std::optional<ScanFile>> find_scan_file(const std::filesystem::path& recording);

}  // namespace booth
