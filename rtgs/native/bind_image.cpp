#include "bindings.h"
#include "isa.h"

namespace rtgs {

void bind_image(nb::module_&) {}

}  // namespace rtgs
