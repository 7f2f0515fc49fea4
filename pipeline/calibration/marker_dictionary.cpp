#include "pipeline/calibration/marker_dictionary.h"

#include <array>
#include <opencv2/aruco/dictionary.hpp>
#include <utility>

namespace booth {

std::optional<int> find_dictionary(std::string_view name) {
  static constexpr std::array<std::pair<std::string_view, int>, 17> known{
      {{"DICT_4X4_50", cv::aruco::DICT_4X4_50},
       {"DICT_4X4_100", cv::aruco::DICT_4X4_100},
       {"DICT_4X4_250", cv::aruco::DICT_4X4_250},
       {"DICT_4X4_1000", cv::aruco::DICT_4X4_1000},
       {"DICT_5X5_50", cv::aruco::DICT_5X5_50},
       {"DICT_5X5_100", cv::aruco::DICT_5X5_100},
       {"DICT_5X5_250", cv::aruco::DICT_5X5_250},
       {"DICT_5X5_1000", cv::aruco::DICT_5X5_1000},
       {"DICT_6X6_50", cv::aruco::DICT_6X6_50},
       {"DICT_6X6_100", cv::aruco::DICT_6X6_100},
       {"DICT_6X6_250", cv::aruco::DICT_6X6_250},
       {"DICT_6X6_1000", cv::aruco::DICT_6X6_1000},
       {"DICT_7X7_50", cv::aruco::DICT_7X7_50},
       {"DICT_7X7_100", cv::aruco::DICT_7X7_100},
       {"DICT_7X7_250", cv::aruco::DICT_7X7_250},
       {"DICT_7X7_1000", cv::aruco::DICT_7X7_1000},
       {"DICT_ARUCO_ORIGINAL", cv::aruco::DICT_ARUCO_ORIGINAL}}};
  for (const auto& [known_name, number] : known)
    if (known_name == name) return number;
  return std::nullopt;
}

}  // namespace booth
