#include "bind/wall.h"

#include <tuple>
#include <vector>

#include "common/isa.h"
#include "common/threads.h"

namespace rtgs {
namespace {

using LegArrays = std::tuple<Floats, Floats, Floats, Maybe, Floats>;  // contents, alpha, surroundings, later, cosine

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

using TwoRows = std::tuple<Rows, Rows>;                          // of behind, of arriving
using BehindArrays = std::tuple<Maybe, Floats, Floats, Floats>;  // alpha, behind, arriving, cosine

// Where each ray's row is in a list of rays, in whole registers of any length; -1: it is not in it.
std::vector<int32_t> places_of(const Rows& rows, int64_t count) {
  std::vector<int32_t> place(size_t((count + 15) / 16 * 16), -1);
  put_rows(place, rows, count, "rays; each can be named once");
  return place;
}

FarWallGradients checked_behind(const BehindArrays& arrays, const TwoRows& rows, int64_t count) {
  const auto& [alpha, behind, arriving, cosine] = arrays;
  const int64_t shown = int64_t(std::get<0>(rows).size()), mirrored = int64_t(std::get<1>(rows).size());
  if (alpha) require(kWall, *alpha, "alpha", count);
  require(kWall, behind, "behind", 3 * shown);
  require(kWall, arriving, "arriving light", 3 * mirrored);
  require(kWall, cosine, "cosine", mirrored);
  static float nothing[3] = {};  // is read where there are no rows, and never written
  return {pointer(alpha), shown ? behind.data() : nothing, mirrored ? arriving.data() : nothing,
          mirrored ? cosine.data() : nothing, nullptr};
}

struct FarWallRays {
  FarWallRays(const Floats& contents, const BehindArrays& arrays, const TwoRows& rows, const GlassNumbers& glass,
              int threads)
      : count(int64_t(contents.size() / 3)) {
    require(kWall, contents, "contents", 3 * count);
    if (count > (1 << 29)) throw std::invalid_argument("wall: " + std::to_string(count) + " rays; 2^29 are possible");
    const FarWallGradients a = checked_behind(arrays, rows, count);
    behind = places_of(std::get<0>(rows), count);
    mirrored = places_of(std::get<1>(rows), count);
    in = {count, contents.data(), a.alpha, a.behind, a.arriving, a.cosine, behind.data(), mirrored.data(),
          glass_of(glass), checked_threads(threads)};
  }
  int64_t count;
  std::vector<int32_t> behind, mirrored;
  FarWall in;
};

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
  m.def("far_wall", [](Floats contents, BehindArrays given, TwoRows rows, GlassNumbers glass, Floats color,
                       int threads) {
    const FarWallRays rays(contents, given, rows, glass, threads);
    require(kWall, color, "color", 3 * rays.count);
    float* out = color.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(far_wall, rays.in, out);
  }, nb::arg("contents"), nb::arg("given"), nb::arg("rows").noconvert(), nb::arg("glass"), nb::arg("color"),
     nb::arg("threads"),
     "Fills the colors (3, R) of contents (3, R) and what the far wall sends; given: alpha or None, behind, arriving "
     "light, cosine; rows: rays of behind, of arriving light; see rtgs/methods/shading/far_wall.py.");
  m.def("far_wall_backward", [](Floats contents, BehindArrays given, TwoRows rows, GlassNumbers glass, Floats upstream,
                                BehindArrays gradients, Floats to_glass, int threads) {
    const FarWallRays rays(contents, given, rows, glass, threads);
    require(kWall, upstream, "upstream", 3 * rays.count);
    require(kWall, to_glass, "gradient of index and tint", kGlassNumbers);
    Blocks blocks(rays.count, kGlassNumbers);
    FarWallGradients out = checked_behind(gradients, rows, rays.count);
    if (!rays.in.alpha != !out.alpha) throw std::invalid_argument("wall: alpha and its gradient go together");
    out.glass = blocks.parts.data();
    const float* from = upstream.data();
    float* total = to_glass.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(far_wall_backward, rays.in, from, out);
    blocks.total(total);
  }, nb::arg("contents"), nb::arg("given"), nb::arg("rows").noconvert(), nb::arg("glass"), nb::arg("upstream"),
     nb::arg("gradients"), nb::arg("to_glass"), nb::arg("threads"),
     "Fills the gradients by what was given, and (4,) by index and tint; that by contents is upstream itself.");
}

}  // namespace rtgs
