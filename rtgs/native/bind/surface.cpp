#include "image/surface.h"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <tuple>
#include <vector>

#include "bind/bindings.h"
#include "common/threads.h"

namespace rtgs {
namespace {

constexpr const char* kName = "surface";

using Three = std::tuple<Floats, Floats, Floats>;
using Maybe = std::optional<Floats>;
using MaybeThree = std::tuple<Maybe, Maybe, Maybe>;
using Flags = nb::ndarray<const bool, nb::c_contig, nb::device::cpu>;
using Integers = nb::ndarray<const int32_t, nb::c_contig, nb::device::cpu>;

template <typename Maps>
Maps maps_of(const Three& arrays, int64_t pixels) {
  const auto& [roughness, f0, depth] = arrays;
  require(kName, roughness, "roughness", pixels);
  require(kName, f0, "f0", pixels);
  require(kName, depth, "depth", pixels);
  return {roughness.data(), f0.data(), depth.data()};
}

SurfaceRules rules_of(const Floats& alpha, float smallest_alpha, float covered, int threads) {
  return {int64_t(alpha.size()), alpha.data(), smallest_alpha, covered, checked_threads(threads)};
}

float* pointer(const Maybe& array, const char* name, int64_t size) {
  if (!array) return nullptr;
  require(kName, *array, name, size);
  return array->data();
}

using MeshArrays = std::tuple<Flags, Maybe, Maybe, float>;  // known, depth, normal, cover or 0

KnownSurface known_of(const MeshArrays& arrays, int threads) {
  const auto& [known, near, normal, cover] = arrays;
  const int64_t pixels = int64_t(known.size());
  return {pixels, known.data(), pointer(near, "depth of the mesh", pixels),
          pointer(normal, "normal of the mesh", 3 * pixels), cover, checked_threads(threads)};
}

// Depth, normal, k_s: each is there where the mesh says something of it.
template <typename Maps>
Maps surface_of(const MaybeThree& arrays, const KnownSurface& mesh) {
  const auto& [depth, normal, specular] = arrays;
  if (!depth != !mesh.near || !normal != !mesh.normal || !specular != (mesh.cover == 0))
    throw std::invalid_argument("surface: a map is given where the mesh says something of it, and nowhere else");
  return {pointer(depth, "depth", mesh.pixels), pointer(normal, "normal", 3 * mesh.pixels),
          pointer(specular, "specular", mesh.pixels)};
}

using RowArrays = std::tuple<Integers, Floats, Floats, Flags, Floats, Integers>;
using BoolMap = nb::ndarray<bool, nb::c_contig, nb::device::cpu>;
using IntegerMap = nb::ndarray<int32_t, nb::c_contig, nb::device::cpu>;
using MapArrays = std::tuple<BoolMap, Floats, Floats, BoolMap, Floats, IntegerMap>;

ObjectRows rows_of(const RowArrays& arrays, int64_t size) {
  const auto& [pixels, near, far, second, normal, triangle] = arrays;
  const int64_t count = int64_t(pixels.size());
  require(kName, near, "near", count);
  require(kName, far, "far", count);
  require(kName, second, "second", count);
  require(kName, normal, "normal", 3 * count);
  require(kName, triangle, "triangle", count);
  for (int64_t row = 0; row < count; ++row)
    if (pixels.data()[row] < 0 || pixels.data()[row] >= size)
      throw std::invalid_argument("surface: there is no pixel " + std::to_string(pixels.data()[row]) +
                                  " in a picture of " + std::to_string(size));
  return {count, pixels.data(), triangle.data(), near.data(), far.data(), normal.data(), second.data()};
}

ObjectMaps object_maps(const MapArrays& arrays) {
  const auto& [hit, near, far, second, normal, triangle] = arrays;
  const int64_t pixels = int64_t(hit.size());
  require(kName, near, "map of near", pixels);
  require(kName, far, "map of far", pixels);
  require(kName, second, "map of second", pixels);
  require(kName, normal, "map of normal", 3 * pixels);
  require(kName, triangle, "map of triangle", pixels);
  return {pixels, hit.data(), second.data(), near.data(), far.data(), normal.data(), triangle.data()};
}

}  // namespace

void bind_surface(nb::module_& m) {
  m.def("surface_maps", [](Floats alpha, Three given, float smallest_alpha, float covered, Three out, int threads) {
    const SurfaceRules rules = rules_of(alpha, smallest_alpha, covered, threads);
    const auto in = maps_of<CompositedMaps>(given, rules.pixels);
    const auto to = maps_of<SurfaceMaps>(out, rules.pixels);
    nb::gil_scoped_release release;
    surface_maps(rules, in, to);
  }, nb::arg("alpha"), nb::arg("given"), nb::arg("smallest_alpha"), nb::arg("covered"), nb::arg("out"),
     nb::arg("threads"), "Fills roughness, f0, depth (N) of the composited ones; see shading/surface_maps.py.");
  m.def("surface_maps_backward", [](Floats alpha, Three given, float smallest_alpha, float covered, Three upstream,
                                    Three gradients, Floats by_cover, Floats by_depth, int threads) {
    const SurfaceRules rules = rules_of(alpha, smallest_alpha, covered, threads);
    const auto in = maps_of<CompositedMaps>(given, rules.pixels), up = maps_of<CompositedMaps>(upstream, rules.pixels);
    const auto to = maps_of<SurfaceMaps>(gradients, rules.pixels);
    require(kName, by_cover, "a gradient by alpha", rules.pixels);
    require(kName, by_depth, "a gradient by alpha", rules.pixels);
    nb::gil_scoped_release release;
    surface_maps_backward(rules, in, up, to, by_cover.data(), by_depth.data());
  }, nb::arg("alpha"), nb::arg("given"), nb::arg("smallest_alpha"), nb::arg("covered"), nb::arg("upstream"),
     nb::arg("gradients"), nb::arg("by_cover"), nb::arg("by_depth"), nb::arg("threads"),
     "Fills the gradients by the composited maps, and by alpha as both divisors.");
  m.def("known_surface", [](MeshArrays mesh, MaybeThree given, MaybeThree out, int threads) {
    const KnownSurface known = known_of(mesh, threads);
    const auto in = surface_of<GivenSurface>(given, known);
    const auto to = surface_of<PutSurface>(out, known);
    nb::gil_scoped_release release;
    known_surface(known, in, to);
  }, nb::arg("mesh"), nb::arg("given"), nb::arg("out"), nb::arg("threads"),
     "Fills depth, normal and k_s with what the mesh says: known, its depth, its normal, the cover of k_s or 0.");
  m.def("known_surface_backward", [](MeshArrays mesh, Maybe specular, MaybeThree upstream, MaybeThree gradients,
                                     int threads) {
    const KnownSurface known = known_of(mesh, threads);
    const auto up = surface_of<GivenSurface>(upstream, known);
    const auto to = surface_of<PutSurface>(gradients, known);
    if (!specular != !to.specular) throw std::invalid_argument("surface: k_s and its gradient go together");
    const float* from = pointer(specular, "specular", known.pixels);
    nb::gil_scoped_release release;
    known_surface_backward(known, from, up, to);
  }, nb::arg("mesh"), nb::arg("specular").none(), nb::arg("upstream"), nb::arg("gradients"), nb::arg("threads"),
     "Fills the gradients by depth, normal and k_s as rasterised.");
  m.def("spread_object", [](std::vector<RowArrays> rows, MapArrays maps) {
    const ObjectMaps to = object_maps(maps);
    std::vector<ObjectRows> from;
    for (const RowArrays& each : rows) from.push_back(rows_of(each, to.pixels));
    nb::gil_scoped_release release;
    clear_object(to);
    for (const ObjectRows& each : from) put_object(each, to);
  }, nb::arg("rows"), nb::arg("maps"),
     "Fills the maps hit, near, far, second, normal, triangle with rows (pixels, near, far, second, normal, triangle), "
     "later ones over earlier ones.");
}

}  // namespace rtgs
