#include "tests/quality/face_truth.h"

#include <zlib.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <fstream>
#include <stdexcept>
#include <string>

#include "pipeline/geometry/camera_model.h"
#include "replay/recording.h"
#include "tests/quality/measures.h"
#include "tests/quality/truth.h"

namespace booth::quality {
namespace {

namespace fs = std::filesystem;

template <class T>
T number_at(const std::vector<uint8_t>& bytes, size_t at) {
  if (at + sizeof(T) > bytes.size()) throw std::runtime_error("the archive ends early");
  T value;
  std::memcpy(&value, bytes.data() + at, sizeof value);
  return value;
}

/// One member of a ZIP archive, found by its central directory.
std::vector<uint8_t> member_of(const fs::path& file, const std::string& name) {
  std::ifstream stream(file, std::ios::binary);
  const std::vector<uint8_t> zip{std::istreambuf_iterator<char>(stream), {}};
  constexpr size_t end_record = 22;
  if (zip.size() < end_record) throw std::runtime_error(file.string() + ": no archive");
  const size_t end = zip.size() - end_record;
  size_t at = number_at<uint32_t>(zip, end + 16);
  for (int left = number_at<uint16_t>(zip, end + 10); left > 0; --left) {
    const auto compressed = number_at<uint32_t>(zip, at + 20), size = number_at<uint32_t>(zip, at + 24);
    const auto name_size = number_at<uint16_t>(zip, at + 28), extra = number_at<uint16_t>(zip, at + 30),
               comment = number_at<uint16_t>(zip, at + 32);
    const size_t local = number_at<uint32_t>(zip, at + 42);
    if (std::string(zip.begin() + static_cast<long>(at) + 46, zip.begin() + static_cast<long>(at) + 46 + name_size) ==
        name) {
      const size_t data = local + 30 + number_at<uint16_t>(zip, local + 26) + number_at<uint16_t>(zip, local + 28);
      std::vector<uint8_t> out(size);
      if (number_at<uint16_t>(zip, at + 10) == 0) {
        out.assign(zip.begin() + static_cast<long>(data), zip.begin() + static_cast<long>(data + size));
        return out;
      }
      z_stream inflater{};
      inflater.next_in = const_cast<Bytef*>(zip.data() + data);
      inflater.avail_in = compressed;
      inflater.next_out = out.data();
      inflater.avail_out = size;
      constexpr int raw_deflate = -15;
      if (inflateInit2(&inflater, raw_deflate) != Z_OK) throw std::runtime_error("zlib");
      const int ended = inflate(&inflater, Z_FINISH);
      inflateEnd(&inflater);
      if (ended != Z_STREAM_END) throw std::runtime_error(file.string() + ": damaged");
      return out;
    }
    at += 46U + name_size + extra + comment;
  }
  throw std::runtime_error(file.string() + ": no " + name);
}

/// A NumPy array of little-endian 32-bit floats, as triples.
std::vector<Eigen::Vector3f> points_of(const fs::path& file) {
  const std::vector<uint8_t> npy = member_of(file, "points.npy");
  const size_t header = 10 + number_at<uint16_t>(npy, 8);
  const std::string text(npy.begin() + 10, npy.begin() + static_cast<long>(header));
  if (text.find("'<f4'") == std::string::npos || text.find("'fortran_order': False") == std::string::npos)
    throw std::runtime_error(file.string() + ": not rows of 32-bit floats");
  std::vector<Eigen::Vector3f> points((npy.size() - header) / sizeof(Eigen::Vector3f));
  for (size_t i = 0; i < points.size(); ++i)
    for (size_t axis = 0; axis < 3; ++axis)
      points[i][static_cast<Eigen::Index>(axis)] = number_at<float>(npy, header + (3 * i + axis) * sizeof(float));
  return points;
}

}  // namespace

FaceTruth read_face_truth(const fs::path& recording) {
  const Rig rig = read_rig(recording / "truth/rig.json").value();
  const Mesh mesh = read_ply(recording / "truth/mesh.ply");
  const RayCaster surface(mesh);
  const Eigen::Vector3d head = read_joints(recording / "truth/joints.json").at("head");
  double crown = head.y();
  for (const Eigen::Vector3f& p : mesh.positions)
    if (std::abs(static_cast<double>(p.x()) - head.x()) < 0.1) crown = std::max(crown, static_cast<double>(p.y()));

  const CalibratedView& projector = rig.projector.value();
  FaceTruth truth;
  std::vector<fs::path> files;
  for (const auto& entry : fs::directory_iterator(recording / "truth/face")) files.push_back(entry.path());
  std::sort(files.begin(), files.end());
  for (const fs::path& file : files)
    for (const Eigen::Vector3f& point : points_of(file)) {
      const Eigen::Vector3d p = point.cast<double>(), from_head = p - head;
      const bool on_face =
          from_head.y() > -0.08 && p.y() < crown - 0.04 && from_head.z() > 0.02 && std::abs(from_head.x()) < 0.09;
      if (!on_face) continue;  // NaN is not, either
      const auto at = project(projector, p);
      if (!at || at->minCoeff() < 1 || at->x() > projector.intrinsics.width - 2 ||
          at->y() > projector.intrinsics.height - 2)
        continue;
      const Eigen::Vector3d way = p - projector.center();
      const auto hit = surface.cast(projector.center(), way);
      if (!hit) continue;
      Eigen::Vector3d lit = Eigen::Vector3d::Zero();
      for (size_t k = 0; k < 3; ++k)
        lit += static_cast<double>(hit->corner_weights[static_cast<Eigen::Index>(k)]) *
               mesh.positions[mesh.triangles[hit->triangle][k]].cast<double>();
      constexpr double shadow_m = 0.001;
      if ((lit - projector.center()).norm() < way.norm() - shadow_m) continue;
      truth.points.push_back(p);
      truth.projected.push_back(*at);
    }
  return truth;
}

ScanErrors compare(const RangeScan& scan, const FaceTruth& truth) {
  std::vector<double> off;
  for (size_t i = 0; i < truth.points.size(); ++i) {
    const Eigen::Vector2d& at = truth.projected[i];
    const int x = std::clamp(static_cast<int>(std::floor(at.x())), 0, scan.width - 2),
              y = std::clamp(static_cast<int>(std::floor(at.y())), 0, scan.height - 2);
    const float a = static_cast<float>(at.x()) - static_cast<float>(x),
                b = static_cast<float>(at.y()) - static_cast<float>(y);
    const std::array<Eigen::Vector3f, 4> corner{scan.points[scan.index(x, y)], scan.points[scan.index(x + 1, y)],
                                                scan.points[scan.index(x, y + 1)],
                                                scan.points[scan.index(x + 1, y + 1)]};
    Eigen::Vector3f found = (1 - b) * ((1 - a) * corner[0] + a * corner[1]) + b * ((1 - a) * corner[2] + a * corner[3]);
    constexpr float another_surface_m = 0.004F;  // nothing lies between them
    const bool torn = std::max((corner[0] - corner[3]).norm(), (corner[1] - corner[2]).norm()) > another_surface_m;
    if (torn || !found.allFinite()) found = corner[static_cast<size_t>(a > 0.5F) + 2 * static_cast<size_t>(b > 0.5F)];
    if (found.allFinite()) off.push_back((found.cast<double>() - truth.points[i]).norm());
  }
  if (off.empty()) return {};
  std::sort(off.begin(), off.end());
  return {static_cast<double>(off.size()) / static_cast<double>(truth.points.size()), off[off.size() / 2],
          off[off.size() * 95 / 100]};
}

}  // namespace booth::quality
