// Decimation of a body of about 0.2 million triangles to 20,000, ours beside the simplification of CGAL, OpenMesh and
// meshoptimizer as far as their Debian packages are installed: processor time, distance to the true surface (root mean
// square and largest, over points spread evenly by area) and whether the result is a closed manifold.
//
// The input is an analytic body of capsules, meshed on a 5 mm grid, its vertices displaced by normally distributed
// noise of 0.4 mm along each axis: about what silhouettes leave.

#include <benchmark/benchmark.h>

#include <algorithm>
#include <cmath>
#include <random>

#ifdef BOOTH_HAVE_CGAL
#include <CGAL/Simple_cartesian.h>
#include <CGAL/Surface_mesh.h>
#include <CGAL/Surface_mesh_simplification/Policies/Edge_collapse/Bounded_normal_change_filter.h>
#include <CGAL/Surface_mesh_simplification/Policies/Edge_collapse/Count_ratio_stop_predicate.h>
#include <CGAL/Surface_mesh_simplification/Policies/Edge_collapse/GarlandHeckbert_plane_policies.h>
#include <CGAL/Surface_mesh_simplification/edge_collapse.h>
#endif
#ifdef BOOTH_HAVE_OPENMESH
#include <OpenMesh/Core/Mesh/TriMesh_ArrayKernelT.hh>
#include <OpenMesh/Tools/Decimater/DecimaterT.hh>
#include <OpenMesh/Tools/Decimater/ModNormalFlippingT.hh>
#include <OpenMesh/Tools/Decimater/ModQuadricT.hh>
#endif
#ifdef BOOTH_HAVE_MESHOPTIMIZER
#include <meshoptimizer.h>
#endif

#include "pipeline/surface/decimation.h"
#include "pipeline/surface/marching_cubes.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

constexpr size_t budget = 20000;
constexpr double voxel_m = 0.005;
constexpr float noise_m = 0.0004F;

const synthetic::Body& body() {
  static const synthetic::Body made = synthetic::person().body;
  return made;
}

const Mesh& noisy_mesh() {
  static const Mesh made = [] {
    Mesh mesh = extract_surface(synthetic::sample_field(body(), voxel_m));
    std::mt19937 random(1);
    std::normal_distribution<float> noise(0, noise_m);
    for (Eigen::Vector3f& p : mesh.positions) p += Eigen::Vector3f(noise(random), noise(random), noise(random));
    return mesh;
  }();
  return made;
}

void report(benchmark::State& state, const Mesh& mesh) {
  constexpr int samples = 5;  // a triangle
  std::mt19937 random(2);
  std::uniform_real_distribution<double> uniform(0, 1);
  double sum = 0, weight = 0, largest = 0;
  for (const auto& [a, b, c] : mesh.triangles) {
    const Eigen::Vector3d origin = mesh.positions[a].cast<double>();
    const Eigen::Vector3d u = mesh.positions[b].cast<double>() - origin, v = mesh.positions[c].cast<double>() - origin;
    const double area = u.cross(v).norm();
    for (int i = 0; i < samples; ++i) {
      double s = uniform(random), t = uniform(random);
      if (s + t > 1) s = 1 - s, t = 1 - t;
      const double off = synthetic::signed_distance(body(), origin + s * u + t * v);
      sum += area * off * off;
      weight += area;
      largest = std::max(largest, std::abs(off));
    }
  }
  state.counters["triangles"] = static_cast<double>(mesh.triangles.size());
  state.counters["rms_mm"] = 1000 * std::sqrt(sum / weight);
  state.counters["max_mm"] = 1000 * largest;
  state.counters["closed_manifold"] = topology(mesh).closed_manifold() ? 1 : 0;
}

void booth_decimate(benchmark::State& state) {
  const Mesh& input = noisy_mesh();
  Mesh mesh;
  for (auto _ : state) mesh = decimate(input, {.triangles = budget});
  report(state, mesh);
}

#ifdef BOOTH_HAVE_CGAL
using Kernel = CGAL::Simple_cartesian<double>;
using CgalMesh = CGAL::Surface_mesh<Kernel::Point_3>;

CgalMesh to_cgal(const Mesh& mesh) {
  CgalMesh made;
  for (const Eigen::Vector3f& p : mesh.positions) made.add_vertex({p.x(), p.y(), p.z()});
  using Vertex = CgalMesh::Vertex_index;
  for (const auto& [a, b, c] : mesh.triangles) made.add_face(Vertex(a), Vertex(b), Vertex(c));
  return made;
}

Mesh from_cgal(CgalMesh mesh) {
  mesh.collect_garbage();
  Mesh made;
  for (const auto v : mesh.vertices())
    made.positions.emplace_back(static_cast<float>(mesh.point(v).x()), static_cast<float>(mesh.point(v).y()),
                                static_cast<float>(mesh.point(v).z()));
  for (const auto f : mesh.faces()) {
    auto& triangle = made.triangles.emplace_back();
    size_t k = 0;
    for (const auto v : CGAL::vertices_around_face(mesh.halfedge(f), mesh)) triangle[k++] = static_cast<uint32_t>(v);
  }
  return made;
}

template <class Simplify>
void run_cgal(benchmark::State& state, const Simplify& simplify) {
  const CgalMesh input = to_cgal(noisy_mesh());
  const double ratio = static_cast<double>(budget) / static_cast<double>(noisy_mesh().triangles.size());
  CgalMesh mesh;
  for (auto _ : state) {
    mesh = input;
    simplify(mesh, CGAL::Surface_mesh_simplification::Count_ratio_stop_predicate<CgalMesh>(ratio));
  }
  report(state, from_cgal(mesh));
}

/// M. Garland, P. Heckbert, 1997, with a bound on the change of normals.
void cgal_garland_heckbert(benchmark::State& state) {
  namespace sms = CGAL::Surface_mesh_simplification;
  run_cgal(state, [](CgalMesh& mesh, const auto& stop) {
    const sms::GarlandHeckbert_plane_policies<CgalMesh, Kernel> policies(mesh);
    sms::edge_collapse(mesh, stop,
                       CGAL::parameters::get_cost(policies.get_cost())
                           .get_placement(policies.get_placement())
                           .filter(sms::Bounded_normal_change_filter<>()));
  });
}

/// P. Lindstrom, G. Turk, 1998: CGAL's default.
void cgal_lindstrom_turk(benchmark::State& state) {
  run_cgal(state,
           [](CgalMesh& mesh, const auto& stop) { CGAL::Surface_mesh_simplification::edge_collapse(mesh, stop); });
}
#endif

#ifdef BOOTH_HAVE_OPENMESH
void openmesh_quadric(benchmark::State& state) {
  using OpenMeshMesh = OpenMesh::TriMesh_ArrayKernelT<>;
  OpenMeshMesh input;
  std::vector<OpenMeshMesh::VertexHandle> handles;
  for (const Eigen::Vector3f& p : noisy_mesh().positions) handles.push_back(input.add_vertex({p.x(), p.y(), p.z()}));
  for (const auto& [a, b, c] : noisy_mesh().triangles) input.add_face(handles[a], handles[b], handles[c]);
  OpenMeshMesh mesh;
  for (auto _ : state) {
    mesh = input;
    OpenMesh::Decimater::DecimaterT<OpenMeshMesh> decimater(mesh);
    OpenMesh::Decimater::ModQuadricT<OpenMeshMesh>::Handle quadric;
    OpenMesh::Decimater::ModNormalFlippingT<OpenMeshMesh>::Handle flipping;
    decimater.add(quadric);
    decimater.add(flipping);
    decimater.module(quadric).unset_max_err();
    decimater.initialize();
    decimater.decimate_to_faces(0, budget);
    mesh.garbage_collection();
  }
  Mesh made;
  for (const auto v : mesh.vertices())
    made.positions.emplace_back(mesh.point(v)[0], mesh.point(v)[1], mesh.point(v)[2]);
  for (const auto f : mesh.faces()) {
    auto& triangle = made.triangles.emplace_back();
    size_t k = 0;
    for (const auto v : mesh.fv_range(f)) triangle[k++] = static_cast<uint32_t>(v.idx());
  }
  report(state, made);
}
#endif

#ifdef BOOTH_HAVE_MESHOPTIMIZER
void meshoptimizer_simplify(benchmark::State& state) {
  const Mesh& input = noisy_mesh();
  const size_t corners = input.triangles.size() * 3;
  std::vector<uint32_t> indices(corners);
  size_t kept = 0;
  for (auto _ : state)
    kept = meshopt_simplify(indices.data(), input.triangles.front().data(), corners, input.positions.front().data(),
                            input.positions.size(), sizeof(Eigen::Vector3f), budget * 3, 1, 0, nullptr);
  Mesh made;
  made.positions = input.positions;
  for (size_t i = 0; i < kept; i += 3) made.triangles.push_back({indices[i], indices[i + 1], indices[i + 2]});
  report(state, made);
}
#endif

#define BOOTH_PEER(name) BENCHMARK(name)->Unit(benchmark::kMillisecond)->MeasureProcessCPUTime()->UseRealTime()
BOOTH_PEER(booth_decimate);
#ifdef BOOTH_HAVE_CGAL
BOOTH_PEER(cgal_garland_heckbert);
BOOTH_PEER(cgal_lindstrom_turk);
#endif
#ifdef BOOTH_HAVE_OPENMESH
BOOTH_PEER(openmesh_quadric);
#endif
#ifdef BOOTH_HAVE_MESHOPTIMIZER
BOOTH_PEER(meshoptimizer_simplify);
#endif

}  // namespace
}  // namespace booth

BENCHMARK_MAIN();
