#pragma once

#include <filesystem>
#include <vector>

#include "pipeline/types/image.h"
#include "tests/quality/measures.h"

namespace booth::quality {

/// Throws std::runtime_error where the part does not lie in the picture, which has 3 channels.
Image part_of(const Image& picture, const Window& window);

/// Pictures in rows, white between them. All have the same size and 3 channels, all rows as many.
Image in_rows(const std::vector<std::vector<Image>>& rows);

/// Throws std::runtime_error where the file cannot be written.
void write_jpeg(const Image& picture, const std::filesystem::path& file);

}  // namespace booth::quality
