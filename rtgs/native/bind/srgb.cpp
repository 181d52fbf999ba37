#include <stdexcept>

#include "bind/bindings.h"
#include "common/isa.h"
#include "common/threads.h"
#include "image/srgb.h"

namespace rtgs {
namespace {

SrgbNumbers numbers(const Floats& from, const Floats& to, int threads) {
  if (from.size() != to.size()) throw std::invalid_argument("srgb: as many numbers must come out as go in");
  return {int64_t(from.size()), from.data(), to.data(), checked_threads(threads)};
}

}  // namespace

void bind_srgb(nb::module_& m) {
  m.def("srgb_decode", [](Floats color, Floats light, int threads) {
    const SrgbNumbers in = numbers(color, light, threads);
    nb::gil_scoped_release release;
    RTGS_DISPATCH(srgb_decode, in);
  }, nb::arg("color"), nb::arg("light"), nb::arg("threads"), "Fills light with the linear light of color.");
  m.def("srgb_encode", [](Floats light, Floats color, int threads) {
    const SrgbNumbers in = numbers(light, color, threads);
    nb::gil_scoped_release release;
    RTGS_DISPATCH(srgb_encode, in);
  }, nb::arg("light"), nb::arg("color"), nb::arg("threads"), "Fills color with the sRGB encoding of light.");
  m.def("srgb_decode_backward", [](Floats color, Floats upstream, Floats gradient, int threads) {
    const SrgbNumbers in = numbers(color, gradient, threads);
    numbers(upstream, gradient, threads);
    const float* from = upstream.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(srgb_decode_backward, in, from);
  }, nb::arg("color"), nb::arg("upstream"), nb::arg("gradient"), nb::arg("threads"),
     "Fills gradient, by color, from that by its light.");
  m.def("srgb_encode_backward", [](Floats light, Floats upstream, Floats gradient, int threads) {
    const SrgbNumbers in = numbers(light, gradient, threads);
    numbers(upstream, gradient, threads);
    const float* from = upstream.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(srgb_encode_backward, in, from);
  }, nb::arg("light"), nb::arg("upstream"), nb::arg("gradient"), nb::arg("threads"),
     "Fills gradient, by light, from that by its color.");
}

}  // namespace rtgs
