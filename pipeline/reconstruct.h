#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "pipeline/atlas/texture_atlas.h"
#include "pipeline/face/control_points.h"
#include "pipeline/face/face_detector.h"
#include "pipeline/face/face_merge.h"
#include "pipeline/face/head_fit.h"
#include "pipeline/face/landmark_predictor.h"
#include "pipeline/face/neutral_head.h"
#include "pipeline/hull/visual_hull.h"
#include "pipeline/refine/handle_removal.h"
#include "pipeline/refine/shape_refinement.h"
#include "pipeline/segmentation/segmentation.h"
#include "pipeline/skeleton/skeleton_fit.h"
#include "pipeline/skin/skinning.h"
#include "pipeline/structured_light/structured_light.h"
#include "pipeline/surface/decimation.h"
#include "pipeline/surface/smoothing.h"
#include "pipeline/types/avatar.h"
#include "pipeline/types/camera_health.h"
#include "pipeline/types/empty_view.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/work.h"

namespace booth {

/// How the face is made. Automatic: active where a scan was taken and is usable, else passive.
enum class FaceMode { automatic, active, passive, none };

std::string_view to_string(FaceMode mode);
/// "auto", "active", "passive" or "none".
std::optional<FaceMode> face_mode_from(std::string_view name);

/// Whether that mode makes use of a structured-light shot.
bool wants_scan(FaceMode mode);

struct ReconstructionOptions {
  FaceMode face = FaceMode::automatic;
  SegmentationOptions segmentation;
  VisualHullOptions hull;
  ShapeRefinementOptions refinement;
  HandleRemovalOptions handles;
  SmoothingOptions smoothing;
  DecimationOptions decimation;
  StructuredLightOptions structured_light;
  FaceMergeOptions face_merge;
  ControlPointOptions control_points;
  HeadFitOptions head_fit;
  double face_share = 0.35;  ///< of decimation.triangles, for a face that was scanned, 0 … 0.9
  AtlasOptions atlas;
  SkeletonOptions skeleton;
  SkinningOptions skinning;
};

/// A capture, decoded. Its raw frames (Frame::mosaic) are developed first.
struct CaptureFrames {
  Rig rig;
  std::vector<EmptyView> background;  ///< the empty booth, by camera
  FrameSet body;                      ///< the subject, one trigger
};

/// What was recorded of the subject's face alone.
struct FaceCapture {
  std::optional<GrayCodeCapture> patterns;  ///< the face under structured light; raw frames are developed
  std::optional<Mesh> scan = {};            ///< another scanner's face, see place_external_scan; used before `patterns`
};

/// Gives it, and may wait for it: the face is taken and decoded while the body's shape is made. Asked at most once a
/// reconstruction, when the body has its shape and the face is to be a scan if there is one.
using FaceCaptureSource = std::function<Result<FaceCapture>()>;

/// What the passive face needs besides a capture. It loads in a tenth of a second and serves any number of
/// reconstructions.
struct FaceModel {
  std::shared_ptr<const LandmarkPredictor> landmarks;  ///< never null
  std::shared_ptr<const NeutralHead> neutral;          ///< never null
};

/// Gives the model, and may wait for it. Asked at most once a reconstruction, and only when there is a passive face to
/// make.
using FaceModelSource = std::function<Result<FaceModel>()>;

/// Gives what finds the face in a picture; never null. Asked at most once a reconstruction, and only when there is a
/// scan of a face.
using FaceDetectorSource = std::function<Result<std::shared_ptr<const FaceDetector>>()>;

/// What is there only when a face needs it.
struct FaceSources {
  FaceModelSource model;        ///< left out, there is no passive face
  FaceDetectorSource detector;  ///< left out, a scan is looked for where the hull's shape says that the head is
  FaceCaptureSource capture;    ///< left out, nothing was recorded of the face alone
};

struct Reconstruction {
  Avatar avatar;
  FaceMode face = FaceMode::none;     ///< how it was made: active, passive, or none: the hull's own
  std::vector<std::string> cameras;   ///< ids of those that shaped it
  std::vector<std::string> warnings;  ///< sentences for an operator
};

/// What each camera saw of the empty booth, and a sentence for each whose frames cannot be used.
struct EmptyBooth {
  std::vector<EmptyView> views;
  std::vector<std::string> faults;
};

/// @param background  frames of the empty booth, one set a repetition; raw ones are developed
EmptyBooth learn_empty_booth(std::span<const FrameSet> background, const Work& work = {});

/// The names of the stages in their order.
const std::vector<std::string>& reconstruction_stages();

/// Called when a stage begins (fraction 0), while it runs, and when it ends (1); by one thread at a time. Stages that
/// do not need each other's results may overlap.
using StageProgress = std::function<void(std::string_view stage, double fraction)>;

/// Called once, when it is known what the capture says about the cameras: by id.
using HealthReport = std::function<void(const std::vector<CameraHealth>& cameras)>;

/// The whole method: segment → hull → refine → face → surface → atlas, and beside it skeleton → skin.
///
/// @param capture     each part of it is freed as soon as no stage needs it any more
/// @param work        its progress is not used; stages report through `progress`
/// A camera that cannot be used is left out with a warning; a shape that cannot be rigged comes back without joints
/// and with a warning; a face that cannot be had as asked for, or would be worse than the hull's, is the hull's, with a
/// warning.
///
/// @error what the stages and the source of the face's capture return, cancelled
Result<Reconstruction> reconstruct(CaptureFrames capture, const ReconstructionOptions& options,
                                   const FaceSources& sources = {}, const Work& work = {},
                                   const StageProgress& progress = {}, const HealthReport& health = {});

}  // namespace booth
