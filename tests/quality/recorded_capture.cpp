#include "tests/quality/recorded_capture.h"

#include "pipeline/segmentation/segmentation.h"
#include "replay/recording.h"

namespace booth::quality {

RecordedCapture load_capture(const std::filesystem::path& folder, const Work& work) {
  const Recording recording = read_recording(folder).value();
  RecordedCapture capture;
  capture.rig = recording.rig;
  const auto empty = load_shot(recording, *recording.find(ShotRole::background), work).sets;
  capture.frames = load_shot(recording, *recording.find(ShotRole::body), work).sets.at(0).frames;
  capture.background.resize(capture.frames.size());
  capture.silhouettes.resize(capture.frames.size());
  work.parallel_for(capture.frames.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) {
      std::vector<Frame> background;
      for (const FrameSet& set : empty)
        for (const Frame& frame : set.frames)
          if (frame.camera == capture.frames[i].camera) background.push_back(frame);
      capture.background[i] = learn_empty_view(background).value();
      capture.silhouettes[i] = segment(capture.background[i], capture.frames[i], {}).value().silhouette;
    }
  });
  return capture;
}

}  // namespace booth::quality
