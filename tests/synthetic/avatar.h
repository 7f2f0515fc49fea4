#pragma once

#include "pipeline/types/avatar.h"
#include "tests/synthetic/body.h"

namespace booth::synthetic {

struct AvatarOptions {
  int segments = 12;     ///< vertices around a limb
  int atlas_side = 512;  ///< texels
  bool rigged = true;
};

/// A person as an avatar: every capsule of the body is a closed surface of its own with a rectangular chart, so that
/// each vertex on a chart's seam has several uvs; the colours are synthetic::colour_at. The joints are turned against
/// each other, the weights belong to the up to four nearest joints.
Avatar make_avatar(const Person& subject, const AvatarOptions& options = {});

}  // namespace booth::synthetic
