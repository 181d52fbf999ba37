#include "bind/bindings.h"

NB_MODULE(_core, m) {
  // A rendered view that is alive when the interpreter ends (its autograd graph, in a traceback or a global) is no leak.
  nb::set_leak_warnings(false);
  m.doc() = "rtgs native core: CPU kernels in explicit SIMD, chosen at run time (see rtgs/native/common/isa.h)";
#if defined(RTGS_SANITIZE)
  m.attr("sanitized") = true;
#else
  m.attr("sanitized") = false;
#endif
  rtgs::bind_isa(m);
  rtgs::bind_memory(m);
  rtgs::bind_threads(m);
  rtgs::bind_image(m);
  rtgs::bind_surfels(m);
  rtgs::bind_optimizer(m);
  rtgs::bind_mirror(m);
  rtgs::bind_split_sum(m);
  rtgs::bind_srgb(m);
  rtgs::bind_blend(m);
  rtgs::bind_traced_pixels(m);
  rtgs::bind_surface(m);
  rtgs::bind_wall(m);
  rtgs::bind_wall_weights(m);
  rtgs::bind_light(m);
  rtgs::bind_features(m);
  rtgs::bind_raster(m);
  rtgs::bind_ellipsoids(m);
  rtgs::bind_trace(m);
  rtgs::bind_outlines(m);
}
