// Arguments of the image kernels (losses). Pictures are planar: (C, H, W) or (H, W), contiguous, float32.
#pragma once

namespace rtgs {

constexpr int kRowPad = 16;  // zeros on both sides of a working row: whole registers of every instruction set
// An odd number of cache lines, so that rows below each other do not compete for the same few cache sets.
static inline int padded_width(int width) { return (((width + 15) / 16 + 2 * kRowPad / 16) | 1) * 16; }

// What every thread of the photometric kernel works in, in floats.
constexpr int kBlurRows = 16;   // rows blurred down the columns: 4 rows of 4 maps
constexpr int kRingSlots = 20;  // rows of gradient maps kept: radius + group + radius + group - 1 = 17, groups of 4
constexpr int kGradientMaps = 3;
static inline long photometric_scratch(int width) {
  return long(padded_width(width)) * (kBlurRows + kGradientMaps * (kRingSlots + 1));
}

struct PhotometricArguments {
  const float* image;    // (C, H, W)
  const float* target;   // (C, H, W)
  int channels, height, width;
  float l1_scale;        // l1 / (C H W): the gradient's factor of sign(image - target)
  float dssim_scale;     // dssim / (C H W): the gradient's factor of -dSSIM/dimage
  float* gradient;       // (C, H, W) of l1 mean|x - y| + dssim (1 - SSIM), or null
  float* dissimilarity;  // (C, H, W) 1 - SSIM of each pixel, or null
  double* l1_rows;       // (C H): sum of |image - target| of each row
  double* dssim_rows;    // (C H): sum of 1 - SSIM of each row, or null: no SSIM at all
  float* scratch;        // threads x photometric_scratch(width); may be null without dssim_rows
  int threads;
};

struct ViewArguments {
  int height, width;
  float rotation[9];  // world to camera, row-major
  float focal_x, focal_y, center_x, center_y;
};

// What every thread of the normal-consistency kernel works in: 3 rows of each of 5 maps.
static inline long normal_scratch(int width) { return long(padded_width(width)) * 3 * 5; }

struct NormalArguments {
  ViewArguments view;
  const float* normal;         // (3, H, W) world, sum of w n
  const float* depth;          // (H, W) sum of w z, or the surface depth itself
  const float* alpha;          // (H, W)
  bool depth_is_surface;       // depth is not divided by alpha
  float near_depth;            // the weight is 1 up to here ...
  float inverse_depth_range;   // ... and falls by this per unit of depth, down to 0
  float scale;                 // of the gradient: 1 / (H W)
  double* rows;                // (H): sum of weight (1 - alpha normal . depth normal) of each row
  float* gradient_normal;      // (3, H, W), or null: no gradient at all
  float* gradient_depth;       // (H, W)
  float* gradient_alpha;       // (H, W), or null when depth_is_surface
  float* scratch;              // threads x normal_scratch(width)
  int threads;
};

struct MonoNormalArguments {
  ViewArguments view;
  const float* normal;     // (3, H, W) world, any length
  const float* mono;       // (3, H, W) camera frame, unit or zero (no estimate)
  const float* weight;     // (H, W), or null: 1
  float l1;                // factor of |n - mono|_1: 0 or 1
  float scale;             // of the gradient: 1 / (H W)
  double* rows;            // (H)
  float* gradient_normal;  // (3, H, W), or null
  int threads;
};

#define RTGS_DECLARE_IMAGE_KERNELS(isa)                \
  namespace isa {                                      \
  void photometric(const PhotometricArguments& a);     \
  void normal_consistency(const NormalArguments& a);   \
  void mono_normal(const MonoNormalArguments& a);      \
  }
RTGS_DECLARE_IMAGE_KERNELS(portable)
RTGS_DECLARE_IMAGE_KERNELS(avx2)
RTGS_DECLARE_IMAGE_KERNELS(avx512)
#undef RTGS_DECLARE_IMAGE_KERNELS

}  // namespace rtgs
