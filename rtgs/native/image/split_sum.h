// Split-sum shading, pixel by pixel or row by row: the weight of a lobe from a table, mirror directions of composited
// normals, and light in SH along the mirror direction of each surfel. Twins: rtgs/optics/split_sum.py,
// rtgs/methods/shading/split_sum.py, rtgs/methods/shading/mirror_light.py.
#pragma once
#include <cstdint>

namespace rtgs {

struct LobePixels {  // P lobes of C colours
  int64_t count, colors;
  const float *cosine, *roughness, *reflectance;  // (P), (P), (C, P)
  const float* table;                             // (side, side, 2): A and B at sqrt(width / widest) and the cosine
  int side;
  float widest, smallest_roughness;
  int threads;
};
struct LobeGradients {
  float *cosine, *roughness, *reflectance;
};

struct MeanPixels {
  int64_t count;
  const float *normal, *alpha, *view;  // (3, P) sum of w n, (P), (3, P)
  bool unit;                           // the normal is made unit, else divided by alpha
  float smallest_alpha, shortest;
  int threads;
};
struct MeanGradients {
  float *normal, *alpha;
};

struct LightRows {  // N surfels
  int64_t count;
  const float *means, *tangent_u, *tangent_v;  // (N, 3) each
  float center[3];                             // of the camera, world
  const float *dc, *rest;                      // (N, 3), (N, 45): SH of degree 3, function by function
  int threads;
};
struct LightGradients {
  float *means, *tangent_u, *tangent_v, *dc, *rest;
};

#define RTGS_DECLARE_SPLIT_SUM_KERNELS(isa)                                                                         \
  namespace isa {                                                                                                   \
  void lobe_weight(const LobePixels&, float* weight);                                                               \
  void lobe_weight_backward(const LobePixels&, const float* upstream, const LobeGradients&);                        \
  void mean_mirror(const MeanPixels&, float* directions, float* cosine);                                            \
  void mean_mirror_backward(const MeanPixels&, const float* to_directions, const float* to_cosine,                  \
                            const MeanGradients&);                                                                  \
  void mirror_light(const LightRows&, float* color);                                                                \
  void mirror_light_backward(const LightRows&, const float* upstream, const LightGradients&);                       \
  }
RTGS_DECLARE_SPLIT_SUM_KERNELS(portable)
#if defined(__x86_64__)
RTGS_DECLARE_SPLIT_SUM_KERNELS(avx2)
RTGS_DECLARE_SPLIT_SUM_KERNELS(avx512)
#endif
#undef RTGS_DECLARE_SPLIT_SUM_KERNELS

}  // namespace rtgs
