// Thin walls of glass: what they reflect. Twin: rtgs/optics/dielectric.py.
#pragma once
#include <cstdint>

namespace rtgs {

// Sums over all rows are partial sums of blocks of so many, which the caller adds in their order.
constexpr int64_t kWallBlock = 1024;

struct WallAngles {
  int64_t count;
  const float* cosine;  // (P) of the angle of incidence, in air; any value
  float index;          // of refraction
  int threads;
};

#define RTGS_DECLARE_WALL_KERNELS(isa)                                                                    \
  namespace isa {                                                                                         \
  void wall_reflectance(const WallAngles&, float* reflected);                                             \
  void wall_reflectance_backward(const WallAngles&, const float* upstream, float* cosine, float* index);  \
  }  // index: (blocks) partial sums
RTGS_DECLARE_WALL_KERNELS(portable)
#if defined(__x86_64__)
RTGS_DECLARE_WALL_KERNELS(avx2)
RTGS_DECLARE_WALL_KERNELS(avx512)
#endif
#undef RTGS_DECLARE_WALL_KERNELS

}  // namespace rtgs
