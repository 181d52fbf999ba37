// What every binding file shares: nanobind, array types, the register function of each file.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>

#include <cstdint>
#include <stdexcept>
#include <string>

namespace nb = nanobind;

namespace rtgs {
using FloatArray = nb::ndarray<float, nb::c_contig, nb::device::cpu>;  // contiguous float32 on the CPU, any shape

// The caller's own memory, never a copy of it: what a kernel wrote into a converted array nobody would see. An array of
// another type or order, or one that is read-only, is a TypeError, wherever it is asked for.
struct Floats : FloatArray {
  Floats() = default;
  explicit Floats(const FloatArray& array) : FloatArray(array) {}
};

// Tables are made once and kept read-only.
using Table = nb::ndarray<const int32_t, nb::c_contig, nb::device::cpu>;

// An array of `kernel`'s that does not hold `size` numbers is a ValueError.
template <typename Array>
void require(const char* kernel, const Array& a, const char* name, int64_t size) {
  if (int64_t(a.size()) != size)
    throw std::invalid_argument(std::string(kernel) + ": " + name + " holds " + std::to_string(a.size()) +
                                " numbers, expected " + std::to_string(size));
}

void bind_isa(nb::module_& m);
void bind_memory(nb::module_& m);
void bind_threads(nb::module_& m);
void bind_raster(nb::module_& m);
void bind_ellipsoids(nb::module_& m);
void bind_image(nb::module_& m);
void bind_optimizer(nb::module_& m);
void bind_mirror(nb::module_& m);
void bind_split_sum(nb::module_& m);
void bind_srgb(nb::module_& m);
void bind_blend(nb::module_& m);
void bind_traced_pixels(nb::module_& m);
void bind_surface(nb::module_& m);
void bind_wall(nb::module_& m);
void bind_wall_weights(nb::module_& m);
void bind_light(nb::module_& m);
void bind_features(nb::module_& m);
void bind_surfels(nb::module_& m);
void bind_trace(nb::module_& m);
void bind_outlines(nb::module_& m);
}  // namespace rtgs

namespace nanobind::detail {
template <>
struct type_caster<rtgs::Floats> {
  NB_TYPE_CASTER(rtgs::Floats, make_caster<rtgs::FloatArray>::Name)
  template <typename Flags>
  bool from_python(handle source, Flags flags, cleanup_list* cleanup) noexcept {
    make_caster<rtgs::FloatArray> array;
    if (!array.from_python(source, Flags(flags & ~Flags(cast_flags::convert)), cleanup)) return false;
    value = rtgs::Floats(array.value);
    return true;
  }
};
}  // namespace nanobind::detail
