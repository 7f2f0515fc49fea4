#pragma once

#include <cstddef>

#include "pipeline/types/field.h"
#include "pipeline/types/work.h"

namespace booth {

struct SolidParts {
  size_t kept_samples = 0;     ///< samples inside the part that stays
  size_t removed_samples = 0;  ///< samples inside parts that were removed
  size_t filled_samples = 0;   ///< samples of cavities that were filled
};

/// Leaves of a field's inside only its largest connected part, without cavities. Samples are connected along the
/// grid's axes, as marching cubes joins them. A sample that changes sides keeps its magnitude.
SolidParts keep_largest_part(Field& field, const Work& work = {});

}  // namespace booth
