// Binding of the ellipsoid rasteriser: owns the memory, calls the kernels of the active instruction set in their order.
// Shapes, dtypes and values are checked by rtgs/render/ellipsoids.py.
#include "raster/ellipsoids.h"
#include "raster/session.h"

namespace rtgs {
namespace {

class EllipsoidRasterization : public RasterSession {
 public:
  EllipsoidRasterization(const CameraValues& camera, double dilation, double radius_sigmas, bool antialiased, bool depth,
                         bool absolute)
      : RasterSession(camera.values), depth_(depth), absolute_(absolute) {
    const double radius = radius_sigmas < 1e3 ? radius_sigmas : 1e3;  // the alpha cut bites long before
    settings_ = {float(dilation), float(radius * radius), antialiased};
  }

  // Projection, sorting and binning.
  void project(Floats means, Floats tangent_u, Floats tangent_v, Floats scales, Floats opacities, Floats features,
               int threads) {
    nb::gil_scoped_release release;
    const GaussianArrays in = gaussian_arrays(means, tangent_u, tangent_v, scales, opacities, features);
    start(in, make_layout(in.channels), threads);
    RTGS_CALL(isa_, project_ellipsoids, camera_, settings_, in, gaussians_, threads_);
    bin();
  }

  void forward(MaybeFloats background, Floats feature_image, Floats alpha, MaybeFloats depth, MaybeFloats weight_sum) {
    nb::gil_scoped_release release;
    ForwardArgs args = pictures(feature_image, depth);
    args.background = data_or_null(background);
    args.alpha = alpha.data();
    if (weight_sum) use_weight_sum(args);
    RTGS_CALL(isa_, ellipsoid_forward, args);
    if (weight_sum) RTGS_CALL(isa_, sum_entry_weights, args, count_, weight_sum->data());
  }

  // Raster gradients into the memory, then the chain rule of the projection into the given arrays.
  void backward(Floats means, Floats tangent_u, Floats tangent_v, Floats scales, Floats opacities, Floats features,
                Floats feature_image, MaybeFloats depth, MaybeFloats grad_features, MaybeFloats grad_alpha,
                MaybeFloats grad_depth, MaybeFloats out_means, MaybeFloats out_tangent_u, MaybeFloats out_tangent_v,
                MaybeFloats out_scales, MaybeFloats out_opacities, MaybeFloats out_features, MaybeFloats out_probe) {
    nb::gil_scoped_release release;
    int poisoned = 0;
    const BackwardArgs args =
        backward_args(pictures(feature_image, depth), grad_features, grad_depth, grad_alpha, &poisoned);
    RTGS_CALL(isa_, ellipsoid_backward, args, count_);

    const GaussianGradients out = {data_or_null(out_means),     data_or_null(out_tangent_u), data_or_null(out_tangent_v),
                                   data_or_null(out_scales),    data_or_null(out_opacities), data_or_null(out_features),
                                   data_or_null(out_probe)};
    const GaussianArrays in = gaussian_arrays(means, tangent_u, tangent_v, scales, opacities, features);
    const ProjectBackwardArgs rest = {camera_, in, gaussians_, args.rows, out, !poisoned, threads_};
    RTGS_CALL(isa_, project_ellipsoids_backward, rest, settings_);
  }

 private:
  RecordLayout make_layout(int features) const {
    RecordLayout layout{};
    layout.channels = features + (depth_ ? 1 : 0);
    layout.padded_channels = RTGS_CALL(isa_, padded_channels, layout.channels);
    layout.depth = depth_;
    layout.absolute = absolute_;
    layout.record_stride = whole_lines(EllipsoidRecord::kChannels + layout.padded_channels);
    layout.gradient_sums = EllipsoidSums::kChannels + layout.padded_channels + (absolute_ ? 2 : 0);
    layout.gradient_stride = whole_lines(layout.gradient_sums);
    return layout;
  }

  ForwardArgs pictures(const Floats& feature_image, const MaybeFloats& depth) {
    ForwardArgs args = forward_args(feature_image, depth, 1);
    args.largest_fall = kHalfLog2E * settings_.largest_radius;
    return args;
  }

  EllipsoidSettings settings_;
  bool depth_, absolute_;
};

}  // namespace

void bind_ellipsoids(nb::module_& m) {
  nb::class_<EllipsoidRasterization>(m, "EllipsoidRasterization",
                                     "One ellipsoid rasterisation; see rtgs/render/ellipsoids.py.")
      .def(nb::init<const CameraValues&, double, double, bool, bool, bool>(), nb::arg("camera"), nb::arg("dilation"),
           nb::arg("radius_sigmas"), nb::arg("antialiased"), nb::arg("depth"), nb::arg("absolute") = false)
      .def("project", &EllipsoidRasterization::project)
      .def("forward", &EllipsoidRasterization::forward, nb::arg("background").none(), nb::arg("feature_image"),
           nb::arg("alpha"), nb::arg("depth").none(), nb::arg("weight_sum").none())
      .def("backward", &EllipsoidRasterization::backward, nb::arg("means"), nb::arg("tangent_u"), nb::arg("tangent_v"),
           nb::arg("scales"), nb::arg("opacities"), nb::arg("features"), nb::arg("feature_image"),
           nb::arg("depth").none(), nb::arg("grad_features").none(), nb::arg("grad_alpha").none(),
           nb::arg("grad_depth").none(), nb::arg("out_means").none(), nb::arg("out_tangent_u").none(),
           nb::arg("out_tangent_v").none(), nb::arg("out_scales").none(), nb::arg("out_opacities").none(),
           nb::arg("out_features").none(), nb::arg("out_probe").none())
      .def_prop_ro("entries", &RasterSession::entries, "(ellipsoid, tile) pairs")
      .def_prop_ro("visible", &RasterSession::visible, "ellipsoids whose bound meets the image");
}

}  // namespace rtgs
