// What the bindings of the rasterisers share: camera and arrays from Python, memory, sorting and binning.
#pragma once
#include <nanobind/stl/optional.h>

#include <cmath>
#include <optional>
#include <stdexcept>

#include "bind/bindings.h"
#include "common/isa.h"
#include "common/threads.h"
#include "raster/state.h"

namespace rtgs {

using MaybeFloats = std::optional<Floats>;
using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;

inline float* data_or_null(const MaybeFloats& array) { return array ? array->data() : nullptr; }
inline int whole_lines(int floats) { return (floats + 15) / 16 * 16; }

#if defined(RTGS_HAS_avx512)
#define RTGS_CALL(isa, function, ...)                                                                \
  ((isa) == Isa::avx512 ? avx512::function(__VA_ARGS__)                                              \
   : (isa) == Isa::avx2 ? avx2::function(__VA_ARGS__) : portable::function(__VA_ARGS__))
#else
#define RTGS_CALL(isa, function, ...) portable::function(__VA_ARGS__)
#endif

struct CameraValues {
  RasterCamera values;
  CameraValues(Doubles rotation, Doubles translation, double fx, double fy, double cx, double cy, int width, int height,
               double near, double far, double min_alpha, double min_transmittance, double low_pass) {
    for (int k = 0; k < 9; ++k) values.rotation[k] = float(rotation.data()[k]);
    for (int k = 0; k < 3; ++k) values.translation[k] = float(translation.data()[k]);
    values.fx = float(fx), values.fy = float(fy), values.cx = float(cx), values.cy = float(cy);
    values.width = width, values.height = height;
    values.near = float(near), values.far = float(far);
    values.min_alpha = float(min_alpha), values.log2_min_alpha = float(std::log2(min_alpha));
    values.min_transmittance = float(min_transmittance);
    values.low_pass = float(1 / low_pass);
  }
};

inline GaussianArrays gaussian_arrays(const Floats& means, const Floats& tangent_u, const Floats& tangent_v,
                                      const Floats& scales, const Floats& opacities, const Floats& features) {
  return {int64_t(means.shape(0)), int(features.shape(1)), means.data(), tangent_u.data(),
          tangent_v.data(), scales.data(), opacities.data(), features.data()};
}

// One rasterisation: made by the forward pass, kept alive by autograd until the backward pass is done.
class RasterSession {
 public:
  int64_t entries() const { return entries_; }
  int64_t visible() const { return visible_; }

 protected:
  explicit RasterSession(const RasterCamera& camera)
      : isa_(active_isa()), camera_(camera), memory_(RasterMemoryPool::instance().take()) {}
  ~RasterSession() { RasterMemoryPool::instance().give(std::move(memory_)); }

  // Before the projection: memory for its results.
  void start(const GaussianArrays& in, const RecordLayout& layout, int threads) {
    projected_ = false;
    threads_ = checked_threads(threads);
    count_ = in.count;
    features_ = in.channels;
    gaussians_.layout = layout;
    gaussians_.records = memory_->records.reserve((count_ + 16) * layout.record_stride + 64);
    gaussians_.rects = memory_->rects.reserve(count_ + 1);
    gaussians_.depths = memory_->depths.reserve(count_ + 16);
  }

  // After the projection: sorting and binning.
  void bin() {
    RasterMemory& m = *memory_;
    const int64_t tiles = int64_t(camera_.tiles_x()) * camera_.tiles_y();
    const int64_t sort_scratch = RTGS_CALL(isa_, sort_scratch);
    int64_t* scratch = m.scratch.reserve(sort_scratch > tiles * threads_ ? sort_scratch : tiles * threads_);
    DepthKey *keys = m.keys.reserve(count_ + 1), *spare = m.spare_keys.reserve(count_ + 1);
    visible_ = RTGS_CALL(isa_, sort_by_depth, gaussians_, count_, keys, spare, scratch, threads_);
    tiles_.starts = m.starts.reserve(tiles + 1);
    tiles_.used = m.used.reserve(tiles);
    tiles_.work = m.work.reserve(tiles);
    entries_ = RTGS_CALL(isa_, count_tiles, camera_, gaussians_, keys, visible_, scratch, tiles_.starts, threads_);
    tiles_.ids = m.ids.reserve(entries_ + 1);
    tiles_.masks = m.masks.reserve(entries_ + 1);
    RTGS_CALL(isa_, fill_tiles, camera_, gaussians_, keys, visible_, scratch, tiles_.ids, threads_);
    projected_ = true;
  }

  // What both passes need; `planes` images of scratch, the first for the transmittance.
  ForwardArgs forward_args(const Floats& feature_image, const MaybeFloats& extra_image, int planes) {
    if (!projected_) throw std::logic_error("rasterise: project() comes first, and must have succeeded");
    ForwardArgs args{};
    args.camera = camera_;
    args.gaussians = gaussians_;
    args.tiles = tiles_;
    args.features = features_;
    args.feature_image = feature_image.data();
    args.extra_image = data_or_null(extra_image);
    args.transmittance = memory_->images.reserve(planes * camera_.pixels());
    args.threads = threads_;
    return args;
  }

  void use_weight_sum(ForwardArgs& args) { args.entry_weights = memory_->entry_weights.reserve(entries_ + 1); }

  BackwardArgs backward_args(const ForwardArgs& forward, const MaybeFloats& grad_features, const MaybeFloats& grad_extra,
                             const MaybeFloats& grad_alpha, int* poisoned) {
    BackwardArgs args{};
    args.forward = forward;
    args.grad_features = data_or_null(grad_features);
    args.grad_extra = data_or_null(grad_extra);
    args.grad_alpha = data_or_null(grad_alpha);
    args.poisoned = poisoned;
    const int64_t stride = gaussians_.layout.gradient_stride;
    args.rows = memory_->rows.reserve(count_ * stride + 64, true);
    args.range_starts = memory_->ranges.reserve(2 * threads_ + 1);
    args.waiting_counts = args.range_starts + threads_ + 1;
    if (threads_ > 1) {  // sized for the worst case; little of it is ever touched
      args.waiting_ids = memory_->waiting_ids.reserve(entries_ + 1);
      args.waiting_rows = memory_->waiting_rows.reserve(entries_ * stride + 64);
    }
    return args;
  }

  Isa isa_;
  RasterCamera camera_;
  int64_t count_ = 0, visible_ = 0, entries_ = 0;
  int features_ = 0, threads_ = 1;
  bool projected_ = false;
  ProjectedGaussians gaussians_{};
  TileLists tiles_{};
  std::unique_ptr<RasterMemory> memory_;
};

}  // namespace rtgs
