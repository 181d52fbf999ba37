// Binding of the surfel rasteriser: owns the memory, calls the kernels of the active instruction set in their order.
// Shapes, dtypes and values are checked by rtgs/render/surfels.py.
#include "raster/session.h"
#include "raster/surfels.h"

namespace rtgs {
namespace {

class Rasterization : public RasterSession {
 public:
  Rasterization(const CameraValues& camera, bool normal, bool depth, bool absolute)
      : RasterSession(camera.values), normal_(normal), depth_(depth), absolute_(absolute) {}

  // Projection, sorting and binning.
  void project(Floats means, Floats tangent_u, Floats tangent_v, Floats scales, Floats opacities, Floats features,
               int threads) {
    nb::gil_scoped_release release;
    const GaussianArrays in = gaussian_arrays(means, tangent_u, tangent_v, scales, opacities, features);
    start(in, make_layout(in.channels), threads);
    RTGS_CALL(isa_, project_surfels, camera_, in, gaussians_, threads_);
    bin();
  }

  void forward(MaybeFloats background, Floats feature_image, MaybeFloats normal_image, Floats alpha, MaybeFloats depth,
               MaybeFloats median_depth, MaybeFloats distortion, MaybeFloats weight_sum) {
    nb::gil_scoped_release release;
    ForwardArgs args = pictures(feature_image, normal_image, depth, distortion);
    args.background = data_or_null(background);
    args.alpha = alpha.data();
    args.median_depth = data_or_null(median_depth);
    if (weight_sum) use_weight_sum(args);
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
    BackwardArgs args = backward_args(pictures(feature_image, normal_image, depth, distortion), grad_features,
                                      grad_normal, grad_alpha, &poisoned);
    args.grad_depth = data_or_null(grad_depth);
    args.grad_median = data_or_null(grad_median);
    args.grad_distortion = data_or_null(grad_distortion);
    RTGS_CALL(isa_, raster_backward, args, count_);

    const GaussianGradients out = {data_or_null(out_means),     data_or_null(out_tangent_u), data_or_null(out_tangent_v),
                                   data_or_null(out_scales),    data_or_null(out_opacities), data_or_null(out_features),
                                   data_or_null(out_probe)};
    const GaussianArrays in = gaussian_arrays(means, tangent_u, tangent_v, scales, opacities, features);
    RTGS_CALL(isa_, project_backward, {camera_, in, gaussians_, args.rows, out, !poisoned, threads_});
  }

 private:
  RecordLayout make_layout(int features) const {
    RecordLayout layout{};
    layout.channels = features + (normal_ ? 3 : 0);
    layout.padded_channels = RTGS_CALL(isa_, padded_channels, layout.channels);
    layout.normal = normal_;
    layout.depth = depth_;
    layout.absolute = absolute_;
    layout.record_stride = whole_lines(kChannels + layout.padded_channels + (depth_ ? kDepthFields : 0));
    layout.gradient_sums = kGradChannels + layout.padded_channels + (depth_ ? 2 : 0) + (absolute_ ? 2 : 0);
    layout.gradient_stride = whole_lines(layout.gradient_sums);
    return layout;
  }

  ForwardArgs pictures(const Floats& feature_image, const MaybeFloats& normal_image, const MaybeFloats& depth,
                       const MaybeFloats& distortion) {
    ForwardArgs args = forward_args(feature_image, normal_image, 4);
    args.depth = data_or_null(depth);
    args.distortion = data_or_null(distortion);
    const int64_t pixels = camera_.pixels();
    args.first_inverse = args.transmittance + pixels;
    args.moment1 = args.transmittance + 2 * pixels;
    args.moment2 = args.transmittance + 3 * pixels;
    if (depth_) args.median_entry = memory_->median_entries.reserve(pixels);
    return args;
  }

  bool normal_, depth_, absolute_;
};

}  // namespace

void bind_raster(nb::module_& m) {
  nb::class_<CameraValues>(m, "RasterCamera", "Pose (world to camera), intrinsics in pixels, and the cut rules.")
      .def(nb::init<Doubles, Doubles, double, double, double, double, int, int, double, double, double, double,
                    double>(),
           nb::arg("rotation"), nb::arg("translation"), nb::arg("fx"), nb::arg("fy"), nb::arg("cx"), nb::arg("cy"),
           nb::arg("width"), nb::arg("height"), nb::arg("near"), nb::arg("far"), nb::arg("min_alpha") = 1.0 / 255,
           nb::arg("min_transmittance") = 1e-4, nb::arg("low_pass") = 0.5);
  nb::class_<Rasterization>(m, "Rasterization", "One surfel rasterisation; see rtgs/render/surfels.py.")
      .def(nb::init<const CameraValues&, bool, bool, bool>(), nb::arg("camera"), nb::arg("normal"), nb::arg("depth"),
           nb::arg("absolute") = false)
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
      .def_prop_ro("entries", &RasterSession::entries, "(surfel, tile) pairs")
      .def_prop_ro("visible", &RasterSession::visible, "surfels whose bound meets the image");
  m.def("release_raster_memory", [] { RasterMemoryPool::instance().clear(); },
        "Give idle rasteriser memory back to the system.");
}

}  // namespace rtgs
