#include <nanobind/stl/optional.h>

#include <optional>
#include <stdexcept>

#include "bind/bindings.h"
#include "common/isa.h"
#include "common/threads.h"
#include "gaussians/activation.h"

namespace rtgs {
namespace {

void require(const Floats& a, const char* name, size_t count, size_t columns) {
  if (a.size() != count * columns)
    throw std::invalid_argument(std::string("activate_gaussians: ") + name + " holds " + std::to_string(a.size()) +
                                " numbers, expected " + std::to_string(count) + " x " + std::to_string(columns));
}

ActivationShape checked_shape(const nb::tuple& center, int degree, const Floats (&raw)[6], size_t count, int threads) {
  const Floats& sh_rest = raw[5];
  if (sh_rest.ndim() != 3 || sh_rest.shape(0) != count || sh_rest.shape(2) != 3)
    throw std::invalid_argument("activate_gaussians: sh_rest must be (N, K, 3)");
  const int rest = int(sh_rest.shape(1));
  if (degree < 0 || degree > 3 || (degree + 1) * (degree + 1) - 1 > rest)
    throw std::invalid_argument("activate_gaussians: SH degree " + std::to_string(degree) + " does not fit the " +
                                std::to_string(rest) + " stored coefficients (degree 0 .. 3)");
  ActivationShape shape{long(count), degree, rest, int(raw[1].shape(1)), {}, checked_threads(threads)};
  for (int k = 0; k < 3; ++k) shape.center[k] = nb::cast<float>(center[k]);
  return shape;
}

RawSurfels checked_raw(const nb::tuple& raw, size_t& count, Floats (&hold)[6]) {
  if (raw.size() != 6) throw std::invalid_argument("activate_gaussians: six raw parameters expected");
  for (int k = 0; k < 6; ++k) hold[k] = nb::cast<Floats>(raw[k]);
  count = hold[0].ndim() == 2 ? hold[0].shape(0) : 0;
  require(hold[0], "means", count, 3);
  if (hold[1].ndim() != 2 || (hold[1].shape(1) != 2 && hold[1].shape(1) != 3))
    throw std::invalid_argument("activate_gaussians: log_scales must be (N, 2), or (N, 3) of ellipsoids");
  require(hold[1], "log_scales", count, hold[1].shape(1));
  require(hold[2], "quaternions", count, 4);
  require(hold[3], "opacity_logits", count, 1);
  require(hold[4], "sh_dc", count, 3);
  return {hold[0].data(), hold[1].data(), hold[2].data(), hold[3].data(), hold[4].data(), hold[5].data()};
}

struct ActivatedArrays {
  Floats tangent_u, tangent_v, scales, opacities, colors;
  ActivatedArrays(const nb::tuple& t, size_t count, size_t scale_count)
      : tangent_u(nb::cast<Floats>(t[0])), tangent_v(nb::cast<Floats>(t[1])), scales(nb::cast<Floats>(t[2])),
        opacities(nb::cast<Floats>(t[3])), colors(nb::cast<Floats>(t[4])) {
    require(tangent_u, "tangent_u", count, 3);
    require(tangent_v, "tangent_v", count, 3);
    require(scales, "scales", count, scale_count);
    require(opacities, "opacities", count, 1);
    require(colors, "colors", count, 3);
  }
};

size_t saved_size(size_t count) { return (count + kSavedGroup - 1) / kSavedGroup * kSavedGroup * kSavedFloats; }

void activate(const nb::tuple& raw, const nb::tuple& center, int degree, const nb::tuple& out,
              std::optional<Floats> saved, int threads) {
  size_t count;
  Floats hold[6];
  const RawSurfels in = checked_raw(raw, count, hold);
  const ActivationShape shape = checked_shape(center, degree, hold, count, threads);
  const ActivatedArrays a(out, count, shape.scales);
  if (saved) require(*saved, "saved", saved_size(count), 1);
  const Activated to = {a.tangent_u.data(), a.tangent_v.data(), a.scales.data(), a.opacities.data(), a.colors.data()};
  float* keep = saved ? saved->data() : nullptr;
  nb::gil_scoped_release release;
  RTGS_DISPATCH(activate_gaussians, shape, in, to, keep);
}

void activate_backward(const nb::tuple& raw, const nb::tuple& center, int degree, const Floats& scales,
                       const Floats& saved, const nb::tuple& upstream, const nb::tuple& gradients, int threads) {
  size_t count, gradient_count;
  Floats hold[6], gradient_hold[6];
  const RawSurfels in = checked_raw(raw, count, hold);
  checked_raw(gradients, gradient_count, gradient_hold);
  const ActivationShape shape = checked_shape(center, degree, hold, count, threads);
  if (gradient_count != count || gradient_hold[1].size() != hold[1].size() || gradient_hold[5].size() != hold[5].size())
    throw std::invalid_argument("activate_gaussians: gradients must have the shapes of the parameters");
  const ActivatedArrays a(upstream, count, shape.scales);
  require(scales, "scales", count, shape.scales);
  require(saved, "saved", saved_size(count), 1);
  const ActivatedGradients up = {a.tangent_u.data(), a.tangent_v.data(), a.scales.data(), a.opacities.data(),
                                 a.colors.data()};
  Floats(&g)[6] = gradient_hold;
  const RawGradients to = {g[0].data(), g[1].data(), g[2].data(), g[3].data(), g[4].data(), g[5].data()};
  nb::gil_scoped_release release;
  RTGS_DISPATCH(activate_gaussians_backward, shape, in, scales.data(), saved.data(), up, to);
}

}  // namespace

void bind_surfels(nb::module_& m) {
  m.def("activation_saved_size", &saved_size, nb::arg("count"), "Floats the forward pass keeps for the backward pass.");
  m.def("activate_gaussians", &activate, nb::arg("raw"), nb::arg("center"), nb::arg("degree"), nb::arg("out"),
        nb::arg("saved").none(), nb::arg("threads"),
        "Fills out = (tangent_u, tangent_v, scales, opacities, colors) from the six raw parameters; saved may be None.");
  m.def("activate_gaussians_backward", &activate_backward, nb::arg("raw"), nb::arg("center"), nb::arg("degree"),
        nb::arg("scales"), nb::arg("saved"), nb::arg("upstream"), nb::arg("gradients"),
        nb::arg("threads"), "Fills the six gradients from the upstream gradients of activate_gaussians' outputs.");
}

}  // namespace rtgs
