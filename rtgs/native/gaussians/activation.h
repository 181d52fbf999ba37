// Activation of raw surfel (or ellipsoid) parameters for one camera centre, and its backward pass (method.md 2).
// S, the number of scales, is 2 for surfels and 3 for ellipsoids.
// The readable twin is rtgs.gaussians.surfels.activate.
#pragma once

namespace rtgs {

struct RawSurfels {  // rows of rtgs.gaussians.primitives.Gaussians, float32, contiguous
  const float* means;           // (N, 3)
  const float* log_scales;      // (N, S)
  const float* quaternions;     // (N, 4) w, x, y, z
  const float* opacity_logits;  // (N,)
  const float* sh_dc;           // (N, 3)
  const float* sh_rest;         // (N, rest, 3)
};
struct Activated {
  float* tangent_u;  // (N, 3)
  float* tangent_v;  // (N, 3)
  float* scales;     // (N, S)
  float* opacities;  // (N,)
  float* colors;     // (N, 3)
};
struct ActivatedGradients {  // the upstream gradient of each member of Activated
  const float* tangent_u;
  const float* tangent_v;
  const float* scales;
  const float* opacities;
  const float* colors;
};
struct RawGradients {  // the gradient of each member of RawSurfels
  float* means;
  float* log_scales;
  float* quaternions;
  float* opacity_logits;
  float* sh_dc;
  float* sh_rest;
};
struct ActivationShape {
  long count;       // N
  int degree;       // active SH degree, 0 .. 3
  int rest;         // stored coefficients above degree 0, >= those of the active degree
  int scales;       // S
  float center[3];  // camera centre, world
  int threads;
};

// What the backward pass takes from the forward pass, 12 floats a surfel in groups of 16 surfels ([group][12][16]):
// the 3 x 3 derivative of the unclamped colour by the unit direction (direction major), and per channel 1, or 0 where
// the colour was clamped. It spares a second read of 45 coefficients a surfel.
constexpr int kSavedFloats = 12, kSavedGroup = 16;

#define RTGS_DECLARE_SURFEL_KERNELS(isa)                                                                            \
  namespace isa {                                                                                                   \
  void activate_gaussians(const ActivationShape&, const RawSurfels&, const Activated&, float* saved /* or null */);   \
  void activate_gaussians_backward(const ActivationShape&, const RawSurfels&, const float* scales, const float* saved, \
                                 const ActivatedGradients&, const RawGradients&);                                   \
  }
RTGS_DECLARE_SURFEL_KERNELS(portable)
RTGS_DECLARE_SURFEL_KERNELS(avx2)
RTGS_DECLARE_SURFEL_KERNELS(avx512)
#undef RTGS_DECLARE_SURFEL_KERNELS

}  // namespace rtgs
