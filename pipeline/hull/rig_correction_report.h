#pragma once

#include <string>

#include "pipeline/hull/rig_correction.h"

namespace booth {

/// A page for people about a proposed correction: whether one is needed, which cameras moved and by how much, and each
/// camera's silhouette against the others' before and after. Self-contained HTML with a drawing in SVG: no script,
/// nothing to load.
std::string rig_correction_report_html(const RigCorrection& correction);

/// The correction in a sentence: "no correction needed …", or which cameras moved.
std::string describe(const RigCorrection& correction);

/// One camera's part in it, a sentence.
std::string describe(const CameraCorrection& camera);

}  // namespace booth
