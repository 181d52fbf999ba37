// The rasterisers (docs/rasterizer.md): what the kernels of surfels and ellipsoids share with their bindings. Plain structs,
// no ownership. "Gaussian" is either kind.
#pragma once
#include <cstdint>

namespace rtgs {

constexpr int kTileSide = 16;
constexpr float kMaxAlpha = 0.99f;
constexpr float kHalfLog2E = 0.72134752044448f;       // exp(-rho/2) = 2^(-kHalfLog2E rho)

struct RasterCamera {  // a view and its cut rules
  float rotation[9], translation[3];  // world to camera, rows
  float fx, fy, cx, cy;
  int width, height;
  float near, far;
  float min_alpha, log2_min_alpha;  // a contribution below it is skipped
  float min_transmittance;          // a pixel stops after the contribution that takes it below
  float low_pass;                   // surfels: 1 / variance (px^2) of the disc below which no footprint shrinks
  int tiles_x() const { return (width + kTileSide - 1) / kTileSide; }
  int tiles_y() const { return (height + kTileSide - 1) / kTileSide; }
  int64_t pixels() const { return int64_t(width) * height; }
};

struct GaussianArrays {  // N rows each, contiguous, world frame
  int64_t count;
  int channels;
  const float *means, *tangent_u, *tangent_v, *scales, *opacities, *features;  // 2 scales (surfels) or 3 (ellipsoids)
};
using SurfelArrays = GaussianArrays;

// A bound ellipse in conditional form, as it stands in a record: y's mean given x is slope_y x with variance
// 1 / inv_y2_given_x, and so on; every variance is that of the bound, so that the ellipse is where the quadratic is 1.
enum BoundField : int { kSlopeY, kSlopeX, kInvX2, kInvY2GivenX, kInvY2, kInvX2GivenY, kBoundFields };

struct TileRect {  // tiles the Gaussian may touch, inclusive; x1 < x0: none
  int16_t x0, y0, x1, y1;
  int64_t tiles() const { return x1 < x0 ? 0 : int64_t(x1 - x0 + 1) * (y1 - y0 + 1); }
};

struct RecordLayout {
  int channels;         // composited per Gaussian: features and, if asked for, the surfels' normal or the ellipsoids' depth
  int padded_channels;  // the kernel's compile-time count
  int record_stride;    // floats, whole cache lines
  int gradient_sums;    // floats of a gradient row that are in use; with `absolute` the last two are of |dL/dm|
  int gradient_stride;  // whole cache lines
  bool normal, depth;   // surfels: normal among the channels, depth fields in record and gradient row; ellipsoids: depth
                        // among the channels
  bool absolute;        // the probe gets sums over the pixels of |dL/dm|, with m the projected centre, pixels
};

struct ProjectedGaussians {
  RecordLayout layout;
  float* records;
  TileRect* rects;
  float* depths;  // z of the centre; only read where rects are not empty
};

struct DepthKey {
  uint32_t depth, id;
};

struct TileLists {  // an entry is one (Gaussian, tile) pair
  int64_t* starts;   // (tiles + 1) first entry of each tile
  int32_t* ids;      // Gaussian of each entry, front to back
  uint64_t* masks;   // blocks of the tile where it shows, written by the forward pass
  int64_t* used;     // (tiles) entries read before every pixel of the tile had stopped
  int64_t* work;     // (tiles) a measure of the backward pass's work
};

struct ForwardArgs {
  RasterCamera camera;
  ProjectedGaussians gaussians;
  TileLists tiles;
  int features;             // channels that are features
  const float* background;  // (features) or null
  float *feature_image, *extra_image;  // (features, H, W); the other channels (layout.channels - features, H, W)
  float *alpha, *transmittance;        // (H, W)
  float* entry_weights;     // (entries) sum of w; null when not asked for
  // surfels only, null when not asked for:
  float *depth, *median_depth, *distortion, *first_inverse, *moment1, *moment2;  // (H, W)
  int32_t* median_entry;                                         // (H, W) entry within the tile, -1 where none
  // ellipsoids only:
  float largest_fall;       // kHalfLog2E radius^2: how far the exponent may fall below its value at the centre
  int threads;
  float* plane(int channel) const {
    return channel < features ? feature_image + channel * camera.pixels()
                              : extra_image + (channel - features) * camera.pixels();
  }
};

struct BackwardArgs {
  ForwardArgs forward;
  // upstream gradients; null: none
  const float *grad_features, *grad_extra, *grad_alpha;
  const float *grad_depth, *grad_median, *grad_distortion;  // surfels only
  float* rows;              // one gradient row per Gaussian, zero before the call
  // Several threads: thread k takes the tiles from range_starts[k] to range_starts[k + 1]. A Gaussian's row belongs to
  // the range of its first tile; what later ranges have for it waits in the order of tiles and is added at the end.
  // So every row is summed in the order of tiles, whatever the number of threads.
  int64_t* range_starts;    // (threads + 1)
  int64_t* waiting_counts;  // (threads)
  int32_t* waiting_ids;     // (entries); those of range k from tiles.starts[range_starts[k]] on
  float* waiting_rows;      // likewise
  int* poisoned;            // set to 1 when an upstream gradient is NaN or infinite
  const float* upstream(int channel) const {
    const int feature_count = forward.features;
    const float* image = channel < feature_count ? grad_features : grad_extra;
    return image ? image + (channel < feature_count ? channel : channel - feature_count) * forward.camera.pixels() : nullptr;
  }
};

struct GaussianGradients {  // null: not wanted
  float *means, *tangent_u, *tangent_v, *scales, *opacities, *features, *screen_probe;
};

struct ProjectBackwardArgs {
  RasterCamera camera;
  GaussianArrays inputs;
  ProjectedGaussians gaussians;
  float* rows;  // zero again after the call
  GaussianGradients out;
  bool saturate;  // a gradient that overflows becomes the largest float; off, so that NaN passes, when upstream holds one
  int threads;
};

#define RTGS_RASTER_KERNELS(isa)                                                                                       \
  namespace isa {                                                                                                      \
  int padded_channels(int channels);                                                                                   \
  int64_t sort_by_depth(const ProjectedGaussians&, int64_t count, DepthKey* keys, DepthKey* spare,                    \
                        int64_t* scratch, int threads);                                                                \
  int64_t sort_scratch();                                                                                              \
  int64_t count_tiles(const RasterCamera&, const ProjectedGaussians&, const DepthKey* order, int64_t visible,          \
                      int64_t* cursors, int64_t* starts, int threads);                                                 \
  void fill_tiles(const RasterCamera&, const ProjectedGaussians&, const DepthKey* order, int64_t visible,              \
                  int64_t* cursors, int32_t* ids, int threads);                                                        \
  void sum_entry_weights(const ForwardArgs&, int64_t count, float* weight_sum);                                        \
  void split_work(const BackwardArgs&);                                                                                \
  void add_waiting(const BackwardArgs&, int64_t count);                                                                \
  }
RTGS_RASTER_KERNELS(portable)
#if defined(__x86_64__)
RTGS_RASTER_KERNELS(avx2)
RTGS_RASTER_KERNELS(avx512)
#endif
#undef RTGS_RASTER_KERNELS

}  // namespace rtgs
