// What a recording's face scan reaches, as it is and with faults: coverage of the true face, and how far the points are
// from it. Recordings without a truth tell the number of points alone.
//
//   face_scan_figures RECORDING

#include <cstdio>
#include <exception>

#include "pipeline/face/scan_mesh.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"
#include "tests/quality/face_scan.h"

namespace booth::quality {
namespace {

namespace fs = std::filesystem;

void print(const std::string& name, const Result<StructuredLightScan>& scan, const FaceTruth& truth) {
  if (!scan) {
    std::printf("%-46s refused: %s\n", name.c_str(), scan.error().message.c_str());
    return;
  }
  const ScanErrors errors = compare(scan->scan, truth);
  std::printf("%-46s coverage %5.1f %%  median %.2f  95 %% %.2f mm  moved %.1f mm\n", name.c_str(),
              100 * errors.coverage, 1000 * errors.median_m, 1000 * errors.p95_m, 1000 * scan->motion_m);
  for (const std::string& warning : scan->warnings) std::printf("    %s\n", warning.c_str());
}

int without_truth(const fs::path& folder, const Work& work) {
  const Recording recording = read_recording(folder).value();
  const Shot* shot = recording.find(ShotRole::gray_code);
  if (shot == nullptr || !shot->pattern) return std::puts("there is no face scan"), 1;
  const auto scan = scan_structured_light(recording.rig, {*shot->pattern, load_shot(recording, *shot, work).sets}, {},
                                          recording.rig.volume, {}, work);
  if (!scan) return std::puts(scan.error().message.c_str()), 1;
  size_t points = 0;
  for (size_t i = 0; i < scan->scan.points.size(); ++i) points += scan->scan.measured(i) ? 1 : 0;
  const ScanMesh mesh = mesh_scan(scan->scan, {}, work).value();
  std::printf("%zu points, a mesh of %zu triangles\n", points, mesh.mesh.triangles.size());
  for (const std::string& warning : scan->warnings) std::printf("    %s\n", warning.c_str());
  return 0;
}

int figures(const fs::path& folder) {
  ThreadPool pool;
  const Work work = pool.work();
  if (!fs::exists(folder / "truth/face")) return without_truth(folder, work);
  const FaceRecording recording = read_face_recording(folder, work);
  const auto scan = [&](const GrayCodeCapture& capture) {
    return scan_structured_light(recording.rig, capture, {}, recording.region, {}, work);
  };
  const auto clean = scan(recording.capture);
  print("as it is", clean, recording.truth);
  if (!clean) return 1;
  for (const FaceFault& fault : face_faults(recording, clean->scan))
    print(fault.name, scan(fault.capture), fault.truth);
  return 0;
}

}  // namespace
}  // namespace booth::quality

int main(int count, char** arguments) {
  if (count != 2) return std::puts("usage: face_scan_figures RECORDING"), 2;
  try {
    return booth::quality::figures(arguments[1]);
  } catch (const std::exception& error) {
    return std::printf("%s\n", error.what()), 1;
  }
}
