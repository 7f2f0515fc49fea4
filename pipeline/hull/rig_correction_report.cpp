#include "pipeline/hull/rig_correction_report.h"

#include <algorithm>
#include <cstdio>
#include <numbers>

namespace booth {
namespace {

std::string decimal(double value, int digits) {
  char text[64];
  std::snprintf(text, sizeof text, "%.*f", digits, value);
  return text;
}

/// Camera ids and file names are safe; messages may hold anything.
std::string escaped(const std::string& text) {
  std::string out;
  for (const char c : text) {
    switch (c) {
      case '&': out += "&amp;"; break;
      case '<': out += "&lt;"; break;
      case '>': out += "&gt;"; break;
      default: out += c;
    }
  }
  return out;
}

double degrees(double angle_rad) { return angle_rad * 180 / std::numbers::pi; }

/// A bar a camera, as calibrated, and one as corrected.
std::string bars(const RigCorrection& correction) {
  constexpr double row = 34, bar = 12, left = 110, width = 420, longest = width - left - 60;
  double most_px = 1;
  for (const CameraCorrection& camera : correction.cameras)
    most_px = std::max({most_px, camera.before_px, camera.after_px});
  std::string drawing;
  double y = 0;
  const auto draw = [&](double at, double px, const char* colour) {
    drawing += "<rect x='" + decimal(left, 0) + "' y='" + decimal(at, 0) + "' width='" +
               decimal(longest * px / most_px, 1) + "' height='" + decimal(bar, 0) + "' fill='" + colour +
               "'/><text x='" + decimal(left + 4 + longest * px / most_px, 1) + "' y='" + decimal(at + bar - 2, 0) +
               "'>" + decimal(px, 2) + "</text>";
  };
  for (const CameraCorrection& camera : correction.cameras) {
    drawing += "<text x='0' y='" + decimal(y + bar + 4, 0) + "'>" + camera.camera + "</text>";
    draw(y, camera.before_px, camera.moved ? "#c0392b" : "#999");
    draw(y + bar, camera.after_px, "#2a7a3b");
    y += row;
  }
  return "<svg xmlns='http://www.w3.org/2000/svg' width='" + decimal(width, 0) + "' height='" + decimal(y, 0) +
         "' viewBox='0 0 " + decimal(width, 0) + " " + decimal(y, 0) + "'>" + drawing + "</svg>";
}

}  // namespace

std::string describe(const RigCorrection& correction) {
  const std::string from = correction.captures == 1 ? "one capture" : std::to_string(correction.captures) + " captures";
  const auto names = [&](bool CameraCorrection::*which) {
    std::string list;
    for (const CameraCorrection& camera : correction.cameras)
      if (camera.*which) list += (list.empty() ? "" : ", ") + camera.camera;
    return list;
  };
  const std::string doubtful = names(&CameraCorrection::doubtful);
  const std::string doubt = "the silhouettes of " + doubtful + " contradict the others, but " + from +
                            " cannot tell who moved: calibrate with the board";
  if (correction.needed)
    return "moved since the calibration, by the evidence of " + from + ": " + names(&CameraCorrection::moved) +
           (doubtful.empty() ? "" : "; " + doubt);
  if (!doubtful.empty()) return "no correction possible: " + doubt;
  return "no correction needed: every camera stands where it was calibrated, as far as " + from + " can tell";
}

std::string describe(const CameraCorrection& camera) {
  return camera.camera + ": carried by " + decimal(1000 * camera.carried_m, 1) + " mm and turned by " +
         decimal(degrees(camera.turned_rad), 2) + "°, which moves its picture of the subject by " +
         decimal(camera.offset_px, 1) + " px; its outline then misses the others' by " + decimal(camera.after_px, 2) +
         " px instead of " + decimal(camera.before_px, 2) + ". The new place is certain to within " +
         decimal(1000 * camera.uncertainty.center_m, 1) + " mm and " +
         decimal(degrees(camera.uncertainty.rotation_rad), 2) + "°";
}

std::string rig_correction_report_html(const RigCorrection& correction) {
  std::string page =
      "<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'><title>Correction of the cameras</title><style>"
      "body{font:15px sans-serif;margin:2em;max-width:60em}svg{font:11px sans-serif}td,th{padding:.2em .8em;"
      "text-align:right}th:first-child,td:first-child{text-align:left}.moved{color:#c0392b;font-weight:bold}"
      "</style></head><body><h1>Correction of the cameras</h1><p><b>" +
      escaped(describe(correction)) + ".</b></p>";
  if (correction.needed) {
    page +=
        "<p>This is a proposal: nothing was changed. Fasten the cameras first. The corrected poses are as good as the "
        "subjects' outlines can tell; a calibration with the board is better.</p><ul>";
    for (const CameraCorrection& camera : correction.cameras)
      if (camera.moved) page += "<li>" + escaped(describe(camera)) + ".</li>";
    page += "</ul>";
  }
  if (!correction.messages.empty()) {
    page += "<h2>Notes</h2><ul>";
    for (const std::string& message : correction.messages) page += "<li>" + escaped(message) + "</li>";
    page += "</ul>";
  }
  page +=
      "<h2>The evidence</h2><p>By how many pixels the subject's outline in each camera misses what the other cameras "
      "see, as calibrated (upper bar) and as corrected (lower bar).</p>" +
      bars(correction) +
      "<table><tr><th>camera</th><th>captures</th><th>deviation, σ</th><th>before, px</th><th>after, px</th></tr>";
  for (const CameraCorrection& camera : correction.cameras)
    page += std::string("<tr") + (camera.moved ? " class='moved'" : "") + "><td>" + camera.camera + "</td><td>" +
            std::to_string(camera.captures) + "</td><td>" + decimal(camera.deviation, 1) + "</td><td>" +
            decimal(camera.before_px, 2) + "</td><td>" + decimal(camera.after_px, 2) + "</td></tr>";
  return page + "</table></body></html>\n";
}

}  // namespace booth
