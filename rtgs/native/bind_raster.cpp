// Binding of the surfel rasteriser: owns the memory, calls the kernels of the active instruction set in their order.
// Shapes, dtypes and values are checked by rtgs/render/rasterize.py.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/unique_ptr.h>

#include <optional>

#include "bindings.h"
#include "isa.h"
#include "raster_state.h"

namespace rtgs {
namespace {

using MaybeFloats = std::optional<Floats>;
using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;

float* data_or_null(const MaybeFloats& array) { return array ? array->data() : nullptr; }
int whole_lines(int floats) { return (floats + 15) / 16 * 16; }

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
               double near, double far) {
    for (int k = 0; k < 9; ++k) values.rotation[k] = float(rotation.data()[k]);
    for (int k = 0; k < 3; ++k) values.translation[k] = float(translation.data()[k]);
    values.fx = float(fx), values.fy = float(fy), values.cx = float(cx), values.cy = float(cy);
    values.width = width, values.height = height;
    values.near = float(near), values.far = float(far);
  }
};

SurfelArrays surfel_arrays(const Floats& means, const Floats& tangent_u, const Floats& tangent_v, const Floats& scales,
                           const Floats& opacities, const Floats& features) {
  return {int64_t(means.shape(0)), int(features.shape(1)), means.data(), tangent_u.data(),
          tangent_v.data(), scales.data(), opacities.data(), features.data()};
}

// One rasterisation: made by the forward pass, kept alive by autograd until the backward pass is done.
class Rasterization {
 public:
  Rasterization(const CameraValues& camera, bool normal, bool depth)
      : isa_(active_isa()), camera_(camera.values), normal_(normal), depth_(depth),
        memory_(RasterMemoryPool::instance().take()) {}
  ~Rasterization() { RasterMemoryPool::instance().give(std::move(memory_)); }

  // Projection, sorting and binning.
  void project(Floats means, Floats tangent_u, Floats tangent_v, Floats scales, Floats opacities, Floats features,
               int threads) {
    nb::gil_scoped_release release;
    const SurfelArrays in = surfel_arrays(means, tangent_u, tangent_v, scales, opacities, features);
    RasterMemory& m = *memory_;
    count_ = in.count;
    threads_ = threads;
    features_ = in.channels;
    surfels_.layout = make_layout();
    surfels_.records = m.records.reserve(count_ * surfels_.layout.record_stride + 64);
    surfels_.rects = m.rects.reserve(count_ + 1);
    surfels_.depths = m.depths.reserve(count_ + 1);
    RTGS_CALL(isa_, project_surfels, camera_, in, surfels_, threads);

    const int64_t tiles = int64_t(camera_.tiles_x()) * camera_.tiles_y();
    const int64_t sort_scratch = RTGS_CALL(isa_, sort_scratch);
    int64_t* scratch = m.scratch.reserve(sort_scratch > tiles * threads ? sort_scratch : tiles * threads);
    DepthKey* keys = m.keys.reserve(count_ + 1);
    visible_ = RTGS_CALL(isa_, sort_by_depth, surfels_, count_, keys, m.spare_keys.reserve(count_ + 1), scratch, threads);
    tiles_.starts = m.starts.reserve(tiles + 1);
    tiles_.used = m.used.reserve(tiles);
    tiles_.work = m.work.reserve(tiles);
    entries_ = RTGS_CALL(isa_, count_tiles, camera_, surfels_, keys, visible_, scratch, tiles_.starts, threads);
    tiles_.ids = m.ids.reserve(entries_ + 1);
    tiles_.masks = m.masks.reserve(entries_ + 1);
    RTGS_CALL(isa_, fill_tiles, camera_, surfels_, keys, visible_, scratch, tiles_.ids, threads);
  }

  void forward(MaybeFloats background, Floats feature_image, MaybeFloats normal_image, Floats alpha, MaybeFloats depth,
               MaybeFloats median_depth, MaybeFloats distortion, MaybeFloats weight_sum) {
    nb::gil_scoped_release release;
    ForwardArgs args = forward_args(feature_image, normal_image, depth, distortion);
    args.background = data_or_null(background);
    args.alpha = alpha.data();
    args.median_depth = data_or_null(median_depth);
    if (weight_sum) args.entry_weights = memory_->entry_weights.reserve(entries_ + 1);
    RTGS_CALL(isa_, raster_forward, args);
    if (weight_sum) RTGS_CALL(isa_, sum_entry_weights, args, count_, weight_sum->data());
  }

  // Raster gradients into the memory, then the chain rule of the projection into the given arrays.
  void backward(Floats means, Floats tangent_u, Floats tangent_v, Floats scales, Floats opacities, Floats features,
                Floats feature_image, MaybeFloats normal_image, MaybeFloats depth, MaybeFloats distortion,
                MaybeFloats grad_features, MaybeFloats grad_normal, MaybeFloats grad_alpha, MaybeFloats grad_depth,
                MaybeFloats grad_median, MaybeFloats grad_distortion, MaybeFloats out_means, MaybeFloats out_tangent_u,
                MaybeFloats out_tangent_v, MaybeFloats out_scales, MaybeFloats out_opacities, MaybeFloats out_features,
                MaybeFloats out_probe) {
    nb::gil_scoped_release release;
    int poisoned = 0;
    BackwardArgs args{};
    args.poisoned = &poisoned;
    args.forward = forward_args(feature_image, normal_image, depth, distortion);
    args.grad_features = data_or_null(grad_features);
    args.grad_normal = data_or_null(grad_normal);
    args.grad_alpha = data_or_null(grad_alpha);
    args.grad_depth = data_or_null(grad_depth);
    args.grad_median = data_or_null(grad_median);
    args.grad_distortion = data_or_null(grad_distortion);
    const int64_t stride = surfels_.layout.gradient_stride;
    args.rows = memory_->rows.reserve(count_ * stride + 64, true);
    args.range_starts = memory_->ranges.reserve(2 * threads_ + 1);
    args.waiting_counts = args.range_starts + threads_ + 1;
    if (threads_ > 1) {  // sized for the worst case; little of it is ever touched
      args.waiting_ids = memory_->waiting_ids.reserve(entries_ + 1);
      args.waiting_rows = memory_->waiting_rows.reserve(entries_ * stride + 64);
    }
    RTGS_CALL(isa_, raster_backward, args, count_);

    const SurfelGradients out = {data_or_null(out_means),     data_or_null(out_tangent_u), data_or_null(out_tangent_v),
                                 data_or_null(out_scales),    data_or_null(out_opacities), data_or_null(out_features),
                                 data_or_null(out_probe)};
    const SurfelArrays in = surfel_arrays(means, tangent_u, tangent_v, scales, opacities, features);
    RTGS_CALL(isa_, project_backward, {camera_, in, surfels_, args.rows, out, !poisoned, threads_});
  }

  int64_t entries() const { return entries_; }
  int64_t visible() const { return visible_; }

 private:
  RecordLayout make_layout() const {
    RecordLayout layout{};
    layout.channels = features_ + (normal_ ? 3 : 0);
    layout.padded_channels = RTGS_CALL(isa_, padded_channels, layout.channels);
    layout.normal = normal_;
    layout.depth = depth_;
    layout.record_stride = whole_lines(kChannels + layout.padded_channels + (depth_ ? kDepthFields : 0));
    layout.gradient_stride = whole_lines(layout.gradient_sums());
    return layout;
  }

  ForwardArgs forward_args(const Floats& feature_image, const MaybeFloats& normal_image, const MaybeFloats& depth,
                           const MaybeFloats& distortion) {
    ForwardArgs args{};
    args.camera = camera_;
    args.surfels = surfels_;
    args.tiles = tiles_;
    args.features = features_;
    args.feature_image = feature_image.data();
    args.normal_image = data_or_null(normal_image);
    args.depth = data_or_null(depth);
    args.distortion = data_or_null(distortion);
    const int64_t pixels = camera_.pixels();
    args.transmittance = memory_->images.reserve(4 * pixels);
    args.first_inverse = args.transmittance + pixels;
    args.moment1 = args.transmittance + 2 * pixels;
    args.moment2 = args.transmittance + 3 * pixels;
    if (depth_) args.median_entry = memory_->median_entries.reserve(pixels);
    args.threads = threads_;
    return args;
  }

  Isa isa_;
  RasterCamera camera_;
  bool normal_, depth_;
  int64_t count_ = 0, visible_ = 0, entries_ = 0;
  int features_ = 0, threads_ = 1;
  ProjectedSurfels surfels_{};
  TileLists tiles_{};
  std::unique_ptr<RasterMemory> memory_;
};

}  // namespace

void bind_raster(nb::module_& m) {
  nb::class_<CameraValues>(m, "RasterCamera", "Pose (world to camera), intrinsics in pixels, near and far.")
      .def(nb::init<Doubles, Doubles, double, double, double, double, int, int, double, double>());
  nb::class_<Rasterization>(m, "Rasterization", "One surfel rasterisation; see rtgs/render/rasterize.py.")
      .def(nb::init<const CameraValues&, bool, bool>(), nb::arg("camera"), nb::arg("normal"), nb::arg("depth"))
      .def("project", &Rasterization::project)
      .def("forward", &Rasterization::forward, nb::arg("background").none(), nb::arg("feature_image"),
           nb::arg("normal_image").none(), nb::arg("alpha"), nb::arg("depth").none(), nb::arg("median_depth").none(),
           nb::arg("distortion").none(), nb::arg("weight_sum").none())
      .def("backward", &Rasterization::backward, nb::arg("means"), nb::arg("tangent_u"), nb::arg("tangent_v"),
           nb::arg("scales"), nb::arg("opacities"), nb::arg("features"), nb::arg("feature_image"),
           nb::arg("normal_image").none(), nb::arg("depth").none(), nb::arg("distortion").none(),
           nb::arg("grad_features").none(), nb::arg("grad_normal").none(), nb::arg("grad_alpha").none(),
           nb::arg("grad_depth").none(), nb::arg("grad_median").none(), nb::arg("grad_distortion").none(),
           nb::arg("out_means").none(), nb::arg("out_tangent_u").none(), nb::arg("out_tangent_v").none(),
           nb::arg("out_scales").none(), nb::arg("out_opacities").none(), nb::arg("out_features").none(),
           nb::arg("out_probe").none())
      .def_prop_ro("entries", &Rasterization::entries, "(surfel, tile) pairs")
      .def_prop_ro("visible", &Rasterization::visible, "surfels whose bound meets the image");
  m.def("release_raster_memory", [] { RasterMemoryPool::instance().clear(); },
        "Give idle rasteriser memory back to the system.");
}

}  // namespace rtgs
