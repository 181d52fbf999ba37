#include "bind/wall.h"
#include "common/isa.h"
#include "common/threads.h"

namespace rtgs {
namespace {

using Flags = nb::ndarray<const bool, nb::c_contig, nb::device::cpu>;
using PixelArrays = std::tuple<Floats, Floats, Flags, Maybe>;        // reflection, cosine, inside, walls or None
using EdgeArrays = std::tuple<Rows, Floats, Floats, Floats, Floats>;  // rows, k_s of all pixels, R, wall, a

// Each pixel's row at the outline, in whole registers of any length.
std::vector<int32_t> places_of(const Flags& inside, const std::optional<EdgeArrays>& edges) {
  const int64_t count = int64_t(inside.size());
  std::vector<int32_t> place(size_t((count + 15) / 16 * 16), kNoGlass);
  for (int64_t k = 0; k < count; ++k) place[size_t(k)] = inside.data()[k] ? -1 : kNoGlass;
  if (edges) put_rows(place, std::get<0>(*edges), count, "pixels; each can be named once, and is one of the object's");
  return place;
}

struct TracedWalls {
  TracedWalls(const PixelArrays& pixels, const std::optional<EdgeArrays>& edges, const GlassNumbers& glass, int threads)
      : place(places_of(std::get<2>(pixels), edges)) {
    const auto& [reflection, cosine, inside, walls] = pixels;
    const int64_t count = int64_t(inside.size());
    require(kWall, reflection, "reflection", count);
    require(kWall, cosine, "cosine", count);
    if (walls) require(kWall, *walls, "walls", count);
    in = {count, reflection.data(), cosine.data(), pointer(walls), place.data(), nullptr, nullptr, nullptr, nullptr,
          glass_of(glass), checked_threads(threads)};
    if (!edges) return;
    const auto& [rows, specular, reflected, wall, share] = *edges;
    edge_count = int64_t(rows.size());
    require(kWall, specular, "specular", count);
    for (const Floats* each : {&reflected, &wall, &share}) require(kWall, *each, "an array of the outline", edge_count);
    in.specular = specular.data(), in.edge_reflected = reflected.data();
    in.edge_wall = wall.data(), in.edge_share = share.data();
  }
  // Of w_t, or of its gradient.
  void check(const Floats& reflection, const Floats& passing, const Maybe& beside) const {
    require(kWall, reflection, "w_r", in.count);
    require(kWall, passing, "w_t", in.glass.tinted ? 3 * in.count : in.count);
    if (!beside != !in.specular) throw std::invalid_argument("wall: what is beside goes with an outline");
    if (beside) require(kWall, *beside, "the weight of what is beside", in.count);
  }
  std::vector<int32_t> place;
  int64_t edge_count = 0;
  WallPixels in;
};

using Weights = std::tuple<Floats, Floats, Maybe>;           // w_r, w_t, of what is beside
using Gradients = std::tuple<Floats, Floats, Maybe, Maybe>;  // reflection, cosine, specular, R at the outline

}  // namespace

void bind_wall_weights(nb::module_& m) {
  m.def("wall_weights", [](PixelArrays pixels, std::optional<EdgeArrays> edges, GlassNumbers glass, Weights weights,
                           int threads) {
    const TracedWalls walls(pixels, edges, glass, threads);
    const auto& [reflection, passing, beside] = weights;
    walls.check(reflection, passing, beside);
    const WallPixelWeights out = {reflection.data(), passing.data(), pointer(beside)};
    nb::gil_scoped_release release;
    RTGS_DISPATCH(wall_weights, walls.in, out);
  }, nb::arg("pixels"), nb::arg("edges").none(), nb::arg("glass"), nb::arg("weights"), nb::arg("threads"),
     "Fills w_r, w_t and the weight of what is beside of P pixels (reflection, cosine, inside, walls or None), some of "
     "them at an outline (rows, k_s of all, R, wall, a); see rtgs/methods/shading/wall_weights.py.");
  m.def("wall_weights_backward", [](PixelArrays pixels, std::optional<EdgeArrays> edges, GlassNumbers glass,
                                    Weights upstream, Gradients gradients, Floats to_glass, int threads) {
    const TracedWalls walls(pixels, edges, glass, threads);
    const auto& [by_reflection, by_passing, by_beside] = upstream;
    walls.check(by_reflection, by_passing, by_beside);
    const auto& [reflection, cosine, specular, reflected] = gradients;
    for (const Floats* each : {&reflection, &cosine}) require(kWall, *each, "a gradient", walls.in.count);
    if (!specular != !edges || !reflected != !edges)
      throw std::invalid_argument("wall: gradients by k_s and by R of the outline go with an outline");
    if (specular) require(kWall, *specular, "gradient of k_s", walls.in.count);
    if (reflected) require(kWall, *reflected, "gradient of R at the outline", walls.edge_count);
    require(kWall, to_glass, "gradient of index and tint", kGlassNumbers);
    Blocks blocks(walls.in.count, kGlassNumbers);
    const WallPixelUpstream from = {by_reflection.data(), by_passing.data(), pointer(by_beside)};
    const WallPixelGradients out = {reflection.data(), cosine.data(), pointer(specular), pointer(reflected),
                                    blocks.parts.data()};
    float* total = to_glass.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(wall_weights_backward, walls.in, from, out);
    blocks.total(total);
  }, nb::arg("pixels"), nb::arg("edges").none(), nb::arg("glass"), nb::arg("upstream"), nb::arg("gradients"),
     nb::arg("to_glass"), nb::arg("threads"), "Fills the gradients by what was given, and (4,) by index and tint.");
}

}  // namespace rtgs
