#include "bindings.h"
#include "isa.h"

namespace rtgs {

void bind_surfels(nb::module_&) {}

}  // namespace rtgs
