#include "bindings.h"

NB_MODULE(_core, m) {
  m.doc() = "rtgs native core: CPU kernels in explicit SIMD, chosen at run time (see rtgs/native/isa.h)";
  rtgs::bind_isa(m);
}
