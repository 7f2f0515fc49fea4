#include "pipeline/surface/smoothing.h"
namespace booth { Mesh smooth_hc(const Mesh& m, const SmoothingOptions&, const Work&) { return m; } }
