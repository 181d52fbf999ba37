#include "bindings.h"
#include "isa.h"

namespace rtgs {

void bind_raster(nb::module_&) {}

}  // namespace rtgs
