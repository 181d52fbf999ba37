#include <nanobind/stl/tuple.h>

#include <tuple>

#include "bind/bindings.h"
#include "common/isa.h"
#include "common/threads.h"
#include "image/split_sum.h"

namespace rtgs {
namespace {

const char* const kName = "split sum";

using FloatTable = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Center = std::tuple<float, float, float>;

LobePixels lobe_pixels(const Floats& cosine, const Floats& roughness, const Floats& reflectance,
                       const FloatTable& table, int side, float widest, float smallest_roughness, int threads) {
  const int64_t count = int64_t(cosine.size());
  const int64_t colors = count ? int64_t(reflectance.size()) / count : 0;
  if (side < 2 || side > 4096) throw std::invalid_argument("split sum: a table of side " + std::to_string(side));
  require(kName, roughness, "roughness", count);
  require(kName, reflectance, "reflectance", colors * count);
  require(kName, table, "table", 2 * int64_t(side) * side);
  return {count, colors, cosine.data(), roughness.data(), reflectance.data(), table.data(), side, widest,
          smallest_roughness, checked_threads(threads)};
}

MeanPixels mean_pixels(const Floats& normal, const Floats& alpha, const Floats& view, bool unit, float smallest_alpha,
                       float shortest, int threads) {
  const int64_t count = int64_t(alpha.size());
  require(kName, normal, "normal", 3 * count);
  require(kName, view, "view", 3 * count);
  return {count, normal.data(), alpha.data(), view.data(), unit, smallest_alpha, shortest, checked_threads(threads)};
}

LightRows light_rows(const Floats& means, const Floats& tangent_u, const Floats& tangent_v, const Center& center,
                     const Floats& dc, const Floats& rest, int threads) {
  const int64_t count = int64_t(means.size() / 3);
  for (const Floats* each : {&means, &tangent_u, &tangent_v, &dc}) require(kName, *each, "rows", 3 * count);
  require(kName, rest, "rest", 45 * count);
  const auto [x, y, z] = center;
  return {count, means.data(), tangent_u.data(), tangent_v.data(), {x, y, z}, dc.data(), rest.data(),
          checked_threads(threads)};
}

}  // namespace

void bind_split_sum(nb::module_& m) {
  m.def("lobe_weight", [](Floats cosine, Floats roughness, Floats reflectance, FloatTable table, int side, float widest,
                          float smallest_roughness, Floats weight, int threads) {
    const LobePixels in = lobe_pixels(cosine, roughness, reflectance, table, side, widest, smallest_roughness, threads);
    require(kName, weight, "weight", int64_t(reflectance.size()));
    float* out = weight.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(lobe_weight, in, out);
  }, nb::arg("cosine"), nb::arg("roughness"), nb::arg("reflectance"), nb::arg("table"), nb::arg("side"),
     nb::arg("widest"), nb::arg("smallest_roughness"), nb::arg("weight"), nb::arg("threads"),
     "Fills the weights (C, P) of P lobes; see rtgs/optics/split_sum.py.");
  m.def("lobe_weight_backward", [](Floats cosine, Floats roughness, Floats reflectance, FloatTable table, int side,
                                   float widest, float smallest_roughness, Floats upstream, Floats to_cosine,
                                   Floats to_roughness, Floats to_reflectance, int threads) {
    const LobePixels in = lobe_pixels(cosine, roughness, reflectance, table, side, widest, smallest_roughness, threads);
    for (const Floats* each : {&upstream, &to_reflectance})
      require(kName, *each, "a gradient", int64_t(reflectance.size()));
    for (const Floats* each : {&to_cosine, &to_roughness}) require(kName, *each, "a gradient", in.count);
    const float* from = upstream.data();
    const LobeGradients out = {to_cosine.data(), to_roughness.data(), to_reflectance.data()};
    nb::gil_scoped_release release;
    RTGS_DISPATCH(lobe_weight_backward, in, from, out);
  }, nb::arg("cosine"), nb::arg("roughness"), nb::arg("reflectance"), nb::arg("table"), nb::arg("side"),
     nb::arg("widest"), nb::arg("smallest_roughness"), nb::arg("upstream"), nb::arg("to_cosine"),
     nb::arg("to_roughness"), nb::arg("to_reflectance"), nb::arg("threads"),
     "Fills the gradients by cosine, roughness and reflectance.");
  m.def("mean_mirror", [](Floats normal, Floats alpha, Floats view, bool unit, float smallest_alpha, float shortest,
                          Floats directions, Floats cosine, int threads) {
    const MeanPixels in = mean_pixels(normal, alpha, view, unit, smallest_alpha, shortest, threads);
    require(kName, directions, "directions", 3 * in.count);
    require(kName, cosine, "cosine", in.count);
    float *to = directions.data(), *along = cosine.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(mean_mirror, in, to, along);
  }, nb::arg("normal"), nb::arg("alpha"), nb::arg("view"), nb::arg("unit"), nb::arg("smallest_alpha"),
     nb::arg("shortest"), nb::arg("directions"), nb::arg("cosine"), nb::arg("threads"),
     "Fills the mirror directions (P, 3) and cosines (P); see rtgs/methods/shading/split_sum.py.");
  m.def("mean_mirror_backward", [](Floats normal, Floats alpha, Floats view, bool unit, float smallest_alpha,
                                   float shortest, Floats to_directions, Floats to_cosine, Floats to_normal,
                                   Floats to_alpha, int threads) {
    const MeanPixels in = mean_pixels(normal, alpha, view, unit, smallest_alpha, shortest, threads);
    for (const Floats* each : {&to_directions, &to_normal}) require(kName, *each, "a gradient", 3 * in.count);
    for (const Floats* each : {&to_cosine, &to_alpha}) require(kName, *each, "a gradient", in.count);
    const float *directions = to_directions.data(), *cosine = to_cosine.data();
    const MeanGradients out = {to_normal.data(), to_alpha.data()};
    nb::gil_scoped_release release;
    RTGS_DISPATCH(mean_mirror_backward, in, directions, cosine, out);
  }, nb::arg("normal"), nb::arg("alpha"), nb::arg("view"), nb::arg("unit"), nb::arg("smallest_alpha"),
     nb::arg("shortest"), nb::arg("to_directions"), nb::arg("to_cosine"), nb::arg("to_normal"), nb::arg("to_alpha"),
     nb::arg("threads"), "Fills the gradients by normal and alpha.");
  m.def("mirror_light", [](Floats means, Floats tangent_u, Floats tangent_v, Center center, Floats dc, Floats rest,
                           Floats color, int threads) {
    const LightRows in = light_rows(means, tangent_u, tangent_v, center, dc, rest, threads);
    require(kName, color, "color", 3 * in.count);
    float* out = color.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(mirror_light, in, out);
  }, nb::arg("means"), nb::arg("tangent_u"), nb::arg("tangent_v"), nb::arg("center"), nb::arg("dc"), nb::arg("rest"),
     nb::arg("color"), nb::arg("threads"),
     "Fills the light (N, 3) of surfels along their mirror directions; see rtgs/methods/shading/mirror_light.py.");
  m.def("mirror_light_backward", [](Floats means, Floats tangent_u, Floats tangent_v, Center center, Floats dc,
                                    Floats rest, Floats upstream, nb::tuple gradients, int threads) {
    const LightRows in = light_rows(means, tangent_u, tangent_v, center, dc, rest, threads);
    require(kName, upstream, "a gradient", 3 * in.count);
    if (gradients.size() != 5) throw std::invalid_argument("split sum: there are 5 arrays of gradients");
    Floats to[5];
    for (int k = 0; k < 5; ++k) to[k] = nb::cast<Floats>(gradients[k], false);
    for (int k = 0; k < 5; ++k) require(kName, to[k], "a gradient", (k == 4 ? 45 : 3) * in.count);
    const float* from = upstream.data();
    const LightGradients out = {to[0].data(), to[1].data(), to[2].data(), to[3].data(), to[4].data()};
    nb::gil_scoped_release release;
    RTGS_DISPATCH(mirror_light_backward, in, from, out);
  }, nb::arg("means"), nb::arg("tangent_u"), nb::arg("tangent_v"), nb::arg("center"), nb::arg("dc"), nb::arg("rest"),
     nb::arg("upstream"), nb::arg("gradients"), nb::arg("threads"),
     "Fills the gradients by means, tangents, and both parts of the coefficients.");
}

}  // namespace rtgs
