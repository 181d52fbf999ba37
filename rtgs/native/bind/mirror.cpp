#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>

#include "bind/bindings.h"
#include "common/isa.h"
#include "common/threads.h"
#include "image/mirror.h"

namespace rtgs {
namespace {

void require(const Floats& a, const char* name, size_t size) {
  if (a.size() != size)
    throw std::invalid_argument(std::string("mirror: ") + name + " holds " + std::to_string(a.size()) +
                                " numbers, expected " + std::to_string(size));
}

using Center = std::tuple<float, float, float>;

using Own = std::optional<nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>>;

void check_own(const int64_t* own, int64_t rays, int64_t pixels) {
  bool ascends = rays == 0 || (own[0] >= 0 && own[rays - 1] < pixels);
  for (int64_t ray = 1; ray < rays; ++ray) ascends &= own[ray - 1] < own[ray];
  if (!ascends)
    throw std::invalid_argument("mirror: own must ascend within the " + std::to_string(pixels) + " pixels");
}

MirrorPixels mirror_pixels(const Floats& normal, const Floats& depth, const Floats& view, const Center& center,
                           float shortest_normal, bool raw, const Own& own, int threads) {
  const size_t count = depth.size();
  require(normal, "normal", 3 * count);
  require(view, "view", 3 * count);
  if (own) check_own(own->data(), int64_t(own->size()), int64_t(count));
  const auto [x, y, z] = center;
  return {int64_t(count), normal.data(), depth.data(), view.data(), {x, y, z}, shortest_normal, raw,
          checked_threads(threads), int64_t(own ? own->size() : count), own ? own->data() : nullptr};
}

MirrorRays rays_of(const Floats& origins, const Floats& directions, const Floats& cosine, const MirrorPixels& pixels) {
  require(origins, "origins", size_t(3 * pixels.rays));
  require(directions, "directions", size_t(3 * pixels.rays));
  require(cosine, "cosine", size_t(pixels.count));
  return {origins.data(), directions.data(), cosine.data()};
}

MicrofacetPixels microfacet_pixels(const Floats& cosine, const Floats& roughness, const Floats& f0, float cosine_floor,
                                   float roughness_floor, float bound, int threads) {
  require(roughness, "roughness", cosine.size());
  require(f0, "f0", cosine.size());
  return {int64_t(cosine.size()), cosine.data(), roughness.data(), f0.data(), cosine_floor, roughness_floor, bound,
          checked_threads(threads)};
}

}  // namespace

void bind_mirror(nb::module_& m) {
  m.def("mirror_rays", [](Floats normal, Floats depth, Floats view, Center center, float shortest_normal, bool raw,
                          Own own, Floats origins, Floats directions, Floats cosine, int threads) {
    const MirrorPixels in = mirror_pixels(normal, depth, view, center, shortest_normal, raw, own, threads);
    const MirrorRays out = rays_of(origins, directions, cosine, in);
    nb::gil_scoped_release release;
    RTGS_DISPATCH(mirror_rays, in, out);
  }, nb::arg("normal"), nb::arg("depth"), nb::arg("view"), nb::arg("center"), nb::arg("shortest_normal"), nb::arg("raw"),
     nb::arg("own").none(), nb::arg("origins"), nb::arg("directions"), nb::arg("cosine"), nb::arg("threads"),
     "Fills origins, directions (R, 3) of the mirror rays of the pixels own (R), None: of all P, and cosine (P); see "
     "rtgs/methods/shading/mirror.py.");
  m.def("mirror_rays_backward", [](Floats normal, Floats depth, Floats view, Center center, float shortest_normal,
                                   bool raw, Own own, Floats to_origins, Floats to_directions,
                                   Floats to_cosine, Floats to_normal, Floats to_depth, int threads) {
    const MirrorPixels in = mirror_pixels(normal, depth, view, center, shortest_normal, raw, own, threads);
    const MirrorRays upstream = rays_of(to_origins, to_directions, to_cosine, in);
    require(to_normal, "gradient of normal", normal.size());
    require(to_depth, "gradient of depth", depth.size());
    const MirrorPixelGradients out = {to_normal.data(), to_depth.data()};
    nb::gil_scoped_release release;
    RTGS_DISPATCH(mirror_rays_backward, in, upstream, out);
  }, nb::arg("normal"), nb::arg("depth"), nb::arg("view"), nb::arg("center"), nb::arg("shortest_normal"), nb::arg("raw"),
     nb::arg("own").none(), nb::arg("to_origins"), nb::arg("to_directions"), nb::arg("to_cosine"), nb::arg("to_normal"), nb::arg("to_depth"),
     nb::arg("threads"), "Fills the gradients by normal and depth from those of the three outputs.");
  m.def("microfacet_reflection", [](Floats cosine, Floats roughness, Floats f0, float cosine_floor,
                                    float roughness_floor, float bound, Floats weight, int threads) {
    const MicrofacetPixels in = microfacet_pixels(cosine, roughness, f0, cosine_floor, roughness_floor, bound, threads);
    require(weight, "weight", cosine.size());
    float* out = weight.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(microfacet_reflection, in, out);
  }, nb::arg("cosine"), nb::arg("roughness"), nb::arg("f0"), nb::arg("cosine_floor"), nb::arg("roughness_floor"),
     nb::arg("bound"), nb::arg("weight"), nb::arg("threads"),
     "Fills the weight of the reflected colour; bound is 1 / S_max; see rtgs/optics/microfacet.py.");
  m.def("microfacet_reflection_backward", [](Floats cosine, Floats roughness, Floats f0, float cosine_floor,
                                             float roughness_floor, float bound, Floats upstream, Floats to_cosine,
                                             Floats to_roughness, Floats to_f0, int threads) {
    const MicrofacetPixels in = microfacet_pixels(cosine, roughness, f0, cosine_floor, roughness_floor, bound, threads);
    for (const Floats* a : {&upstream, &to_cosine, &to_roughness, &to_f0}) require(*a, "a gradient", cosine.size());
    const float* from = upstream.data();
    const MicrofacetGradients out = {to_cosine.data(), to_roughness.data(), to_f0.data()};
    nb::gil_scoped_release release;
    RTGS_DISPATCH(microfacet_reflection_backward, in, from, out);
  }, nb::arg("cosine"), nb::arg("roughness"), nb::arg("f0"), nb::arg("cosine_floor"), nb::arg("roughness_floor"),
     nb::arg("bound"), nb::arg("upstream"), nb::arg("to_cosine"), nb::arg("to_roughness"), nb::arg("to_f0"),
     nb::arg("threads"), "Fills the gradients by cosine, roughness and f0.");
}

}  // namespace rtgs
