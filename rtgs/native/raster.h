// The surfel rasteriser (docs/rasterizer.md): what its kernels share with their binding. Plain structs, no ownership.
#pragma once
#include <cstdint>

namespace rtgs {

constexpr int kTileSide = 16;
constexpr float kMinAlpha = 1.f / 255.f;
constexpr float kMaxAlpha = 0.99f;
constexpr float kMinTransmittance = 1e-4f;
constexpr float kLog2MinAlpha = -7.99435343685886f;   // log2(1/255)
constexpr float kHalfLog2E = 0.72134752044448f;       // exp(-rho/2) = 2^(-kHalfLog2E rho)

struct RasterCamera {
  float rotation[9], translation[3];  // world to camera, rows
  float fx, fy, cx, cy;
  int width, height;
  float near, far;
  int tiles_x() const { return (width + kTileSide - 1) / kTileSide; }
  int tiles_y() const { return (height + kTileSide - 1) / kTileSide; }
  int64_t pixels() const { return int64_t(width) * height; }
};

struct SurfelArrays {  // N rows each, contiguous, world frame
  int64_t count;
  int channels;
  const float *means, *tangent_u, *tangent_v, *scales, *opacities, *features;
};

// One record per surfel: what a pixel needs, in the order of use. Relative to the projected centre, d = pixel - mean:
// (u, v) = (ux dx + uy dy, vx dx + vy dy) / D with D = dx_ dx + dy_ dy + d0, all seven divided by one positive number.
enum RecordField : int {
  kMeanX, kMeanY, kUx, kUy, kVx, kVy, kDx, kDy, kD0,
  kLogOpacity,   // log2
  kMinInverse,   // the plane's hit counts where 1/D >= this (in front of the camera, not before `near`)
  kBoundX, kBoundY, kSlopeY, kSlopeX, kInvX2, kInvY2GivenX, kInvY2, kInvX2GivenY,  // bound ellipse, see raster_block.h
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

struct TileRect {  // tiles the surfel may touch, inclusive; x1 < x0: none
  int16_t x0, y0, x1, y1;
  int64_t tiles() const { return x1 < x0 ? 0 : int64_t(x1 - x0 + 1) * (y1 - y0 + 1); }
};

struct RecordLayout {
  int channels;         // composited per surfel: features and, if asked for, the normal
  int padded_channels;  // the kernel's compile-time count
  int record_stride;    // floats, whole cache lines
  int gradient_stride;  // likewise; the first gradient_sums() are in use
  bool normal, depth;   // normal among the channels; depth fields in the record and in the gradient row
  int gradient_sums() const { return kGradChannels + padded_channels + (depth ? 2 : 0); }
};

struct ProjectedSurfels {
  RecordLayout layout;
  float* records;
  TileRect* rects;
  float* depths;  // z of the centre; only read where rects are not empty
};

struct DepthKey {
  uint32_t depth, id;
};

struct TileLists {  // an entry is one (surfel, tile) pair
  int64_t* starts;   // (tiles + 1) first entry of each tile
  int32_t* ids;      // surfel of each entry, front to back
  uint64_t* masks;   // blocks of the tile where the surfel shows, written by the forward pass
  int64_t* used;     // (tiles) entries read before every pixel of the tile had stopped
  int64_t* work;     // (tiles) a measure of the backward pass's work
};

struct ForwardArgs {
  RasterCamera camera;
  ProjectedSurfels surfels;
  TileLists tiles;
  int features;             // channels that are features; the rest of layout.channels is the normal
  const float* background;  // (features) or null
  float *feature_image, *normal_image;  // (features, H, W), (3, H, W)
  float *alpha, *transmittance;         // (H, W)
  // optional, null when not asked for:
  float *depth, *median_depth, *distortion, *first_inverse, *moment1, *moment2;  // (H, W)
  int32_t* median_entry;                                         // (H, W) entry within the tile, -1 where none
  float* entry_weights;     // (entries) sum of w
  int threads;
  float* plane(int channel) const {
    return channel < features ? feature_image + channel * camera.pixels()
                              : normal_image + (channel - features) * camera.pixels();
  }
};

struct BackwardArgs {
  ForwardArgs forward;
  // upstream gradients; null: none
  const float *grad_features, *grad_normal, *grad_alpha, *grad_depth, *grad_median, *grad_distortion;
  float* rows;              // one gradient row per surfel, zero before the call
  // Several threads: thread k takes the tiles from range_starts[k] to range_starts[k + 1]. A surfel's row belongs to
  // the range of its first tile; what later ranges have for it waits in the order of tiles and is added at the end.
  // So every row is summed in the order of tiles, whatever the number of threads.
  int64_t* range_starts;    // (threads + 1)
  int64_t* waiting_counts;  // (threads)
  int32_t* waiting_ids;     // (entries); those of range k from tiles.starts[range_starts[k]] on
  float* waiting_rows;      // likewise
  int* poisoned;            // set to 1 when an upstream gradient is NaN or infinite
  const float* upstream(int channel) const {
    const int feature_count = forward.features;
    const float* image = channel < feature_count ? grad_features : grad_normal;
    return image ? image + (channel < feature_count ? channel : channel - feature_count) * forward.camera.pixels() : nullptr;
  }
};

struct SurfelGradients {  // null: not wanted
  float *means, *tangent_u, *tangent_v, *scales, *opacities, *features, *screen_probe;
};

struct ProjectBackwardArgs {
  RasterCamera camera;
  SurfelArrays inputs;
  ProjectedSurfels surfels;
  float* rows;  // zero again after the call
  SurfelGradients out;
  bool saturate;  // a gradient that overflows becomes the largest float; off, so that NaN passes, when upstream holds one
  int threads;
};

#define RTGS_RASTER_KERNELS(isa)                                                                                       \
  namespace isa {                                                                                                      \
  int padded_channels(int channels);                                                                                   \
  void project_surfels(const RasterCamera&, const SurfelArrays&, const ProjectedSurfels&, int threads);                \
  int64_t sort_by_depth(const ProjectedSurfels&, int64_t count, DepthKey* keys, DepthKey* spare,                      \
                        int64_t* scratch, int threads);                                                                \
  int64_t sort_scratch();                                                                                              \
  int64_t count_tiles(const RasterCamera&, const ProjectedSurfels&, const DepthKey* order, int64_t visible,            \
                      int64_t* cursors, int64_t* starts, int threads);                                                 \
  void fill_tiles(const RasterCamera&, const ProjectedSurfels&, const DepthKey* order, int64_t visible,                \
                  int64_t* cursors, int32_t* ids, int threads);                                                        \
  void raster_forward(const ForwardArgs&);                                                                             \
  void sum_entry_weights(const ForwardArgs&, int64_t count, float* weight_sum);                                        \
  void raster_backward(const BackwardArgs&, int64_t count);                                                            \
  void project_backward(const ProjectBackwardArgs&);                                                                   \
  }
RTGS_RASTER_KERNELS(portable)
#if defined(__x86_64__)
RTGS_RASTER_KERNELS(avx2)
RTGS_RASTER_KERNELS(avx512)
#endif
#undef RTGS_RASTER_KERNELS

}  // namespace rtgs
