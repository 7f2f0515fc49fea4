#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

namespace booth {

/// The length of the JPEG at the beginning of what a camera delivered, without the padding that some append; nothing
/// where it is no whole JPEG: it does not begin with SOI, its segments do not follow one another, or the picture is cut
/// off before EOI. Entropy-coded data is not looked into: a decoder has to.
/// Source: ITU-T T.81, "Digital compression and coding of continuous-tone still images", annex B.
std::optional<size_t> whole_jpeg(std::span<const uint8_t> bytes);

}  // namespace booth
