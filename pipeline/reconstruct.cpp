#include "pipeline/reconstruct.h"

#include <algorithm>
#include <array>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <span>
#include <utility>

#include "pipeline/face/expressions.h"
#include "pipeline/face/external_scan.h"
#include "pipeline/face/face_evidence.h"
#include "pipeline/face/face_patch.h"
#include "pipeline/face/face_pictures.h"
#include "pipeline/face/face_place.h"
#include "pipeline/face/face_sewing.h"
#include "pipeline/face/field_fusion.h"
#include "pipeline/geometry/solid_parts.h"
#include "pipeline/health/background_registration.h"
#include "pipeline/image/develop.h"
#include "pipeline/surface/marching_cubes.h"
#include "pipeline/surface/self_intersection.h"

namespace booth {
namespace {

constexpr std::array<std::pair<FaceMode, std::string_view>, 4> face_mode_names{{{FaceMode::automatic, "auto"},
                                                                                {FaceMode::active, "active"},
                                                                                {FaceMode::passive, "passive"},
                                                                                {FaceMode::none, "none"}}};

/// Tells one stage's progress to the caller's sink, its beginning and its end included.
class StageReport {
 public:
  StageReport(std::string_view stage, const Work& work, const StageProgress& progress)
      : stage_(stage), progress_(progress), work_(work), step_(work, stage) {
    work_.progress = [this](double fraction) { tell(fraction); };
    tell(0);
  }
  ~StageReport() { tell(1); }
  StageReport(const StageReport&) = delete;
  StageReport& operator=(const StageReport&) = delete;

  const Work& work() const { return work_; }

 private:
  void tell(double fraction) const {
    if (progress_) progress_(stage_, fraction);
  }
  std::string_view stage_;
  const StageProgress& progress_;
  Work work_;
  const Step step_;
};

/// The same sink for stages that overlap.
StageProgress one_at_a_time(const StageProgress& progress) {
  if (!progress) return {};
  return [&progress, mutex = std::make_shared<std::mutex>()](std::string_view stage, double fraction) {
    const std::lock_guard lock(*mutex);
    progress(stage, fraction);
  };
}

struct SegmentedViews {
  std::vector<Silhouette> silhouettes;
  std::vector<std::string> warnings;
  std::vector<CameraHealth> health;  ///< in the order of the silhouettes
};

/// Develops raw frames where they are. @error invalid_argument  as develop
Result<void> develop_all(std::span<FrameSet> sets, const Work& work) {
  std::vector<Frame*> frames;
  for (FrameSet& set : sets)
    for (Frame& frame : set.frames) frames.push_back(&frame);
  std::vector<std::optional<Error>> faults(frames.size());
  work.parallel_for(frames.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !work.stopped(); ++i) {
      if (!frames[i]->mosaic) continue;
      auto frame = develop(*frames[i]);
      if (frame)
        *frames[i] = *std::move(frame);
      else
        faults[i] = frame.error();
    }
  });
  if (work.stopped()) return Work::cancelled();
  for (const auto& fault : faults)
    if (fault) return *fault;
  return {};
}

/// What one frame shows.
struct SegmentedView {
  Segmentation segmentation;
  BackgroundMotion motion;
};
Result<SegmentedView> look_at(const CaptureFrames& capture, const Frame& frame, const SegmentationOptions& options,
                              const Work& work) {
  const auto empty = std::find_if(capture.background.begin(), capture.background.end(),
                                  [&](const EmptyView& view) { return view.camera == frame.camera; });
  if (empty == capture.background.end())
    return Error{ErrorCode::no_background, "camera " + frame.camera + ": no background frame"};
  auto segmentation = segment(*empty, frame, options, work);
  if (!segmentation) return segmentation.error();
  BackgroundMotion motion;
  if (const RigCamera* camera = capture.rig.find(frame.camera)) {
    const auto registered =
        register_background(empty->mean, frame, segmentation->silhouette.coverage, camera->intrinsics);
    if (!registered) return registered.error();
    motion = *registered;
  }
  return SegmentedView{std::move(*segmentation), motion};
}

/// Segments every camera that can be; a camera that cannot is left out and said in the warnings. When nothing is
/// left, the first camera's reason is the error.
Result<SegmentedViews> segment_all(const CaptureFrames& capture, std::span<const Frame> frames,
                                   const SegmentationOptions& options, const Work& work) {
  std::vector<std::optional<Result<SegmentedView>>> results(frames.size());
  const Work inside{.stop = work.stop, .progress = {}, .parallel = work.parallel};
  work.parallel_for(frames.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i)
      if (!inside.stopped()) results[i] = look_at(capture, frames[i], options, inside);
  });
  if (work.stopped()) return Work::cancelled();

  SegmentedViews views;
  for (const RigCamera& camera : capture.rig.cameras) {
    const auto of_camera = [&](const Frame& frame) { return frame.camera == camera.id; };
    if (camera.role == CameraRole::body && std::none_of(frames.begin(), frames.end(), of_camera))
      views.warnings.push_back("camera " + camera.id +
                               " has no picture of the subject; the avatar was made without it");
  }
  std::optional<Error> first_error;
  for (size_t i = 0; i < frames.size(); ++i) {
    Result<SegmentedView>& result = *results[i];
    if (!result) {
      views.warnings.push_back("camera " + frames[i].camera + " was left out: " + result.error().message);
      if (!first_error) first_error = result.error();
      continue;
    }
    Segmentation& segmentation = result->segmentation;
    views.silhouettes.push_back(std::move(segmentation.silhouette));
    views.health.push_back({.camera = frames[i].camera,
                            .light_factor = segmentation.light_factor,
                            .shifted = result->motion.moved,
                            .background_px = result->motion.shift_px,
                            .background_share = segmentation.background_share});
    views.warnings.insert(views.warnings.end(), segmentation.warnings.begin(), segmentation.warnings.end());
  }
  if (views.silhouettes.empty())
    return first_error.value_or(Error{ErrorCode::too_few_views, "the capture holds no usable body image"});
  return views;
}

/// Tells what segmentation and, where there is one, the hull found out about the cameras.
void tell_health(std::vector<CameraHealth> cameras, const std::vector<CameraAgreement>& agreement,
                 const HealthReport& health) {
  if (!health) return;
  for (CameraHealth& camera : cameras)
    for (const CameraAgreement& found : agreement)
      if (found.camera == camera.camera) {
        camera.moved = found.moved;
        camera.offset_px = found.offset_px;
        camera.deviation = found.deviation;
      }
  health(cameras);
}

/// What a face was fitted from and to.
struct FittedFace {
  std::shared_ptr<const NeutralHead> neutral;
  FittedHead head;
  FacePatch patch;  ///< which goes over into the hull
};

/// The face's own surface as a mesh.
struct FaceSurface {
  FaceMode made = FaceMode::none;  ///< active: scanned; passive: fitted
  HeadRegion head;                 ///< of the hull
  ScanMesh scan;
  Eigen::Vector3f eye;            ///< where it was seen from, world frame
  std::optional<FittedFace> fit;  ///< of a passive one
};

/// The pictures of the body shot, a camera's with the whole face lit by the projector in place of it: that is where the
/// face was when it was scanned.
std::vector<Frame> with_lit_face(std::span<const Frame> frames, const std::optional<GrayCodeCapture>& face) {
  std::vector<Frame> pictures(frames.begin(), frames.end());
  if (!face) return pictures;
  const int all_white = pattern_count(face->pattern) - 2;
  for (const FrameSet& set : face->sets) {
    if (set.index != all_white) continue;
    for (const Frame& lit : set.frames) {
      std::erase_if(pictures, [&](const Frame& frame) { return frame.camera == lit.camera; });
      pictures.push_back(lit);
    }
  }
  return pictures;
}

/// The head about a face that was scanned, by shape and, where there is a detector, by sight.
std::optional<HeadRegion> find_scanned_head(const Rig& rig, std::span<const Frame> pictures, const Mesh& surface,
                                            const FaceDetectorSource& source, const Work& work,
                                            std::vector<std::string>* warnings) {
  if (!source) return find_head(surface);
  const auto detector = source();
  if (!detector) {
    warnings->push_back("the head was found by the body's shape alone: " + detector.error().message);
    return find_head(surface);
  }
  return find_head(surface, rig, pictures, **detector, work);
}

Result<FaceSurface> scan_face(const Rig& rig, const FaceCapture& capture, std::span<const Frame> frames,
                              std::span<const Silhouette> silhouettes, const Field& hull,
                              const ReconstructionOptions& options, const FaceDetectorSource& detector,
                              const Work& work, std::vector<std::string>* warnings) {
  const Mesh surface = extract_surface(hull, work);
  const auto head = find_scanned_head(rig, with_lit_face(frames, capture.patterns), surface, detector, work, warnings);
  if (!head) return Error{ErrorCode::no_subject, "no head was found"};
  if (capture.scan) {
    const auto placed = place_external_scan(*capture.scan, surface, *head, work);
    auto meshed = placed ? mesh_scan(placed->scan, {}, work) : placed.error();
    if (meshed) return FaceSurface{FaceMode::active, *head, std::move(*meshed), placed->eye, {}};
    const Error refused{meshed.error().code, "the scan in the face's file is not used: " + meshed.error().message};
    if (!capture.patterns) return refused;
    warnings->push_back(refused.message);
  }
  auto scanned =
      scan_structured_light(rig, *capture.patterns, silhouettes, head->box(), options.structured_light, work);
  if (!scanned) return scanned.error();
  warnings->insert(warnings->end(), scanned->warnings.begin(), scanned->warnings.end());
  auto meshed = mesh_scan(scanned->scan, {}, work);
  if (!meshed) return meshed.error();
  return FaceSurface{FaceMode::active, *head, std::move(*meshed), scanned->eye, {}};
}

/// The face by landmarks and a neutral head.
Result<FaceSurface> fit_face(const VisualHull& hull, std::span<const Frame> frames,
                             const ReconstructionOptions& options, const FaceModelSource& face_model,
                             const Work& work) {
  if (!face_model) return Error{ErrorCode::not_found, "there is no model of landmarks"};
  const auto model = face_model();
  if (!model) return model.error();
  const Mesh surface = extract_surface(hull.field, work);
  const auto head = find_head(surface);
  if (!head) return Error{ErrorCode::no_subject, "no head was found"};
  const auto controls = find_control_points(*hull.rig, frames, *head, *model->landmarks, options.control_points, work);
  if (!controls) return controls.error();
  const std::vector<FacePicture> pictures = face_pictures(*hull.rig, frames, controls->frame, work);
  auto fitted = fit_neutral_head(*model->neutral, *controls, pictures, hull.views, hull.field, options.head_fit, work);
  if (!fitted) return fitted.error();
  FacePatch patch = face_patch(*fitted);
  if (patch.core.mesh.triangles.empty())
    return Error{ErrorCode::no_subject, "hair or something else covers most of the face"};
  const FaceEvidence evidence = weigh_face(pictures, *controls, surface, patch, hull.views, work);
  if (work.stopped()) return Work::cancelled();
  if (const auto objection = evidence.objection()) return Error{ErrorCode::no_subject, *objection};
  const Eigen::Vector3f eye = patch.eye;
  ScanMesh core = std::move(patch.core);
  return FaceSurface{FaceMode::passive, *head, std::move(core), eye,
                     FittedFace{model->neutral, std::move(*fitted), std::move(patch)}};
}

/// What was recorded of the face, as far as that is of use.
Result<FaceCapture> get_face_capture(FaceMode mode, const FaceCaptureSource& source, const Work& work) {
  if (!wants_scan(mode) || !source) return FaceCapture{};
  auto capture = source();
  if (!capture || !capture->patterns) return capture;
  if (const auto developed = develop_all(capture->patterns->sets, work); !developed) return developed.error();
  return capture;
}

/// The face as asked for, or nothing and in the warnings why.
std::optional<FaceSurface> make_face(const Rig& rig, const FaceCapture& capture, const VisualHull& hull,
                                     std::span<const Frame> frames, std::span<const Silhouette> silhouettes,
                                     const ReconstructionOptions& options, const FaceSources& sources, const Work& work,
                                     std::vector<std::string>* warnings) {
  if (options.face == FaceMode::none) return std::nullopt;
  if (capture.patterns || capture.scan) {
    auto scanned = scan_face(rig, capture, frames, silhouettes, hull.field, options, sources.detector, work, warnings);
    if (scanned) return std::move(*scanned);
    const bool fits = options.face == FaceMode::automatic && sources.model;
    warnings->push_back((fits ? "the face was not scanned: " : "the face is the hull's own: ") +
                        scanned.error().message);
    if (!fits) return std::nullopt;
  } else if (options.face == FaceMode::active) {
    warnings->emplace_back("the face is the hull's own: the recording has no structured-light shot");
    return std::nullopt;
  } else if (options.face == FaceMode::automatic && !sources.model) {
    return std::nullopt;
  }
  auto fitted = fit_face(hull, frames, options, sources.model, work);
  if (fitted) return std::move(*fitted);
  warnings->push_back("the face is the hull's own: " + fitted.error().message);
  return std::nullopt;
}

/// Whether the face is cut out of the hull's mesh and another sewn in. Scans are too ragged for that.
bool is_sewn(const FaceSurface& face, const ReconstructionOptions& options) {
  return face.made == FaceMode::passive && options.face_merge.method == FaceMergeMethod::sewing;
}

/// The face in the hull's field, where it is not to be joined as a mesh.
void join_face(Field* field, const FaceSurface& face, const ReconstructionOptions& options, const Work& work) {
  const Step step(work, "surface: face");
  if (face.made == FaceMode::passive) {
    if (!is_sewn(face, options))
      *field = blend_surface(*field, face.fit->patch.mesh, face.fit->patch.weight, face.eye, work);
  } else if (options.face_merge.method != FaceMergeMethod::radial) {
    *field = fuse_scan(*field, face.head, face.scan, face.eye, work);
  }
  keep_largest_part(*field, work);
}

/// The closed surface within its budget of triangles, with the face's scan where there is one that meets it.
Mesh make_surface(const Field& field, const FaceSurface* face, const ReconstructionOptions& options, const Work& work,
                  std::vector<std::string>* warnings, FaceMode* made) {
  const Mesh mesh = [&] {
    const Step step(work, "surface: extraction");
    return smooth_hc(extract_surface(field, work), options.smoothing, work);
  }();
  const Step step(work, "surface: decimation");
  if (face == nullptr) return decimate(mesh, options.decimation, work);
  if (is_sewn(*face, options)) {
    auto sewn = sew_face(mesh, face->fit->patch);
    if (sewn) {
      *made = face->made;
      return decimate(sewn->mesh, sewn->face, options.face_share, options.decimation, work);
    }
    warnings->push_back("the face is the hull's own: " + sewn.error().message);
    return decimate(mesh, options.decimation, work);
  }
  auto merged = merge_face(mesh, face->head, face->scan, face->eye, options.face_merge, work);
  if (!merged) {
    warnings->push_back("the face is the hull's own: " + merged.error().message);
    return decimate(mesh, options.decimation, work);
  }
  *made = face->made;
  return decimate(merged->mesh, merged->face, options.face_share, options.decimation, work);
}

/// One a vertex: 1 in the box, which a scan made more exact than photographs can.
std::vector<uint8_t> inside(const Eigen::AlignedBox3d& box, const Mesh& mesh) {
  std::vector<uint8_t> in_box;
  for (const Eigen::Vector3f& p : mesh.positions) in_box.push_back(box.contains(p.cast<double>()) ? 1 : 0);
  return in_box;
}

/// A skeleton and its weights, or neither and why: a shape that cannot be rigged is still worth having.
struct Rigging {
  Skeleton skeleton;
  Skin skin;
  std::vector<std::string> warnings;
};
Result<Rigging> rig_surface(const Mesh& mesh, const ReconstructionOptions& options, const Work& work,
                            const StageProgress& progress) {
  const auto unrigged = [](const Error& error) -> Result<Rigging> {
    if (error.code == ErrorCode::cancelled) return error;
    return Rigging{{}, {}, {"the avatar is not rigged: " + error.message}};
  };
  Rigging rigging;
  {
    const StageReport report("skeleton", work, progress);
    auto fitted = fit_skeleton(mesh, options.skeleton, report.work());
    if (!fitted) return unrigged(fitted.error());
    rigging.skeleton = std::move(fitted->skeleton);
    rigging.warnings = std::move(fitted->warnings);
  }
  const StageReport report("skin", work, progress);
  auto skin = compute_skin(mesh, rigging.skeleton, options.skinning, report.work());
  if (!skin) return unrigged(skin.error());
  rigging.skin = std::move(*skin);
  return rigging;
}

}  // namespace

std::string_view to_string(FaceMode mode) {
  const auto found = std::find_if(face_mode_names.begin(), face_mode_names.end(),
                                  [&](const auto& entry) { return entry.first == mode; });
  return found->second;
}

std::optional<FaceMode> face_mode_from(std::string_view name) {
  for (const auto& [mode, word] : face_mode_names)
    if (word == name) return mode;
  return std::nullopt;
}

bool wants_scan(FaceMode mode) { return mode == FaceMode::active || mode == FaceMode::automatic; }

EmptyBooth learn_empty_booth(std::span<const FrameSet> background, const Work& work) {
  std::map<std::string, std::vector<const Frame*>> by_camera;
  for (const FrameSet& set : background)
    for (const Frame& frame : set.frames) by_camera[frame.camera].push_back(&frame);
  const std::vector<std::pair<std::string, std::vector<const Frame*>>> cameras(by_camera.begin(), by_camera.end());
  std::vector<std::optional<Result<EmptyView>>> learned(cameras.size());
  work.parallel_for(cameras.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) {
      std::vector<Frame> frames;
      for (const Frame* frame : cameras[i].second) {
        auto developed = develop(*frame);
        if (!developed) {
          learned[i] = developed.error();
          break;
        }
        frames.push_back(std::move(*developed));
      }
      if (!learned[i]) learned[i] = learn_empty_view(frames);
    }
  });
  EmptyBooth booth;
  for (auto& view : learned)
    if (*view)
      booth.views.push_back(std::move(**view));
    else
      booth.faults.push_back(view->error().message);
  return booth;
}

const std::vector<std::string>& reconstruction_stages() {
  static const std::vector<std::string> stages{"segmentation", "hull",  "refine",   "face",
                                               "surface",      "atlas", "skeleton", "skin"};
  return stages;
}

Result<Reconstruction> reconstruct(CaptureFrames capture, const ReconstructionOptions& options,
                                   const FaceSources& sources, const Work& work, const StageProgress& sink,
                                   const HealthReport& health) {
  const StageProgress progress = one_at_a_time(sink);
  if (const auto developed = develop_all({&capture.body, 1}, work); !developed) return developed.error();
  if (const auto checked = check(capture.rig); !checked) return checked.error();
  Reconstruction result;
  std::vector<std::string>& warnings = result.warnings;
  // The order in which cameras delivered is chance.
  std::vector<Frame> frames = std::move(capture.body.frames);
  std::sort(frames.begin(), frames.end(), [](const Frame& a, const Frame& b) { return a.camera < b.camera; });

  SegmentedViews views;
  {
    const StageReport report("segmentation", work, progress);
    auto segmented = segment_all(capture, frames, options.segmentation, report.work());
    if (!segmented) return segmented.error();
    views = std::move(*segmented);
    warnings = std::move(views.warnings);
    capture.background = {};
  }

  VisualHull hull;
  {
    const StageReport report("hull", work, progress);
    auto carved = carve_visual_hull(capture.rig, views.silhouettes, options.hull, report.work());
    tell_health(views.health, carved ? carved->agreement : std::vector<CameraAgreement>(), health);
    if (!carved) return carved.error();
    hull = std::move(*carved);
    result.cameras = std::move(hull.cameras);
    warnings.insert(warnings.end(), hull.warnings.begin(), hull.warnings.end());
  }

  {
    const StageReport report("refine", work, progress);
    hull.field = refine_shape(std::move(hull.field), hull.views, frames, options.refinement, report.work());
    if (work.stopped()) return Work::cancelled();
  }

  std::optional<FaceSurface> face;
  {
    const StageReport report("face", work, progress);
    const auto recorded = get_face_capture(options.face, sources.capture, report.work());
    if (!recorded) return recorded.error();
    face =
        make_face(capture.rig, *recorded, hull, frames, views.silhouettes, options, sources, report.work(), &warnings);
    hull.views.clear();
    if (work.stopped()) return Work::cancelled();
  }

  Avatar& avatar = result.avatar;
  {
    const StageReport report("surface", work, progress);
    if (face) join_face(&hull.field, *face, options, report.work());
    {
      const Step step(work, "surface: handles");
      remove_small_handles(hull.field, options.handles, report.work());
    }
    avatar.mesh = make_surface(hull.field, face ? &*face : nullptr, options, report.work(), &warnings, &result.face);
    const Step step(work, "surface: untangling");
    if (const size_t left = remove_self_intersections(&avatar.mesh, report.work()); left > 0)
      warnings.push_back("the surface passes through itself at " + std::to_string(left) + " edges");
    if (result.face == FaceMode::passive)
      avatar.morphs =
          carry_expressions(*face->fit->neutral, face->fit->head, face->fit->patch, avatar.mesh, report.work());
    hull.field = {};
    if (work.stopped()) return Work::cancelled();
    if (avatar.mesh.triangles.empty()) return Error{ErrorCode::no_subject, "no surface is left after carving"};
  }

  Result<TextureAtlas> textured = Work::cancelled();
  Result<Rigging> rigged = Work::cancelled();
  const auto texture = [&] {
    const StageReport report("atlas", work, progress);
    textured = build_texture_atlas(avatar.mesh, *hull.rig, frames, views.silhouettes, options.atlas, report.work(),
                                   face ? inside(face->head.box(), avatar.mesh) : std::vector<uint8_t>{});
  };
  work.both(texture, [&] { rigged = rig_surface(avatar.mesh, options, work, progress); });
  if (!textured) return textured.error();
  if (!rigged) return rigged.error();
  avatar.mesh.positions = std::move(textured->positions);
  remove_self_intersections(&avatar.mesh, work);
  avatar.atlas = std::move(textured->atlas);
  avatar.skeleton = std::move(rigged->skeleton);
  avatar.skin = std::move(rigged->skin);
  warnings.insert(warnings.end(), textured->warnings.begin(), textured->warnings.end());
  warnings.insert(warnings.end(), rigged->warnings.begin(), rigged->warnings.end());
  return result;
}

}  // namespace booth
