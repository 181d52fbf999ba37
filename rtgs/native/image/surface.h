// What the pixels of a picture show of surfaces: of the base set, and of an object's mesh where that is known. Every
// operation is rounded as torch rounds it. Twins: rtgs/methods/shading/surface_maps.py, rtgs/mesh/spread.py.
#pragma once
#include <cstdint>

namespace rtgs {

// Of N pixels: composited roughness, f0 and depth, or the upstream gradients of what is made of them.
struct CompositedMaps {
  const float *roughness, *f0, *depth;
};
struct SurfaceMaps {  // or gradients by the composited maps
  float *roughness, *f0, *depth;
};
struct SurfaceRules {
  int64_t pixels;
  const float* alpha;
  float smallest_alpha;  // of the divisor of roughness and f0
  float covered;         // at or below this alpha there is no surface, and its depth is 0
  int threads;
};
void surface_maps(const SurfaceRules&, const CompositedMaps&, const SurfaceMaps&);
// `by_cover` and `by_depth` (N): by the alpha that materials, and the depth, are divided by.
void surface_maps_backward(const SurfaceRules&, const CompositedMaps&, const CompositedMaps& upstream,
                           const SurfaceMaps&, float* by_cover, float* by_depth);

// The mesh's surface in the pixels where it is `known`.
struct KnownSurface {
  int64_t pixels;
  const bool* known;
  const float *near, *normal;  // (N), (3, N); null: the base set's stays
  float cover;                 // of k_s that counts as all; 0: k_s stays
  int threads;
};
struct GivenSurface {  // or the upstream gradients
  const float *depth, *normal, *specular;
};
struct PutSurface {  // or the gradients
  float *depth, *normal, *specular;
};
void known_surface(const KnownSurface&, const GivenSurface&, const PutSurface&);
void known_surface_backward(const KnownSurface&, const float* specular, const GivenSurface& upstream, const PutSurface&);

// Rows of K pixels as pictures of N.
struct ObjectRows {
  int64_t count;
  const int32_t *pixels, *triangle;
  const float *near, *far, *normal;  // (K), (K), (3, K)
  const bool* second;
};
struct ObjectMaps {
  int64_t pixels;
  bool *hit, *second;
  float *near, *far, *normal;  // (N), (N), (3, N)
  int32_t* triangle;
};
void clear_object(const ObjectMaps&);  // nothing is hit
void put_object(const ObjectRows&, const ObjectMaps&);

}  // namespace rtgs
