// Traced lights blended into the picture, and planes of the picture taken at some of its pixels. Twins:
// rtgs/methods/shading/blend.py, rtgs/methods/shading/pixel_maps.py.
#pragma once
#include <cstdint>

namespace rtgs {

constexpr int kMostLights = 8;

// Of N pixels of a picture P are traced; `index` (P) says which, none twice, each in 0 .. N - 1.
struct TracedIndex {
  int64_t pixels, count;  // N, P
  const int64_t* index;
  int threads;
};

struct BlendedLight {
  float* weight;      // (P), or (3, P)
  int weight_planes;  // 1 or 3
  float* color;       // (3, P), encoded
};
// Or where their gradients go; a null pointer: nowhere.
struct BlendedPixels {
  float *diffuse, *specular;  // (3, N), encoded; (P)
  BlendedLight lights[kMostLights];
};
struct BlendRules {
  int lights;
  bool linear, additive;
  const float* emphasis;  // (P) factor of the gradient by what lights change; null: 1
};

// Values of planes[k] (N) at the index to rows[k] (P); or back, where no pixel is traced 0.
struct PixelPlanes {
  int count;
  float* const* planes;
  float* const* rows;
};
void take_planes(const TracedIndex&, const PixelPlanes&);
void put_planes(const TracedIndex&, const PixelPlanes&);

// Directions of the rays through the pixels of the index: the sum of what column and row say.
struct RayTables {
  int64_t width;
  const double *across, *along;  // (width, 3), (rows, 3)
};
void take_rays(const TracedIndex&, const RayTables&, bool rows, float* directions);  // (P, 3) if `rows`, else (3, P)

// Colours of R rays for the P pixels that show them, `ray` (P) says which, 0 .. R - 1; and the gradient by the rays'.
struct ShownRays {
  int64_t pixels, rays;  // P, R
  const int64_t* ray;
};
void show_rays(const ShownRays&, const float* colors /* (R, 3) */, float* planes /* (3, P) */, int threads);
void show_rays_backward(const ShownRays&, const float* planes, float* colors);  // sums in the order of the pixels

#define RTGS_DECLARE_BLEND_KERNELS(isa)                                                                        \
  namespace isa {                                                                                              \
  void blend_lights(const TracedIndex&, const BlendRules&, const BlendedPixels&, float* image);                \
  void blend_lights_backward(const TracedIndex&, const BlendRules&, const BlendedPixels&, const float* upstream, \
                             const BlendedPixels& gradients);                                                  \
  }
RTGS_DECLARE_BLEND_KERNELS(portable)
#if defined(__x86_64__)
RTGS_DECLARE_BLEND_KERNELS(avx2)
RTGS_DECLARE_BLEND_KERNELS(avx512)
#endif
#undef RTGS_DECLARE_BLEND_KERNELS

}  // namespace rtgs
