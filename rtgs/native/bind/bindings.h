// What every binding file shares: nanobind, array types, the register function of each file.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>

#include <cstdint>

namespace nb = nanobind;

namespace rtgs {
using Floats = nb::ndarray<float, nb::c_contig, nb::device::cpu>;   // contiguous float32 on the CPU, any shape
using Ints = nb::ndarray<int32_t, nb::c_contig, nb::device::cpu>;

void bind_isa(nb::module_& m);
void bind_raster(nb::module_& m);
void bind_ellipsoids(nb::module_& m);
void bind_image(nb::module_& m);
void bind_optimizer(nb::module_& m);
void bind_mirror(nb::module_& m);
void bind_srgb(nb::module_& m);
void bind_surfels(nb::module_& m);
void bind_trace(nb::module_& m);
}  // namespace rtgs
