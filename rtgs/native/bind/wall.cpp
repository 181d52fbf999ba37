#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <optional>
#include <tuple>
#include <vector>

#include "bind/bindings.h"
#include "common/isa.h"
#include "common/threads.h"
#include "image/wall.h"

namespace rtgs {
namespace {

const char* const kWall = "wall";

// `Sums` partial sums of each block of `count` rows, and in the end their totals.
struct Blocks {
  Blocks(int64_t count, int sums) : sums(sums), parts(size_t((count + kWallBlock - 1) / kWallBlock * sums)) {}
  void total(float* out) const {
    for (int k = 0; k < sums; ++k) {
      double total = 0;
      for (size_t part = size_t(k); part < parts.size(); part += size_t(sums)) total += parts[part];
      out[k] = float(total);
    }
  }
  int sums;
  std::vector<float> parts;
};

using Maybe = std::optional<Floats>;
using GlassNumbers = std::tuple<float, Maybe>;                        // index, tint
using LegArrays = std::tuple<Floats, Floats, Floats, Maybe, Floats>;  // contents, alpha, surroundings, later, cosine

float* pointer(const Maybe& array) { return array ? array->data() : nullptr; }

Glass glass_of(const GlassNumbers& numbers) {
  const auto& [index, tint] = numbers;
  if (!tint) return {index, false, {1, 1, 1}};
  require(kWall, *tint, "tint", 3);
  const float* t = tint->data();
  return {index, true, {t[0], t[1], t[2]}};
}

WallLegGradients checked_leg(const LegArrays& arrays, int64_t count) {
  const auto& [contents, alpha, surroundings, later, cosine] = arrays;
  require(kWall, contents, "contents", 3 * count);
  require(kWall, alpha, "alpha", count);
  require(kWall, surroundings, "surroundings", 3 * count);
  if (later) require(kWall, *later, "later light", 3 * count);
  require(kWall, cosine, "cosine", count);
  return {contents.data(), alpha.data(), surroundings.data(), pointer(later), cosine.data(), nullptr};
}

WallLeg leg_of(const LegArrays& arrays, const Floats& wall, const GlassNumbers& glass, int threads) {
  const int64_t count = int64_t(wall.size());
  const WallLegGradients a = checked_leg(arrays, count);
  return {count, a.contents, a.alpha, a.surroundings, a.later, a.cosine, wall.data(), glass_of(glass),
          checked_threads(threads)};
}

}  // namespace

void bind_wall(nb::module_& m) {
  m.def("wall_reflectance", [](Floats cosine, float index, Floats reflected, int threads) {
    const WallAngles in = {int64_t(cosine.size()), cosine.data(), index, checked_threads(threads)};
    require(kWall, reflected, "reflected", in.count);
    float* out = reflected.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(wall_reflectance, in, out);
  }, nb::arg("cosine"), nb::arg("index"), nb::arg("reflected"), nb::arg("threads"),
     "Fills what thin walls of glass reflect at these angles; see rtgs/optics/dielectric.py.");
  m.def("wall_reflectance_backward", [](Floats cosine, float index, Floats upstream, Floats to_cosine, Floats to_index,
                                        int threads) {
    const WallAngles in = {int64_t(cosine.size()), cosine.data(), index, checked_threads(threads)};
    for (const Floats* each : {&upstream, &to_cosine}) require(kWall, *each, "a gradient", in.count);
    require(kWall, to_index, "gradient of the index", 1);
    const float* from = upstream.data();
    float *by_cosine = to_cosine.data(), *by_index = to_index.data();
    nb::gil_scoped_release release;
    Blocks blocks(in.count, 1);
    RTGS_DISPATCH(wall_reflectance_backward, in, from, by_cosine, blocks.parts.data());
    blocks.total(by_index);
  }, nb::arg("cosine"), nb::arg("index"), nb::arg("upstream"), nb::arg("to_cosine"), nb::arg("to_index"),
     nb::arg("threads"), "Fills the gradients by the cosines, and by the index, which all share.");
  m.def("wall_leg", [](LegArrays given, Floats wall, GlassNumbers glass, Floats arriving, int threads) {
    const WallLeg in = leg_of(given, wall, glass, threads);
    require(kWall, arriving, "arriving light", 3 * in.count);
    float* out = arriving.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(wall_leg, in, out);
  }, nb::arg("given"), nb::arg("wall"), nb::arg("glass"), nb::arg("arriving"), nb::arg("threads"),
     "Fills the light (L, 3) that comes along one leg of paths inside an object; given: its contents, alpha, "
     "surroundings, later light or None, cosine; glass: index, tint or None; see rtgs/methods/shading/inner.py.");
  m.def("wall_leg_backward", [](LegArrays given, Floats wall, GlassNumbers glass, Floats upstream, LegArrays gradients,
                                Floats to_glass, int threads) {
    const WallLeg in = leg_of(given, wall, glass, threads);
    require(kWall, upstream, "upstream", 3 * in.count);
    require(kWall, to_glass, "gradient of index and tint", kGlassNumbers);
    Blocks blocks(in.count, kGlassNumbers);
    WallLegGradients out = checked_leg(gradients, in.count);
    if (!in.later != !out.later) throw std::invalid_argument("wall: later light and its gradient go together");
    out.glass = blocks.parts.data();
    const float* from = upstream.data();
    float* total = to_glass.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(wall_leg_backward, in, from, out);
    blocks.total(total);
  }, nb::arg("given"), nb::arg("wall"), nb::arg("glass"), nb::arg("upstream"), nb::arg("gradients"),
     nb::arg("to_glass"), nb::arg("threads"),
     "Fills the gradients by what was given, and (4,) by index and tint, which all rays share.");
}

}  // namespace rtgs
