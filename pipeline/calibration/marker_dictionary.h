#pragma once

#include <optional>
#include <string_view>

namespace booth {

/// OpenCV's number of the dictionary of that name ("DICT_5X5_250"), for cv::aruco::getPredefinedDictionary.
std::optional<int> find_dictionary(std::string_view name);

}  // namespace booth
