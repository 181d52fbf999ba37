#include "bindings.h"
#include "isa.h"

namespace rtgs {

void bind_optimizer(nb::module_&) {}

}  // namespace rtgs
