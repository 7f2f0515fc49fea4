#pragma once

#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "daemon/camera_supervisor.h"
#include "daemon/metrics.h"
#include "daemon/wakeup.h"
#include "drivers/clock.h"
#include "pipeline/types/frame.h"

namespace booth {

/// One picture of a preview, upright and small.
struct PreviewPicture {
  std::string camera;
  uint64_t sequence = 0;  ///< of all pictures of this boot, from 1
  std::chrono::system_clock::time_point time;
  Timestamp timestamp_ns = 0;  ///< of the exposure
  int width = 0, height = 0;
  std::vector<uint8_t> jpeg;
};

struct PreviewSettings {
  int fps = 10;
  int max_width = 640;
  int rotation_deg = 0;  ///< see RigCamera::mount_rotation_deg
};

/// Turns what cameras see between captures into pictures for people. Of each camera only the newest frame counts:
/// pictures that are not fetched in time are replaced, and none is older than 150 ms when it is made. The cameras'
/// threads only put frames down here; scaling and encoding have a thread of their own. Any thread may call.
class PreviewBoard {
 public:
  /// @param cameras  end before the board does
  /// @param ready    signalled when take() has something
  PreviewBoard(CameraSupervisor& cameras, Metrics& metrics, const Clock& clock, Wakeup& ready);

  /// Shows a camera from now on, or with other settings. @param camera  one of the supervisor's
  void start(const std::string& camera, const PreviewSettings& settings);
  void stop(const std::string& camera);

  /// At most one picture of each camera.
  std::vector<PreviewPicture> take();

 private:
  struct Show {
    PreviewSettings settings;
    std::optional<Frame> newest;
    Timestamp next = 0;  ///< when the next picture may be made
  };
  void put(const std::string& camera, const Frame& frame);
  void run(const std::stop_token& stop);
  std::optional<PreviewPicture> make(const std::string& camera, const Frame& frame, const PreviewSettings& settings);

  CameraSupervisor& cameras_;
  Metrics& metrics_;
  const Clock& clock_;
  Wakeup& ready_;

  std::mutex mutex_;
  std::condition_variable_any changed_;
  std::map<std::string, Show> shows_;               ///< guarded by mutex_
  std::map<std::string, PreviewPicture> pictures_;  ///< guarded by mutex_; not fetched yet
  uint64_t sequence_ = 0;                           ///< guarded by mutex_
  std::jthread thread_;
};

}  // namespace booth
