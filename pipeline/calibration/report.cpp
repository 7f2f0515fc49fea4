#include "pipeline/calibration/report.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <numbers>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

std::string decimal(double value, int digits) {
  char text[64];
  std::snprintf(text, sizeof text, "%.*f", digits, value);
  return text;
}

std::string escaped(const std::string& text) {
  std::string out;
  for (const char c : text) {
    if (c == '&')
      out += "&amp;";
    else if (c == '<')
      out += "&lt;";
    else if (c == '>')
      out += "&gt;";
    else if (c == '"')
      out += "&quot;";
    else
      out += c;
  }
  return out;
}

std::string line(double x1, double y1, double x2, double y2, const std::string& style) {
  return "<line x1='" + decimal(x1, 2) + "' y1='" + decimal(y1, 2) + "' x2='" + decimal(x2, 2) + "' y2='" +
         decimal(y2, 2) + "' " + style + "/>";
}
std::string dot(double x, double y, double radius, const std::string& style) {
  return "<circle cx='" + decimal(x, 2) + "' cy='" + decimal(y, 2) + "' r='" + decimal(radius, 2) + "' " + style + "/>";
}
std::string words(double x, double y, const std::string& text) {
  return "<text x='" + decimal(x, 1) + "' y='" + decimal(y, 1) + "'>" + escaped(text) + "</text>";
}
std::string svg(double width, double height, const std::string& content) {
  return "<svg xmlns='http://www.w3.org/2000/svg' width='" + decimal(width, 0) + "' height='" + decimal(height, 0) +
         "' viewBox='0 0 " + decimal(width, 0) + " " + decimal(height, 0) + "'>" + content + "</svg>";
}

/// A device's picture, upright, with every corner, its residual drawn as a line many times too long, outliers in red.
std::string residual_plot(const CalibrationDevice& device, const DeviceQuality& quality) {
  constexpr double width = 240;
  const bool turned = device.mount_rotation_deg % 180 != 0;
  const double across = turned ? device.height : device.width, along = turned ? device.width : device.height;
  const double scale = width / across, height = along * scale;
  const double angle = device.mount_rotation_deg * std::numbers::pi / 180;
  const auto turn = [&](const Eigen::Vector2d& v) {
    return Eigen::Vector2d(std::cos(angle) * v.x() - std::sin(angle) * v.y(),
                           std::sin(angle) * v.x() + std::cos(angle) * v.y());
  };
  const Eigen::Vector2d middle(0.5 * (device.width - 1), 0.5 * (device.height - 1));
  // The typical residual is drawn a twentieth of the picture long.
  const double exaggeration = quality.rms_px > 0 ? std::max(1.0, std::floor(width / 20 / quality.rms_px / scale)) : 1;
  std::string content = "<rect width='100%' height='100%' class='picture'/>";
  for (const CornerResidual& corner : quality.residuals) {
    const Eigen::Vector2d p = scale * turn(corner.pixel - middle) + Eigen::Vector2d(width / 2, height / 2);
    const Eigen::Vector2d tip = p + scale * exaggeration * turn(corner.residual);
    const std::string look = corner.outlier ? "class='outlier'" : "class='residual'";
    if (corner.residual.allFinite() && (tip - p).norm() < width) content += line(p.x(), p.y(), tip.x(), tip.y(), look);
    content += dot(p.x(), p.y(), 1.1, look);
  }
  return svg(width, height, content) + "<figcaption>" + escaped(device.id) + ": residuals × " +
         decimal(exaggeration, 0) + "</figcaption>";
}

/// All residuals of a device around the origin, with the circle of its rms.
std::string residual_cloud(const DeviceQuality& quality) {
  constexpr double side = 120, reach = 4;  // the rms's multiple at the edge
  const double scale = quality.rms_px > 0 ? side / 2 / (reach * quality.rms_px) : 1;
  std::string content = "<rect width='100%' height='100%' class='picture'/>";
  content += line(0, side / 2, side, side / 2, "class='axis'") + line(side / 2, 0, side / 2, side, "class='axis'");
  for (const CornerResidual& corner : quality.residuals) {
    const Eigen::Vector2d p = scale * corner.residual + Eigen::Vector2d(side / 2, side / 2);
    if (p.allFinite() && p.minCoeff() >= 0 && p.maxCoeff() <= side)
      content += dot(p.x(), p.y(), 1, corner.outlier ? "class='outlier'" : "class='residual'");
  }
  content += dot(side / 2, side / 2, side / 2 / reach, "class='circle'");
  return svg(side, side, content);
}

/// A view of the rig along one axis of the world.
struct Projection {
  int right, down;  ///< axes
  double right_sign, down_sign;
  const char* title;
};

/// The rig drawn to scale: volume, cameras with what they see up to the volume, places of the board.
std::string rig_view(const Calibration& calibration, const CalibrationInput& input, const Projection& view) {
  constexpr double width = 520, height = 420, border = 30;
  const Rig& rig = calibration.rig;
  Eigen::AlignedBox3d all = rig.volume;
  for (const RigCamera& camera : rig.cameras) all.extend(camera.center());
  if (rig.projector) all.extend(rig.projector->center());
  const auto flat = [&](const Eigen::Vector3d& p) {
    return Eigen::Vector2d(view.right_sign * p[view.right], view.down_sign * p[view.down]);
  };
  Eigen::AlignedBox2d extent;
  extent.extend(flat(all.min()));
  extent.extend(flat(all.max()));
  const double scale = std::min((width - 2 * border) / extent.sizes().x(), (height - 2 * border) / extent.sizes().y());
  const auto at = [&](const Eigen::Vector3d& p) {
    return Eigen::Vector2d((flat(p) - extent.center()) * scale + Eigen::Vector2d(width / 2, height / 2));
  };
  std::string content = "<rect width='100%' height='100%' class='picture'/>";
  const Eigen::AlignedBox2d volume = [&] {
    Eigen::AlignedBox2d box;
    box.extend(at(rig.volume.min()));
    box.extend(at(rig.volume.max()));
    return box;
  }();
  content += "<rect x='" + decimal(volume.min().x(), 1) + "' y='" + decimal(volume.min().y(), 1) + "' width='" +
             decimal(volume.sizes().x(), 1) + "' height='" + decimal(volume.sizes().y(), 1) + "' class='volume'/>";

  const auto draw = [&](const CalibratedView& camera, const std::string& look) {
    const Eigen::Vector2d centre = at(camera.center());
    // The picture's frame at the distance of the volume's middle: what the camera sees there.
    const double depth = (camera.camera_from_world * rig.volume.center()).z();
    const double w = camera.intrinsics.width - 1, h = camera.intrinsics.height - 1;
    std::string frame;
    for (const Eigen::Vector2d& pixel : {Eigen::Vector2d(0, 0), {w, 0}, {w, h}, {0, h}}) {
      const Eigen::Vector3d seen = std::max(0.3, depth) * unproject(camera.intrinsics, pixel);
      const Eigen::Vector2d corner = at(camera.camera_from_world.inverse() * seen);
      frame += decimal(corner.x(), 1) + "," + decimal(corner.y(), 1) + " ";
      content += line(centre.x(), centre.y(), corner.x(), corner.y(), "class='ray'");
    }
    content += "<polygon points='" + frame + "' class='frame'/>";
    content += dot(centre.x(), centre.y(), 4, look) + words(centre.x() + 6, centre.y() - 4, camera.id);
  };
  for (const RigCamera& camera : rig.cameras)
    draw(camera, camera.role == CameraRole::face ? "class='face'" : "class='body'");
  if (rig.projector) draw(*rig.projector, "class='projector'");

  const double board_w = input.board.squares_x * input.board.square_m,
               board_h = input.board.squares_y * input.board.square_m;
  for (const Eigen::Isometry3d& world_from_board : calibration.world_from_board) {
    std::string outline;
    for (const Eigen::Vector3d& p :
         {Eigen::Vector3d(0, 0, 0), {board_w, 0, 0}, {board_w, board_h, 0}, {0, board_h, 0}}) {
      const Eigen::Vector2d corner = at(world_from_board * p);
      outline += decimal(corner.x(), 1) + "," + decimal(corner.y(), 1) + " ";
    }
    content += "<polygon points='" + outline + "' class='board'/>";
  }
  content +=
      line(border, height - 12, border + scale, height - 12, "class='scale'") + words(border + 4, height - 16, "1 m");
  return "<figure>" + svg(width, height, content) + "<figcaption>" + view.title + "</figcaption></figure>";
}

/// How much of the capture volume a device sees, 0 … 1, by points spread through it.
double seen_of_volume(const CalibratedView& view, const Eigen::AlignedBox3d& volume) {
  constexpr int steps = 12;
  int seen = 0;
  for (int i = 0; i < steps; ++i)
    for (int j = 0; j < steps; ++j)
      for (int k = 0; k < steps; ++k) {
        const Eigen::Vector3d share((i + 0.5) / steps, (j + 0.5) / steps, (k + 0.5) / steps);
        const auto pixel = project(view, volume.min() + share.cwiseProduct(volume.sizes()));
        seen += pixel && pixel->x() >= -0.5 && pixel->y() >= -0.5 && pixel->x() < view.intrinsics.width - 0.5 &&
                        pixel->y() < view.intrinsics.height - 0.5
                    ? 1
                    : 0;
      }
  return static_cast<double>(seen) / (steps * steps * steps);
}

constexpr const char* style = R"(
body{font:15px/1.4 sans-serif;max-width:1120px;margin:24px auto;padding:0 16px;color:#222;background:#fff}
h1 span{padding:2px 14px;border-radius:6px;color:#fff}.good{background:#2a7d3a}.usable{background:#b07a00}.bad{background:#b3261e}
table{border-collapse:collapse}td,th{padding:3px 10px;text-align:right;border-bottom:1px solid #ddd}
td:first-child,th:first-child{text-align:left}figure{display:inline-block;margin:8px;vertical-align:top}
figcaption{font-size:13px;color:#555}svg text{font:10px sans-serif;fill:#333}.picture{fill:#f4f4f2;stroke:#bbb}
.residual{stroke:#1f5fa8;fill:#1f5fa8;stroke-width:.8}.outlier{stroke:#c62828;fill:#c62828;stroke-width:.8}
.axis{stroke:#bbb}.circle{fill:none;stroke:#2a7d3a}.volume{fill:#cfe3cf;stroke:#2a7d3a}.ray{stroke:#bbb;stroke-width:.5}
.frame{fill:none;stroke:#999;stroke-width:.6}.body{fill:#1f5fa8}.face{fill:#8e24aa}.projector{fill:#e65100}
.board{fill:#d8c98a66;stroke:#8a7320;stroke-width:.8}.scale{stroke:#222;stroke-width:2}
)";

/// How the cameras' colours were matched; nothing where they were not.
std::string colour_table(const ColourResponse& colours) {
  if (colours.cameras.empty()) return "";
  const auto percent = [](double share) { return decimal(100 * share, 2); };
  std::string table =
      "<h2>Colours</h2>\n<p>How far the cameras disagree about the board's white: " + percent(colours.before) +
      " % before and " + percent(colours.after) +
      " % after (root mean square) each picture is multiplied by its camera's factors, in linear "
      "light.</p>\n<table><tr><th>camera<th>red<th>green<th>blue<th>white squares<th>overexposed<th>before "
      "(%)<th>after (%)</tr>\n";
  for (const CameraColour& camera : colours.cameras) {
    table += "<tr><td>" + escaped(camera.id);
    for (const float gain : camera.gain)
      table += "<td>" + (camera.matched ? decimal(static_cast<double>(gain), 4) : std::string("not matched"));
    table += "<td>" + std::to_string(camera.samples) + "<td>" + std::to_string(camera.clipped) + "<td>" +
             (camera.matched ? percent(camera.before) + "<td>" + percent(camera.after) : "<td>") + "</tr>\n";
  }
  return table + "</table>\n";
}

}  // namespace

std::string calibration_report_html(const Calibration& calibration, const CalibrationInput& input) {
  const std::string verdict(to_string(calibration.verdict));
  std::string page = "<!DOCTYPE html>\n<html lang='en'><head><meta charset='utf-8'><title>Calibration of " +
                     escaped(calibration.rig.name) + "</title><style>" + style + "</style></head><body>\n";
  page += "<h1>Calibration: <span class='" + verdict + "'>" + verdict + "</span></h1>\n<p>" +
          escaped(calibration.reason) + ".</p>\n";
  if (!calibration.messages.empty()) {
    page += "<ul>";
    for (const std::string& message : calibration.messages) page += "<li>" + escaped(message) + "</li>\n";
    page += "</ul>\n";
  }
  page += "<p>Reprojection error of all corners: " + decimal(calibration.rms_px, 3) + " px (root mean square), from " +
          std::to_string(calibration.poses.size()) + " poses of the board.</p>\n";
  page +=
      "<h2>Cameras</h2>\n<table><tr><th>camera<th>error (px)<th>views<th>corners<th>outliers<th>position ± "
      "(mm)<th>direction ± (°)<th>focal length ± (px)<th>sees of the volume</tr>\n";
  for (const DeviceQuality& quality : calibration.devices) {
    page += "<tr><td>" + escaped(quality.id);
    if (!quality.solved) {
      page +=
          "<td colspan='8'>" + escaped(quality.messages.empty() ? "not solved" : quality.messages.front()) + "</tr>\n";
      continue;
    }
    const CalibratedView* view = calibration.rig.find(quality.id);
    if (!view && calibration.rig.projector) view = &*calibration.rig.projector;
    page += "<td>" + decimal(quality.rms_px, 3) + "<td>" + std::to_string(quality.views) + "<td>" +
            std::to_string(quality.corners) + "<td>" + std::to_string(quality.outliers) + "<td>" +
            decimal(1000 * quality.pose.center_m, 2) + "<td>" +
            decimal(quality.pose.rotation_rad * 180 / std::numbers::pi, 4) + "<td>" +
            decimal(quality.focal_sigma_px, 2) + "<td>" +
            (view ? decimal(100 * seen_of_volume(*view, calibration.rig.volume), 0) + " %" : "") + "</tr>\n";
  }
  page += "</table>\n" + colour_table(calibration.colours) + "<h2>The rig</h2>\n";
  page += rig_view(calibration, input,
                   {0, 2, 1, 1, "from above: the subject stands in the green volume and looks down the page"});
  page += rig_view(calibration, input, {2, 1, 1, -1, "from the side: the subject looks to the right"});
  page +=
      "\n<h2>Residuals and coverage</h2>\n<p>Each camera's picture, upright: every corner of the board that it saw, "
      "with the distance from where the solution puts it, enlarged. Red ones had no say. Empty parts of a picture are "
      "not covered. Beside it all residuals around their middle; the circle is their root mean square.</p>\n";
  for (size_t i = 0; i < calibration.devices.size() && i < input.devices.size(); ++i)
    if (calibration.devices[i].solved)
      page += "<figure>" + residual_plot(input.devices[i], calibration.devices[i]) + "</figure><figure>" +
              residual_cloud(calibration.devices[i]) + "</figure>\n";
  return page + "</body></html>\n";
}

}  // namespace booth
