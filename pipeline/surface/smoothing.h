#pragma once

#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

struct SmoothingOptions {
  int iterations = 3;
  double alpha = 0.0;  ///< pull towards the original position, 0 … 1
  double beta = 0.5;   ///< share of a vertex's own correction against its neighbours', 0 … 1
};

/// Laplacian smoothing that pushes vertices back by the mean of what it moved them, so that the volume stays.
/// Source: J. Vollmer, R. Mencl, H. Müller, "Improved Laplacian smoothing of noisy surface meshes",
/// Computer Graphics Forum 18(3), 1999 (HC algorithm).
Mesh smooth_hc(const Mesh& mesh, const SmoothingOptions& options, const Work& work = {});

}  // namespace booth
