// Mirror rays and their microfacet weight, pixel by pixel. Twins: rtgs/methods/shading/mirror.py, rtgs/optics/microfacet.py.
#pragma once
#include <cstdint>

namespace rtgs {

struct MirrorPixels {
  int64_t count;
  const float *normal, *depth, *view;  // (3, P) sum of w n, (P) z-depth, (3, P) camera rays, camera-z component 1
  float center[3];                     // of the camera, world
  float shortest_normal;
  bool raw;                            // mirror rays as long as the camera's, else of unit length
  int threads;
  int64_t rays;        // R
  const int64_t* own;  // (R) ascending: the pixels whose ray is sent; null: all of them are, and R is P
};
struct MirrorRays {  // or the upstream gradients of these
  float *origins, *directions, *cosine;  // (R, 3), (R, 3), (P)
};
struct MirrorPixelGradients {
  float *normal, *depth;  // (3, P), (P)
};

struct MicrofacetPixels {
  int64_t count;
  const float *cosine, *roughness, *f0;  // (P) each
  float cosine_floor, roughness_floor, bound;  // bound: 1 / S_max, 0: none
  int threads;
};
struct MicrofacetGradients {
  float *cosine, *roughness, *f0;  // (P) each
};

#define RTGS_DECLARE_MIRROR_KERNELS(isa)                                                                              \
  namespace isa {                                                                                                     \
  void mirror_rays(const MirrorPixels&, const MirrorRays&);                                                           \
  void mirror_rays_backward(const MirrorPixels&, const MirrorRays& upstream, const MirrorPixelGradients&);            \
  void microfacet_reflection(const MicrofacetPixels&, float* weight);                                                 \
  void microfacet_reflection_backward(const MicrofacetPixels&, const float* upstream, const MicrofacetGradients&);    \
  }
RTGS_DECLARE_MIRROR_KERNELS(portable)
#if defined(__x86_64__)
RTGS_DECLARE_MIRROR_KERNELS(avx2)
RTGS_DECLARE_MIRROR_KERNELS(avx512)
#endif
#undef RTGS_DECLARE_MIRROR_KERNELS

}  // namespace rtgs
