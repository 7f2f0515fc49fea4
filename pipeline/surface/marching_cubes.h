#pragma once

#include "pipeline/types/field.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// The zero level of a field as a closed, consistently oriented 2-manifold whose triangles face from negative to
/// positive values.
///
/// @param field  positive on the border of its grid; otherwise the surface is open there
/// Source: W. Lorensen, H. Cline, "Marching cubes", SIGGRAPH 1987.
Mesh extract_surface(const Field& field, const Work& work = {});

}  // namespace booth
