#include "bind/bindings.h"
#include "common/isa.h"
#include "common/threads.h"
#include "light/cubemap.h"

namespace rtgs {
namespace {

const char* const kCubemap = "cubemap";

using LongTable = nb::ndarray<const int64_t, nb::c_contig, nb::device::cpu>;
using FloatTable = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;

CubePyramid pyramid_of(const Floats& padded, const Table& sides) {
  if (sides.size() < 1 || sides.size() > size_t(kMaxCubeLevels))
    throw std::invalid_argument("cubemap: " + std::to_string(sides.size()) + " levels; 1 to 16 are possible");
  CubePyramid pyramid = {};
  pyramid.texels = padded.data();
  pyramid.levels = int(sides.size());
  int64_t start = 0;
  for (int k = 0; k < pyramid.levels; ++k) {
    const int64_t side = sides.data()[k];
    if (side < 1 || side > 4096) throw std::invalid_argument("cubemap: a level of side " + std::to_string(side));
    pyramid.side[k] = int32_t(side);
    pyramid.start[k] = int32_t(start);
    start += 6 * (side + 2) * (side + 2);
  }
  require(kCubemap, padded, "padded texels", 4 * start);
  return pyramid;
}

CubeRays rays_of(const Floats& directions, const Floats& level, int levels, int threads) {
  const int64_t count = int64_t(directions.size() / 3);
  require(kCubemap, directions, "directions", 3 * count);
  if (levels > 1) require(kCubemap, level, "level", count);
  return {count, directions.data(), levels > 1 ? level.data() : nullptr, checked_threads(threads)};
}

CubeBorder border_of(const Table& source, const Table& corners) {
  return {int64_t(source.size()), int64_t(corners.size() / 4), source.data(), corners.data()};
}

}  // namespace

void bind_light(nb::module_& m) {
  m.def("cube_pad", [](Table source, Table corners, Floats texels, Floats padded) {
    require(kCubemap, padded, "padded texels", 4 * int64_t(source.size()));
    const CubeBorder border = border_of(source, corners);
    nb::gil_scoped_release release;
    cube_pad(border, texels.data(), padded.data());
  }, nb::arg("source"), nb::arg("corners"), nb::arg("texels"), nb::arg("padded"),
     "Fills faces with a border (Q, 4) from texels (T, 3); see rtgs/light/faces.py.");
  m.def("cube_fold", [](Table source, Table corners, Floats padded, Floats texels) {
    require(kCubemap, padded, "padded texels", 4 * int64_t(source.size()));
    const CubeBorder border = border_of(source, corners);
    nb::gil_scoped_release release;
    cube_fold(border, padded.data(), int64_t(texels.size() / 3), texels.data());
  }, nb::arg("source"), nb::arg("corners"), nb::arg("padded"), nb::arg("texels"),
     "Fills the gradient of texels (T, 3) from that of faces with a border (Q, 4).");
  m.def("cube_lookup", [](Floats padded, Table sides, Floats directions, Floats level, Floats color, int threads) {
    const CubePyramid pyramid = pyramid_of(padded, sides);
    const CubeRays rays = rays_of(directions, level, pyramid.levels, threads);
    require(kCubemap, color, "color", 3 * rays.count);
    float* out = color.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(cube_lookup, pyramid, rays, out);
  }, nb::arg("padded"), nb::arg("sides"), nb::arg("directions"), nb::arg("level"), nb::arg("color"), nb::arg("threads"),
     "Fills color (P, 3) along directions (P, 3); see rtgs/light/lookup.py.");
  m.def("cube_lookup_backward", [](Floats padded, Table sides, Floats directions, Floats level, Floats upstream,
                                   Floats to_padded, Floats to_directions, Floats to_level, int threads) {
    const CubePyramid pyramid = pyramid_of(padded, sides);
    const CubeRays rays = rays_of(directions, level, pyramid.levels, threads);
    require(kCubemap, upstream, "upstream", 3 * rays.count);
    require(kCubemap, to_padded, "gradient of texels", int64_t(padded.size()));
    require(kCubemap, to_directions, "gradient of directions", 3 * rays.count);
    if (rays.level) require(kCubemap, to_level, "gradient of level", rays.count);
    const CubeGradients out = {to_padded.data(), to_directions.data(), rays.level ? to_level.data() : nullptr};
    const float* from = upstream.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(cube_lookup_backward, pyramid, rays, from, out);
  }, nb::arg("padded"), nb::arg("sides"), nb::arg("directions"), nb::arg("level"), nb::arg("upstream"),
     nb::arg("to_padded"), nb::arg("to_directions"), nb::arg("to_level"), nb::arg("threads"),
     "Adds to the gradient of texels, fills those of directions and levels.");
  m.def("cube_filter", [](Table texel, LongTable start, Table column, FloatTable weight, Table images,
                          FloatTable before, FloatTable after, Floats x, Floats spread, Floats y, int threads) {
    const int64_t texels = int64_t(before.size()), rows = int64_t(texel.size());
    require(kCubemap, start, "start", rows + 1);
    require(kCubemap, weight, "weight", int64_t(column.size()));
    require(kCubemap, images, "images", 8 * texels);
    require(kCubemap, after, "after", texels);
    require(kCubemap, x, "x", 3 * texels);
    require(kCubemap, spread, "spread", 32 * texels);
    require(kCubemap, y, "y", 3 * texels);
    const CubeFilter filter = {texels, rows, texel.data(), start.data(), column.data(), weight.data(), images.data(),
                               before.data(), after.data(), checked_threads(threads)};
    const float* from = x.data();
    float *work = spread.data(), *to = y.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(cube_filter, filter, from, work, to);
  }, nb::arg("texel"), nb::arg("start"), nb::arg("column"), nb::arg("weight"), nb::arg("images"), nb::arg("before"),
     nb::arg("after"), nb::arg("x"), nb::arg("spread"), nb::arg("y"), nb::arg("threads"),
     "Fills y (T, 3) with the filtered texels x (T, 3); see rtgs/light/prefilter.py.");
}

}  // namespace rtgs
