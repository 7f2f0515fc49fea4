#include "pipeline/calibration/bundle_adjustment.h"

#include <ceres/ceres.h>
#include <ceres/rotation.h>

#include <Eigen/Dense>
#include <array>
#include <cmath>
#include <limits>
#include <memory>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

/// fx, fy, cx, cy, k1, k2, p1, p2, k3.
constexpr int intrinsic_parameters = 9;
/// Angle-axis rotation and translation.
constexpr int pose_parameters = 6;
using IntrinsicBlock = std::array<double, intrinsic_parameters>;
using PoseBlock = std::array<double, pose_parameters>;

IntrinsicBlock block_of(const Intrinsics& k) {
  return {k.fx, k.fy, k.cx, k.cy, k.distortion[0], k.distortion[1], k.distortion[2], k.distortion[3], k.distortion[4]};
}

void assign(Intrinsics& k, const IntrinsicBlock& block) {
  k.fx = block[0];
  k.fy = block[1];
  k.cx = block[2];
  k.cy = block[3];
  k.skew = 0;
  for (size_t i = 0; i < 5; ++i) k.distortion[i] = block[4 + i];
}

PoseBlock block_of(const Eigen::Isometry3d& pose) {
  const Eigen::AngleAxisd turn(pose.linear());
  const Eigen::Vector3d axis = turn.angle() * turn.axis();
  const Eigen::Vector3d t = pose.translation();
  return {axis.x(), axis.y(), axis.z(), t.x(), t.y(), t.z()};
}

Eigen::Isometry3d pose_of(const PoseBlock& block) {
  const Eigen::Vector3d axis(block[0], block[1], block[2]);
  Eigen::Isometry3d pose = Eigen::Isometry3d::Identity();
  const double angle = axis.norm();
  if (angle > 0) pose.linear() = Eigen::AngleAxisd(angle, axis / angle).toRotationMatrix();
  pose.translation() = Eigen::Vector3d(block[3], block[4], block[5]);
  return pose;
}

/// Reprojection of one corner in units of its uncertainty. The camera model is project_camera_point's.
struct Reprojection {
  Eigen::Vector3d p_board;
  Eigen::Vector2d pixel;
  Eigen::Matrix2d whitening;

  template <class T>
  bool operator()(const T* k, const T* camera, const T* board, T* out) const {
    const T p[3] = {T(p_board.x()), T(p_board.y()), T(p_board.z())};
    T world[3], seen[3];
    ceres::AngleAxisRotatePoint(board, p, world);
    for (int i = 0; i < 3; ++i) world[i] += board[3 + i];
    ceres::AngleAxisRotatePoint(camera, world, seen);
    for (int i = 0; i < 3; ++i) seen[i] += camera[3 + i];
    constexpr double nearest_m = 1e-3;
    if (seen[2] < T(nearest_m)) return false;
    const T x = seen[0] / seen[2], y = seen[1] / seen[2];
    const T r2 = x * x + y * y;
    const T radial = 1.0 + r2 * (k[4] + r2 * (k[5] + r2 * k[8]));
    const T u = x * radial + 2.0 * k[6] * x * y + k[7] * (r2 + 2.0 * x * x);
    const T v = y * radial + k[6] * (r2 + 2.0 * y * y) + 2.0 * k[7] * x * y;
    const T du = k[0] * u + k[2] - pixel.x(), dv = k[1] * v + k[3] - pixel.y();
    out[0] = whitening(0, 0) * du + whitening(0, 1) * dv;
    out[1] = whitening(1, 0) * du + whitening(1, 1) * dv;
    return true;
  }
};

struct Prior {
  std::array<double, 7> mean;  ///< cx, cy, k1, k2, p1, p2, k3
  std::array<double, 7> sigma;

  template <class T>
  bool operator()(const T* k, T* out) const {
    for (size_t i = 0; i < 7; ++i) out[i] = (k[2 + i] - mean[i]) / sigma[i];
    return true;
  }
};

/// W with WᵀW = covariance⁻¹.
Eigen::Matrix2d whitening_of(const Eigen::Matrix2d& covariance) {
  return Eigen::LLT<Eigen::Matrix2d>(covariance.inverse()).matrixU();
}

/// The parameters and Ceres's problem about them, which refers to them.
struct Parameters {
  explicit Parameters(const Bundle& bundle) {
    for (const Intrinsics& k : bundle.intrinsics) intrinsics.push_back(block_of(k));
    for (const auto& pose : bundle.camera_from_world) cameras.push_back(block_of(pose));
    for (const auto& pose : bundle.world_from_board) boards.push_back(block_of(pose));
  }
  std::vector<IntrinsicBlock> intrinsics;
  std::vector<PoseBlock> cameras, boards;
};

void state(const Bundle& bundle, const BundlePriors& priors, double loss_scale, Parameters& parameters,
           ceres::Problem& problem) {
  for (size_t i = 0; i < bundle.intrinsics.size(); ++i) {
    problem.AddParameterBlock(parameters.intrinsics[i].data(), intrinsic_parameters);
    problem.AddParameterBlock(parameters.cameras[i].data(), pose_parameters);
  }
  for (PoseBlock& board : parameters.boards) problem.AddParameterBlock(board.data(), pose_parameters);
  for (const BundleObservation& observation : bundle.observations) {
    if (observation.outlier) continue;
    auto cost = std::make_unique<
        ceres::AutoDiffCostFunction<Reprojection, 2, intrinsic_parameters, pose_parameters, pose_parameters>>(
        new Reprojection{observation.p_board, observation.pixel, whitening_of(observation.covariance)});
    std::unique_ptr<ceres::LossFunction> loss;
    if (loss_scale > 0) loss = std::make_unique<ceres::CauchyLoss>(loss_scale);
    // The problem takes both over.
    problem.AddResidualBlock(cost.release(), loss.release(),
                             parameters.intrinsics[static_cast<size_t>(observation.device)].data(),
                             parameters.cameras[static_cast<size_t>(observation.device)].data(),
                             parameters.boards[static_cast<size_t>(observation.board)].data());
  }
  for (size_t i = 0; i < bundle.intrinsics.size(); ++i) {
    const Intrinsics& k = bundle.intrinsics[i];
    auto cost = std::make_unique<ceres::AutoDiffCostFunction<Prior, 7, intrinsic_parameters>>(
        new Prior{{0.5 * (k.width - 1), 0.5 * (k.height - 1), 0, 0, 0, 0, 0},
                  {priors.principal_point * k.width, priors.principal_point * k.height, priors.k1, priors.k2,
                   priors.tangential, priors.tangential, priors.k3}});
    problem.AddResidualBlock(cost.release(), nullptr, parameters.intrinsics[i].data());
  }
  problem.SetParameterBlockConstant(parameters.cameras[static_cast<size_t>(bundle.fixed_device)].data());
}

class StopWhenAsked final : public ceres::IterationCallback {
 public:
  explicit StopWhenAsked(const Work& work) : work_(work) {}
  ceres::CallbackReturnType operator()(const ceres::IterationSummary&) override {
    return work_.stopped() ? ceres::SOLVER_ABORT : ceres::SOLVER_CONTINUE;
  }

 private:
  const Work& work_;
};

Eigen::Matrix3d cross(const Eigen::Vector3d& v) {
  Eigen::Matrix3d m;
  m << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
  return m;
}

/// d(rotation vector in the camera frame)/d(angle-axis parameters): the left Jacobian of SO(3).
Eigen::Matrix3d left_jacobian(const PoseBlock& pose) {
  const Eigen::Vector3d axis(pose[0], pose[1], pose[2]);
  const double angle = axis.norm();
  constexpr double tiny = 1e-8;
  if (angle < tiny) return Eigen::Matrix3d::Identity();
  const Eigen::Matrix3d k = cross(axis / angle);
  return Eigen::Matrix3d::Identity() + (1 - std::cos(angle)) / angle * k + (1 - std::sin(angle) / angle) * k * k;
}

}  // namespace

Eigen::Vector2d residual(const Bundle& bundle, const BundleObservation& observation) {
  const auto device = static_cast<size_t>(observation.device);
  const Eigen::Vector3d seen = bundle.camera_from_world[device] *
                               (bundle.world_from_board[static_cast<size_t>(observation.board)] * observation.p_board);
  const auto pixel = project_camera_point(bundle.intrinsics[device], seen);
  if (!pixel) return Eigen::Vector2d::Constant(std::numeric_limits<double>::quiet_NaN());
  return *pixel - observation.pixel;
}

Result<void> adjust(Bundle& bundle, const BundleOptions& options, const Work& work) {
  if (work.stopped()) return Work::cancelled();
  Parameters parameters(bundle);
  ceres::Problem problem;
  state(bundle, options.priors, options.loss_scale, parameters, problem);
  ceres::Solver::Options solver;
  solver.linear_solver_type = ceres::SPARSE_NORMAL_CHOLESKY;
  solver.max_num_iterations = options.most_iterations;
  solver.function_tolerance = 1e-10;
  solver.parameter_tolerance = 1e-11;
  solver.num_threads = 1;
  solver.logging_type = ceres::SILENT;
  StopWhenAsked stop(work);
  solver.callbacks.push_back(&stop);
  ceres::Solver::Summary summary;
  ceres::Solve(solver, &problem, &summary);
  if (work.stopped()) return Work::cancelled();
  if (!summary.IsSolutionUsable())
    return Error{ErrorCode::internal, "the adjustment of all cameras found no solution: " + summary.message};
  for (size_t i = 0; i < bundle.intrinsics.size(); ++i) {
    assign(bundle.intrinsics[i], parameters.intrinsics[i]);
    bundle.camera_from_world[i] = pose_of(parameters.cameras[i]);
  }
  for (size_t i = 0; i < bundle.world_from_board.size(); ++i)
    bundle.world_from_board[i] = pose_of(parameters.boards[i]);
  return {};
}

Result<std::vector<DeviceCovariance>> device_covariances(const Bundle& bundle, const BundlePriors& priors,
                                                         double variance) {
  Parameters parameters(bundle);
  ceres::Problem problem;
  state(bundle, priors, 0, parameters, problem);
  const size_t devices = bundle.intrinsics.size();
  ceres::Problem::EvaluateOptions order;
  for (size_t i = 0; i < devices; ++i) order.parameter_blocks.push_back(parameters.intrinsics[i].data());
  for (size_t i = 0; i < devices; ++i)
    if (static_cast<int>(i) != bundle.fixed_device) order.parameter_blocks.push_back(parameters.cameras[i].data());
  for (PoseBlock& board : parameters.boards) order.parameter_blocks.push_back(board.data());
  ceres::CRSMatrix jacobian;
  if (!problem.Evaluate(order, nullptr, nullptr, nullptr, &jacobian))
    return Error{ErrorCode::internal, "the solution's uncertainty cannot be computed"};

  Eigen::MatrixXd normal = Eigen::MatrixXd::Zero(jacobian.num_cols, jacobian.num_cols);
  for (size_t row = 0; row + 1 < jacobian.rows.size(); ++row)
    for (auto a = static_cast<size_t>(jacobian.rows[row]); a < static_cast<size_t>(jacobian.rows[row + 1]); ++a)
      for (auto b = static_cast<size_t>(jacobian.rows[row]); b <= a; ++b)
        normal(jacobian.cols[a], jacobian.cols[b]) += jacobian.values[a] * jacobian.values[b];
  normal.triangularView<Eigen::StrictlyUpper>() = normal.transpose();
  // Pixels, metres and radians differ by powers of ten: the matrix is scaled to a diagonal of ones.
  const Eigen::VectorXd diagonal = normal.diagonal();
  if (!(diagonal.minCoeff() > 0))
    return Error{ErrorCode::internal, "a camera or a pose of the board is not determined"};
  const Eigen::VectorXd scale = diagonal.cwiseSqrt().cwiseInverse();
  const Eigen::MatrixXd scaled = scale.asDiagonal() * normal * scale.asDiagonal();
  const Eigen::LDLT<Eigen::MatrixXd> solver(scaled);
  if (solver.info() != Eigen::Success || !solver.isPositive())
    return Error{ErrorCode::internal, "the cameras are not determined by these views"};
  // Only the devices' part is wanted.
  const auto columns = static_cast<Eigen::Index>(devices) * intrinsic_parameters +
                       static_cast<Eigen::Index>(devices - 1) * pose_parameters;
  const Eigen::MatrixXd units = Eigen::MatrixXd::Identity(normal.rows(), columns);
  const Eigen::MatrixXd inverse = solver.solve(units).topRows(columns);
  const Eigen::MatrixXd covariance =
      variance * (scale.head(columns).asDiagonal() * inverse * scale.head(columns).asDiagonal());

  // From parameters to centres in the world and turns in the camera frame; then what a rigid motion of the whole rig
  // takes up is taken out, as aligning the centres would.
  const auto three = static_cast<Eigen::Index>(3 * devices);
  Eigen::MatrixXd centres = Eigen::MatrixXd::Zero(three, columns), turns = Eigen::MatrixXd::Zero(three, columns);
  Eigen::MatrixXd motions = Eigen::MatrixXd::Zero(three, 6);
  Eigen::Index column = static_cast<Eigen::Index>(devices) * intrinsic_parameters;
  for (size_t i = 0; i < devices; ++i) {
    const auto at = static_cast<Eigen::Index>(3 * i);
    const Eigen::Isometry3d& pose = bundle.camera_from_world[i];
    const Eigen::Matrix3d world_from_camera = pose.linear().transpose();
    const Eigen::Vector3d centre = -world_from_camera * pose.translation();
    motions.block<3, 3>(at, 0).setIdentity();
    motions.block<3, 3>(at, 3) = -cross(centre);
    if (static_cast<int>(i) == bundle.fixed_device) continue;
    const Eigen::Matrix3d turn = left_jacobian(parameters.cameras[i]);
    // c = −Rᵀt and R → exp(w) R: dc = −Rᵀ (t × w) − Rᵀ dt.
    centres.block<3, 3>(at, column) = -world_from_camera * cross(pose.translation()) * turn;
    centres.block<3, 3>(at, column + 3) = -world_from_camera;
    turns.block<3, 3>(at, column) = turn;
    column += pose_parameters;
  }
  const Eigen::MatrixXd motion_of_centres = motions.completeOrthogonalDecomposition().pseudoInverse();
  const Eigen::MatrixXd aligned = centres - motions * (motion_of_centres * centres);
  // Moving the world by a turn v moves a camera's turn by R v.
  Eigen::MatrixXd aligned_turns = turns;
  const Eigen::MatrixXd turn_of_world = motion_of_centres.bottomRows<3>() * centres;
  for (size_t i = 0; i < devices; ++i)
    aligned_turns.middleRows<3>(static_cast<Eigen::Index>(3 * i)) +=
        bundle.camera_from_world[i].linear() * turn_of_world;
  const Eigen::MatrixXd half_centres = aligned * covariance, half_turns = aligned_turns * covariance;

  std::vector<DeviceCovariance> found(devices);
  for (size_t i = 0; i < devices; ++i) {
    const auto at = static_cast<Eigen::Index>(3 * i);
    found[i].center = half_centres.middleRows<3>(at) * aligned.middleRows<3>(at).transpose();
    found[i].rotation = half_turns.middleRows<3>(at) * aligned_turns.middleRows<3>(at).transpose();
    const auto intrinsic = static_cast<Eigen::Index>(i) * intrinsic_parameters;
    found[i].pinhole = covariance.block<4, 4>(intrinsic, intrinsic);
  }
  return found;
}

}  // namespace booth
