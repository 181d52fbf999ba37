// The ellipsoid rasteriser's record and gradient row (docs/rasterizer.md, "Ellipsoids").
#pragma once
#include "raster/raster.h"

namespace rtgs {

constexpr float kSqrtHalfLog2E = 0.849321800288f;  // scales w so that exp(-rho/2) = 2^-|w|^2

// One record per ellipsoid, a single cache line with up to four channels. With d = pixel - mean:
// w = (l0 dx, l1 dx + l2 dy), alpha_raw = opacity 2^-|w|^2.
struct EllipsoidRecord {
  enum Field : int {
    kMeanX, kMeanY, kL0, kL1, kL2,
    kLogOpacity,  // log2, antialiasing included
    kBound, kBoundEnd = kBound + kBoundFields - 1,
    kChannels,  // features, then the centre's z if asked for, then zeros up to the padded count
  };
};

// Sums over the pixels of one ellipsoid, before the chain rule of the projection. g = dL/d ln(alpha_raw).
struct EllipsoidSums {
  enum Field : int { kLogAlpha, kW0, kW1, kW00, kW01, kW11, kChannels };  // of g, g w, g w w^T
};

struct EllipsoidSettings {
  float dilation;        // px^2
  float largest_radius;  // squared, in standard deviations
  bool antialiased;
};

#define RTGS_ELLIPSOID_KERNELS(isa)                                                                                    \
  namespace isa {                                                                                                      \
  void project_ellipsoids(const RasterCamera&, const EllipsoidSettings&, const GaussianArrays&,                        \
                          const ProjectedGaussians&, int threads);                                                     \
  void ellipsoid_forward(const ForwardArgs&);                                                                          \
  void ellipsoid_backward(const BackwardArgs&, int64_t count);                                                         \
  void project_ellipsoids_backward(const ProjectBackwardArgs&, const EllipsoidSettings&);                              \
  }
RTGS_ELLIPSOID_KERNELS(portable)
#if defined(__x86_64__)
RTGS_ELLIPSOID_KERNELS(avx2)
RTGS_ELLIPSOID_KERNELS(avx512)
#endif
#undef RTGS_ELLIPSOID_KERNELS

}  // namespace rtgs
