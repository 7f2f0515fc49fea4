#include "pipeline/export/portrait.h"
namespace booth {
Image render_portrait(const Avatar&, const PortraitOptions&, const Work&) { return {}; }
}  // namespace booth
