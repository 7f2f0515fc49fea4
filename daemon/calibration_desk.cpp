#include "daemon/calibration_desk.h"

#include <fcntl.h>
#include <poll.h>
#include <spdlog/spdlog.h>
#include <sys/stat.h>
#include <sys/wait.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <cstdio>
#include <ctime>
#include <nlohmann/json.hpp>
#include <system_error>
#include <utility>

#include "daemon/child_output.h"
#include "daemon/child_process.h"
#include "daemon/identifier.h"
#include "replay/durable_folder.h"
#include "replay/recording.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::json;
using SteadyClock = std::chrono::steady_clock;

constexpr int most_shots = 500;  ///< of a calibration; forgotten ones must not fill the disk
constexpr std::chrono::milliseconds step{50};
constexpr size_t largest_file = size_t{64} << 20;
constexpr const char* session_name = "session";
constexpr const char* reports_name = "reports";
constexpr std::string_view dropped_prefix = "dropped-";
constexpr std::string_view replaced_prefix = "rig-";
constexpr std::string_view replaced_suffix = ".json";

ErrorCode code_from(const std::string& kind) {
  for (const ErrorCode code :
       {ErrorCode::invalid_argument, ErrorCode::invalid_file, ErrorCode::not_found, ErrorCode::io, ErrorCode::disk_full,
        ErrorCode::too_few_views, ErrorCode::cancelled, ErrorCode::invalid_state})
    if (kind == to_string(code)) return code;
  return ErrorCode::internal;
}

Result<std::string> read_text(const fs::path& file) {
  const auto bytes = read_file(file, largest_file);
  if (!bytes) return bytes.error();
  return std::string(bytes->begin(), bytes->end());
}

/// When a file was written; empty where it is not there.
std::string written_at(const fs::path& file) {
  struct stat status {};
  if (::stat(file.c_str(), &status) != 0) return {};
  return iso8601(std::chrono::system_clock::from_time_t(status.st_mtime));
}

/// Gives a file the time that says since when its rig was in force. Where it cannot, the status is off, and nothing
/// else.
void set_written_at(const fs::path& file, const std::string& created) {
  const auto instant = parse_iso8601(created);
  if (!instant) return;
  const timespec time{.tv_sec = std::chrono::system_clock::to_time_t(*instant), .tv_nsec = 0};
  const std::array<timespec, 2> times{time, time};
  if (::utimensat(AT_FDCWD, file.c_str(), times.data(), 0) != 0)
    spdlog::warn("{}: {}", file.string(), std::generic_category().message(errno));
}

/// What stands in for intrinsics that nobody has measured yet.
Intrinsics nominal_intrinsics(int width, int height) {
  constexpr double usual_focal = 1.2;  // of the longer side
  const double focal = usual_focal * std::max(width, height);
  return {
      .width = width, .height = height, .fx = focal, .fy = focal, .cx = 0.5 * (width - 1), .cy = 0.5 * (height - 1)};
}

/// The rig of a shot's recording: who is there, with the calibration that is known, or a nominal one.
Rig rig_of_shot(const BoardPictures& pictures, const std::vector<BoothDevice>& devices, const std::string& projector,
                const Rig* known) {
  Rig rig;
  rig.name = known != nullptr ? known->name : "booth";
  rig.volume = known != nullptr ? known->volume
                                : Eigen::AlignedBox3d(Eigen::Vector3d(-0.9, 0.0, -0.6), Eigen::Vector3d(0.9, 2.2, 0.6));
  for (const BoothDevice& device : devices) {
    const auto frame = std::find_if(pictures.frames.begin(), pictures.frames.end(),
                                    [&](const Frame& f) { return f.camera == device.id; });
    const RigCamera* before = known != nullptr ? known->find(device.id) : nullptr;
    const bool delivered = frame != pictures.frames.end();
    RigCamera camera;
    if (before != nullptr && (!delivered || (before->intrinsics.width == frame->pixels->width &&
                                             before->intrinsics.height == frame->pixels->height)))
      camera = *before;
    else if (delivered)
      camera.intrinsics = nominal_intrinsics(frame->pixels->width, frame->pixels->height);
    else
      continue;  // nothing is known of it
    camera.id = device.id;
    camera.role = device.role;
    camera.mount_rotation_deg = device.mount_rotation_deg;
    rig.cameras.push_back(std::move(camera));
  }
  if (projector.empty()) return rig;
  if (known != nullptr && known->projector && known->projector->id == projector) rig.projector = known->projector;
  if (pictures.pattern && (!rig.projector || rig.projector->intrinsics.width != pictures.pattern->width ||
                           rig.projector->intrinsics.height != pictures.pattern->height)) {
    rig.projector = CalibratedView{};
    rig.projector->id = projector;
    rig.projector->intrinsics = nominal_intrinsics(pictures.pattern->width, pictures.pattern->height);
  }
  return rig;
}

bool is_name_of_replaced(const std::string& name) {
  return name.size() > replaced_prefix.size() + replaced_suffix.size() && name.starts_with(replaced_prefix) &&
         name.ends_with(replaced_suffix) && is_safe_id(name);
}

}  // namespace

/// Keeps the desk to one thing at a time.
class CalibrationDesk::Occupied {
 public:
  explicit Occupied(CalibrationDesk& desk) : desk_(desk) {}
  ~Occupied() { desk_.release(); }
  Occupied(const Occupied&) = delete;
  Occupied& operator=(const Occupied&) = delete;

 private:
  CalibrationDesk& desk_;
};

CalibrationDesk::CalibrationDesk(CalibrationDeskOptions options, TaskBoard& tasks, std::function<RigInForce()> in_force,
                                 std::function<void(const RigInForce&)> put)
    : options_(std::move(options)),
      tasks_(tasks),
      in_force_(std::move(in_force)),
      put_(std::move(put)),
      session_(options_.folder / session_name) {}

CalibrationDesk::~CalibrationDesk() {
  {
    const std::lock_guard lock(mutex_);
    solving_.request_stop();
  }
  solver_.reset();
}

Result<std::unique_ptr<CalibrationDesk>> CalibrationDesk::open(CalibrationDeskOptions options, TaskBoard& tasks,
                                                               std::function<RigInForce()> in_force,
                                                               std::function<void(const RigInForce&)> put) {
  std::unique_ptr<CalibrationDesk> desk(
      new CalibrationDesk(std::move(options), tasks, std::move(in_force), std::move(put)));
  if (const auto taken = desk->take_up(); !taken) return taken.error();
  return desk;
}

/// Goes on where an earlier process was.
Result<void> CalibrationDesk::take_up() {
  std::error_code code;
  fs::create_directories(options_.folder, code);
  if (code) return Error{ErrorCode::io, options_.folder.string() + ": cannot be made: " + code.message()};
  for (const fs::path& folder : {options_.folder, session_.folder(), session_.shots_folder()})
    if (const auto removed = remove_partial_folders(folder); !removed) return removed.error();
  constexpr size_t most_waiting = 8;
  solver_ = std::make_unique<SerialExecutor>("calibrate", most_waiting);
  for (fs::directory_iterator entry(options_.folder, code), end; !code && entry != end; entry.increment(code))
    if (const std::string name = entry->path().filename().string(); name.starts_with(dropped_prefix))
      if (const auto removed = remove_folder(options_.folder, name); !removed) return removed;
  const auto solved = read_solution();
  // It was put in force, and the process ended before it could tidy up.
  const auto current = read_text(rig_file()), applied = read_text(session_.solution() / rig_file().filename());
  if (current && applied && *current == *applied) return remove_folder(options_.folder, session_name);
  count_shots();
  const std::lock_guard lock(mutex_);
  if (solved) solution_ = *solved;
  if (const auto look = read_text(session_.look_file())) {
    const Json json = Json::parse(*look, nullptr, false);
    enough_ = json.is_object() && json.value("enough", false);
  }
  return {};
}

void CalibrationDesk::count_shots() {
  const auto shots = static_cast<int>(session_.shots().size());
  const std::lock_guard lock(mutex_);
  shots_ = shots;
}

Result<void> CalibrationDesk::check_free() const {
  const std::lock_guard lock(mutex_);
  switch (occupation_) {
    case Occupation::none: break;
    case Occupation::looking: return Error{ErrorCode::busy, "a shot of the board is being looked at"};
    case Occupation::solving: return Error{ErrorCode::busy, "the calibration is being solved"};
    case Occupation::changing: return Error{ErrorCode::busy, "the calibration is being changed"};
  }
  return {};
}

Result<void> CalibrationDesk::occupy(Occupation occupation) {
  if (const auto free = check_free(); !free) return free;
  const std::lock_guard lock(mutex_);
  if (occupation_ != Occupation::none) return Error{ErrorCode::busy, "the calibration is busy; try again in a moment"};
  occupation_ = occupation;
  return {};
}

void CalibrationDesk::release() {
  {
    const std::lock_guard lock(mutex_);
    occupation_ = Occupation::none;
  }
  released_.notify_all();
}

/// Runs the program to its end.
Result<void> CalibrationDesk::run(const std::vector<std::string>& arguments, const std::stop_token& stop,
                                  const std::function<void()>& alive,
                                  const std::function<void(double)>& progress) const {
  std::vector<std::string> command{options_.command};
  command.insert(command.end(), arguments.begin(), arguments.end());
  command.insert(command.end(), {"--progress-fd", "3"});
  auto child = ChildProcess::start(command);
  if (!child) return Error{ErrorCode::internal, child.error().message};
  LineReader lines;
  Tail output;
  std::optional<Error> error;
  const auto on_line = [&](const std::string& line) {
    const Json json = Json::parse(line, nullptr, false);
    if (!json.is_object()) return;
    if (const auto fault = json.find("error"); fault != json.end() && fault->is_object())
      error = Error{code_from(fault->value("kind", "")), fault->value("message", "it did not say why")};
    else if (const auto fraction = json.find("fraction"); fraction != json.end() && fraction->is_number())
      progress(fraction->get<double>());
  };
  const auto deadline = SteadyClock::now() + options_.timeout;
  bool progress_open = true, output_open = true;
  for (;;) {
    alive();
    std::array<pollfd, 2> polled{pollfd{progress_open ? child->progress() : -1, POLLIN, 0},
                                 pollfd{output_open ? child->output() : -1, POLLIN, 0}};
    ::poll(polled.data(), polled.size(), static_cast<int>(step.count()));
    if (progress_open) progress_open = lines.read(child->progress(), on_line);
    if (output_open) output_open = output.read(child->output());
    if (const auto status = child->poll_status()) {
      if (progress_open) lines.read(child->progress(), on_line);
      if (output_open) output.read(child->output());
      if (WIFEXITED(*status) && WEXITSTATUS(*status) == 0) return {};
      if (error) return *error;
      return Error{ErrorCode::internal,
                   "the process of the calibration " +
                       (WIFSIGNALED(*status) ? "was killed by signal " + std::to_string(WTERMSIG(*status))
                                             : "ended with status " + std::to_string(WEXITSTATUS(*status))) +
                       (output.last_line().empty() ? "" : ": " + output.last_line())};
    }
    if (stop.stop_requested()) return Error{ErrorCode::cancelled, "the calibration was stopped"};
    if (SteadyClock::now() >= deadline)
      return Error{ErrorCode::timeout, "the calibration took longer than " + std::to_string(options_.timeout.count()) +
                                           " s and was stopped"};
  }
}

/// @return the shot's name
Result<std::string> CalibrationDesk::store(const BoardPictures& pictures, const std::vector<BoothDevice>& devices,
                                           const std::string& projector) const {
  const std::vector<std::string> shots = session_.shots();
  int latest = 0;
  if (!shots.empty()) std::from_chars(shots.back().data(), shots.back().data() + shots.back().size(), latest);
  const int number = latest + 1;
  if (number > most_shots)
    return Error{ErrorCode::invalid_state,
                 "the calibration has " + std::to_string(most_shots) + " shots: solve it, or discard it"};
  std::array<char, 16> name{};
  std::snprintf(name.data(), name.size(), "%03d", number);
  const auto known = in_force_().rig;
  auto writer = RecordingWriter::begin(
      session_.shots_folder(),
      {.id = name.data(), .created = iso8601(std::chrono::system_clock::now()), .label = {}, .face = {}},
      rig_of_shot(pictures, devices, projector, known.get()), options_.images);
  if (!writer) return writer.error();
  const std::string board = pictures.floor ? "floor" : "board";
  if (const auto begun = (*writer)->begin_shot(
          {.name = board, .role = ShotRole::calibration_board, .pattern = {}, .board = options_.board});
      !begun)
    return begun.error();
  for (Frame frame : pictures.frames) {
    frame.index = 0;
    if (const auto added = (*writer)->add(board, frame); !added) return added.error();
  }
  if (pictures.pattern && !pictures.patterns.empty()) {
    constexpr const char* lit = "board-0";
    if (const auto begun =
            (*writer)->begin_shot({.name = lit, .role = ShotRole::gray_code, .pattern = pictures.pattern, .board = {}});
        !begun)
      return begun.error();
    for (const Frame& frame : pictures.patterns)
      if (const auto added = (*writer)->add(lit, frame); !added) return added.error();
  }
  if (const auto committed = (*writer)->commit(); !committed) return committed.error();
  return std::string(name.data());
}

Result<std::string> CalibrationDesk::add(const BoardPictures& pictures, const std::vector<BoothDevice>& devices,
                                         const std::string& projector, const std::vector<std::string>& missing,
                                         const std::stop_token& stop, const std::function<void()>& alive) {
  if (const auto occupied = occupy(Occupation::looking); !occupied) return occupied.error();
  const Occupied until_end(*this);
  const auto shot = store(pictures, devices, projector);
  if (!shot) return shot.error();
  alive();
  const auto looked = run({"look", session_.folder()}, stop, alive, [](double) {});
  const auto text = looked ? read_text(session_.look_file()) : looked.error();
  Json json = text ? Json::parse(*text, nullptr, false) : Json();
  if (!json.is_object()) {
    // The next one would fail by it too.
    if (const auto removed = remove_folder(session_.shots_folder(), *shot); !removed)
      spdlog::error("{}", removed.error().message);
    if (!text) return text.error();
    return Error{ErrorCode::internal, session_.look_file().string() + ": is no JSON object"};
  }
  const std::lock_guard lock(mutex_);
  shots_ = json.value("shots", shots_ + 1);
  enough_ = json.value("enough", false);
  json["missing"] = missing;
  return json.dump();
}

Result<std::string> CalibrationDesk::solve(bool keep_unseen) {
  {
    const std::lock_guard lock(mutex_);
    if (occupation_ == Occupation::none && shots_ == 0)
      return Error{ErrorCode::invalid_state, "there are no shots of the board yet: take some with calibration.capture"};
  }
  if (const auto occupied = occupy(Occupation::solving); !occupied) return occupied.error();
  std::stop_token stop;
  {
    const std::lock_guard lock(mutex_);
    solution_.reset();
    solving_ = {};
    stop = solving_.get_token();
  }
  const std::string task = tasks_.begin(TaskKind::calibration_solve);
  const bool taken = solver_->post([this, task, keep_unseen, stop] {
    Result<Solution> solved = Error{ErrorCode::internal, "the calibration's program has a fault"};
    try {
      solved = carry_out(task, keep_unseen, stop);
    } catch (const std::exception& fault) {
      solved = Error{ErrorCode::internal, "the booth's program has a fault: " + std::string(fault.what())};
    }
    if (solved) {
      const std::lock_guard lock(mutex_);
      solution_ = *solved;
    }
    // Before listeners hear of the end, and ask for what follows.
    release();
    if (solved)
      tasks_.finish(task, TaskResult(CalibrationReport{solved->json}));
    else
      tasks_.finish(task, solved.error());
  });
  if (taken) return task;
  release();
  const Error busy{ErrorCode::busy, "the calibration is being solved"};
  tasks_.finish(task, busy);
  return busy;
}

Result<CalibrationDesk::Solution> CalibrationDesk::carry_out(const std::string& task, bool keep_unseen,
                                                             const std::stop_token& stop) {
  if (const auto removed = remove_folder(session_.folder(), session_.solution().filename()); !removed)
    return removed.error();
  std::vector<std::string> arguments{"solve", session_.folder()};
  if (const auto known = in_force_().rig) {
    const fs::path previous = session_.folder() / "previous.json";
    if (const auto written = write_file_atomically(previous, write_rig_json(*known)); !written) return written.error();
    arguments.insert(arguments.end(), {"--previous", previous});
    if (keep_unseen) arguments.emplace_back("--keep-unseen");
  }
  double told = 0;
  constexpr double worth_telling = 0.01;
  const auto solved = run(
      arguments, stop, [] {},
      [&](double fraction) {
        if (fraction < told + worth_telling) return;
        told = fraction;
        tasks_.progress(task, fraction);
      });
  if (!solved) return solved.error();
  return read_solution();
}

Result<CalibrationDesk::Solution> CalibrationDesk::read_solution() const {
  const auto text = read_text(session_.solution() / "calibration.json");
  if (!text) return text.error();
  try {
    const Json figures = Json::parse(*text);
    Json result{{"verdict", figures.at("verdict")},
                {"reason", figures.at("reason")},
                {"rms_px", figures.at("rms_px")},
                {"cameras", Json::array()},
                {"projector", nullptr},
                {"messages", figures.at("messages")},
                {"report", (session_.solution() / "report.html").string()},
                {"rig", (session_.solution() / rig_file().filename()).string()}};
    for (Json device : figures.at("devices")) {
      const bool projector = device.at("projector").get<bool>();
      device.erase("projector");
      if (projector)
        result["projector"] = std::move(device);
      else
        result["cameras"].push_back(std::move(device));
    }
    return Solution{figures.at("verdict").get<std::string>(), figures.at("reason").get<std::string>(), result.dump()};
  } catch (const Json::exception& fault) {
    return Error{ErrorCode::invalid_file, session_.solution().string() + ": calibration.json: " + fault.what()};
  }
}

/// Puts a rig in force on the disk and then for the booth. The one before it is kept beside it first, so that at any
/// instant there is a whole rig.json, and nothing is lost.
Result<void> CalibrationDesk::replace(const Rig& rig, const std::string& created) {
  const RigInForce before = in_force_();
  std::optional<fs::path> kept;
  if (before.rig != nullptr) {
    kept = options_.folder / (std::string(replaced_prefix) + make_capture_id(std::chrono::system_clock::now()) +
                              std::string(replaced_suffix));
    if (const auto written = write_file_atomically(*kept, write_rig_json(*before.rig)); !written) return written;
    set_written_at(*kept, before.created);
  }
  if (const auto written = write_file_atomically(rig_file(), write_rig_json(rig)); !written) {
    std::error_code ignored;  // a copy more does no harm
    if (kept) fs::remove(*kept, ignored);
    return written;
  }
  set_written_at(rig_file(), created);
  put_({std::make_shared<const Rig>(rig), created});
  return {};
}

Result<void> CalibrationDesk::apply(bool force) {
  if (const auto occupied = occupy(Occupation::changing); !occupied) return occupied;
  const Occupied until_end(*this);
  {
    const std::lock_guard lock(mutex_);
    if (!solution_)
      return Error{ErrorCode::invalid_state, "there is no solved calibration: solve one with calibration.solve"};
    if (solution_->verdict == "bad" && !force)
      return Error{ErrorCode::invalid_state, "the calibration is bad and is not applied: " + solution_->reason};
  }
  const auto rig = read_rig(session_.solution() / rig_file().filename());
  if (!rig) return rig.error();
  const auto now = std::chrono::system_clock::now();
  if (const auto replaced = replace(*rig, iso8601(now)); !replaced) return replaced;
  spdlog::info("the booth is calibrated anew");
  // What follows is tidying up: the rig is in force.
  std::error_code code;
  fs::create_directories(options_.folder / reports_name, code);
  fs::rename(session_.solution(), options_.folder / reports_name / make_capture_id(now), code);
  if (code) spdlog::warn("{}: cannot be kept: {}", session_.solution().string(), code.message());
  if (const auto dropped = drop_session(); !dropped) spdlog::warn("{}", dropped.error().message);
  return {};
}

/// The session is gone at once; its pictures, which take a while to delete, soon.
Result<void> CalibrationDesk::drop_session() {
  const std::string name = std::string(dropped_prefix) + make_capture_id(std::chrono::system_clock::now());
  std::error_code code;
  fs::rename(session_.folder(), options_.folder / name, code);
  if (code && code != std::errc::no_such_file_or_directory)
    return Error{ErrorCode::io, session_.folder().string() + ": cannot be removed: " + code.message()};
  const auto remove = [folder = options_.folder, name] {
    if (const auto removed = remove_folder(folder, name); !removed) spdlog::warn("{}", removed.error().message);
  };
  if (!code && !solver_->post(remove)) remove();
  const std::lock_guard lock(mutex_);
  solution_.reset();
  shots_ = 0;
  enough_ = false;
  return {};
}

Result<void> CalibrationDesk::discard(bool shots) {
  {
    std::unique_lock lock(mutex_);
    if (occupation_ == Occupation::solving) {
      solving_.request_stop();
      released_.wait(lock, [this] { return occupation_ != Occupation::solving; });
    }
  }
  if (const auto occupied = occupy(Occupation::changing); !occupied) return occupied;
  const Occupied until_end(*this);
  if (shots) return drop_session();
  if (const auto removed = remove_folder(session_.folder(), session_.solution().filename()); !removed) return removed;
  const std::lock_guard lock(mutex_);
  solution_.reset();
  return {};
}

Result<void> CalibrationDesk::restore(const std::optional<std::string>& name) {
  if (const auto occupied = occupy(Occupation::changing); !occupied) return occupied;
  const Occupied until_end(*this);
  const auto earlier = replaced();
  const auto chosen =
      std::find_if(earlier.begin(), earlier.end(), [&](const ReplacedRig& rig) { return !name || rig.name == *name; });
  if (chosen == earlier.end())
    return Error{ErrorCode::not_found, name ? "there is no earlier calibration " + *name
                                            : "there is no earlier calibration: none was replaced yet"};
  const fs::path file = options_.folder / chosen->name;
  const auto rig = read_rig(file);
  if (!rig) return rig.error();
  if (const auto put = replace(*rig, chosen->created); !put) return put;
  spdlog::info("the calibration of {} is in force again", chosen->created);
  std::error_code code;  // a copy more does no harm
  if (!fs::remove(file, code)) spdlog::warn("{}: {}", file.string(), code.message());
  return {};
}

std::optional<CalibrationSessionStatus> CalibrationDesk::session() const {
  const std::lock_guard lock(mutex_);
  if (shots_ == 0 && !solution_) return std::nullopt;
  return CalibrationSessionStatus{shots_, enough_, solution_ ? solution_->verdict : ""};
}

std::vector<ReplacedRig> CalibrationDesk::replaced() const {
  std::vector<ReplacedRig> rigs;
  std::error_code code;
  for (fs::directory_iterator entry(options_.folder, code), end; !code && entry != end; entry.increment(code))
    if (const std::string name = entry->path().filename().string(); is_name_of_replaced(name))
      rigs.push_back({name, written_at(entry->path())});
  // Their names say when they were replaced.
  std::sort(rigs.begin(), rigs.end(), [](const ReplacedRig& a, const ReplacedRig& b) { return a.name > b.name; });
  return rigs;
}

std::string CalibrationDesk::report() const {
  Json json{{"look", nullptr}, {"solution", nullptr}, {"replaced", Json::array()}};
  if (const auto look = read_text(session_.look_file()); look && session())
    json["look"] = Json::parse(*look, nullptr, false);
  {
    const std::lock_guard lock(mutex_);
    if (solution_) json["solution"] = Json::parse(solution_->json);
  }
  for (const ReplacedRig& rig : replaced())
    json["replaced"].push_back(
        {{"name", rig.name}, {"created", rig.created.empty() ? Json(nullptr) : Json(rig.created)}});
  return json.dump(-1, ' ', false, Json::error_handler_t::replace);
}

}  // namespace booth
