// The surfel rasteriser's record and gradient row (docs/rasterizer.md).
#pragma once
#include "raster/raster.h"

namespace rtgs {

// One record per surfel: what a pixel needs, in the order of use. Relative to the projected centre, d = pixel - mean:
// (u, v) = (ux dx + uy dy, vx dx + vy dy) / D with D = dx_ dx + dy_ dy + d0, all seven divided by one positive number.
enum RecordField : int {
  kMeanX, kMeanY, kUx, kUy, kVx, kVy, kDx, kDy, kD0,
  kLogOpacity,   // log2
  kMinInverse,   // the plane's hit counts where 1/D >= this (in front of the camera, not before `near`)
  kBoundX, kBoundY,  // centre of the bound ellipse
  kBound, kBoundEnd = kBound + kBoundFields - 1,
  kDisc2,        // squared radius of the low-pass disc
  kChannels,     // features, then the normal (3), then zeros up to the padded count, then kDepthFields floats
};
constexpr int kDepthFields = 2;  // z d0 (the hit's depth is z d0 / D), z of the centre

// Sums over the pixels of one surfel, before the chain rule of the projection.
enum GradientField : int {
  kGradLogAlpha,
  kGradU, kGradV, kGradD,                                      // to the numerators u, v (negated) and to D
  kGradUx, kGradUy, kGradVx, kGradVy, kGradDx, kGradDy,
  kGradDiscX, kGradDiscY,
  kGradChannels,  // then, at kGradChannels + padded_channels: sum of g_z / D over plane hits; of g_z over disc hits
};

#define RTGS_SURFEL_KERNELS(isa)                                                                                       \
  namespace isa {                                                                                                      \
  void project_surfels(const RasterCamera&, const GaussianArrays&, const ProjectedGaussians&, int threads);              \
  void raster_forward(const ForwardArgs&);                                                                             \
  void raster_backward(const BackwardArgs&, int64_t count);                                                            \
  void project_backward(const ProjectBackwardArgs&);                                                                   \
  }
RTGS_SURFEL_KERNELS(portable)
#if defined(__x86_64__)
RTGS_SURFEL_KERNELS(avx2)
RTGS_SURFEL_KERNELS(avx512)
#endif
#undef RTGS_SURFEL_KERNELS

}  // namespace rtgs
