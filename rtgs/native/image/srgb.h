// The sRGB curve (IEC 61966-2-1) and its inverse, number by number. Twin: rtgs/optics/light.py.
#pragma once
#include <cstdint>

namespace rtgs {

struct SrgbNumbers {
  int64_t count;
  const float* from;
  float* to;
  int threads;
};

#define RTGS_DECLARE_SRGB_KERNELS(isa)                                            \
  namespace isa {                                                                 \
  void srgb_decode(const SrgbNumbers&);                                           \
  void srgb_encode(const SrgbNumbers&);                                           \
  void srgb_decode_backward(const SrgbNumbers&, const float* upstream);           \
  void srgb_encode_backward(const SrgbNumbers&, const float* upstream);           \
  }
RTGS_DECLARE_SRGB_KERNELS(portable)
#if defined(__x86_64__)
RTGS_DECLARE_SRGB_KERNELS(avx2)
RTGS_DECLARE_SRGB_KERNELS(avx512)
#endif
#undef RTGS_DECLARE_SRGB_KERNELS

}  // namespace rtgs
