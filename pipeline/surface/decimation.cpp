#include "pipeline/surface/decimation.h"
namespace booth { Mesh decimate(const Mesh& m, const DecimationOptions&, const Work&) { return m; } }
