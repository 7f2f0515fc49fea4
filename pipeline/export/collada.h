#pragma once

#include <span>
#include <string>

#include "pipeline/export/animation.h"
#include "pipeline/types/avatar.h"

namespace booth {

/// All text is UTF-8.
struct ColladaOptions {
  std::string texture_file = "texture.png";      ///< relative path of the atlas
  std::string created = "1970-01-01T00:00:00Z";  ///< ISO 8601
  std::string authoring_tool = "Avatar Booth";
  bool morphs = false;  ///< with the morph targets
};

/// The avatar as a COLLADA 1.4.1 document, valid by its schema: metres, Y up, one geometry of triangles with normals
/// and uvs (v upwards, as COLLADA has it), one matt material with the texture, one skin with weights that sum to
/// exactly 1 as printed, the joint tree at rest with sids equal to the joints' names. A joint's name that is no XML
/// name, or one of the document's own ids, is altered until it fits. An avatar without joints is written as a plain
/// geometry instance.
///
/// Morph targets, where asked for, are a geometry each, named as they are, and one morph controller whose source is the
/// mesh, as is the skin's. Were they chained, the scene's skin to the morph and the morph to the mesh, Blender 3.4,
/// three.js and pycollada would find no mesh at all. Beside each other, Blender shows the targets as shape keys of the
/// skinned mesh, and the others, which know none, the skinned mesh. Assimp 5.2 refuses any document with a morph
/// controller. A target takes a third of the space that everything else does.
/// @param clips  written as one animation, one clip after the other, as most readers know only one timeline; each has
/// to
///               begin as the one before it ends, and to move the same joints
/// @pre check(avatar) holds
/// Source: The Khronos Group, "COLLADA – Digital Asset Schema Release 1.4.1", 2nd edition, 2008.
std::string write_collada(const Avatar& avatar, std::span<const AnimationClip> clips, const ColladaOptions& options);

}  // namespace booth
