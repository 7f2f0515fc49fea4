#pragma once

#include <string>

#include "pipeline/types/avatar.h"

namespace booth {

struct ColladaOptions {
  std::string texture_file = "texture.png";  ///< relative path of the atlas
  std::string created = "1970-01-01T00:00:00Z";
  std::string authoring_tool = "Avatar Booth";
};

/// The avatar as a COLLADA 1.4.1 document, as the avatar's contract says: metres, Y up, one geometry, one
/// material, one skin, the joint tree. An avatar without joints is written as a plain geometry instance.
/// @pre check(avatar) holds
std::string write_collada(const Avatar& avatar, const ColladaOptions& options);

}  // namespace booth
