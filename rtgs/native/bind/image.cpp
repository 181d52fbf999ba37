// Losses on images. Shapes, types and devices are checked in rtgs/train/losses.py.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <algorithm>
#include <optional>
#include <stdexcept>
#include <vector>

#include "bind/bindings.h"
#include "image/image.h"
#include "image/sensor.h"
#include "common/isa.h"
#include "common/threads.h"

namespace rtgs {
namespace {

// Working memory, kept from call to call by each calling thread: fresh pages would cost as much as the kernel.
float* scratch(long floats) {
  static thread_local std::vector<float> memory;
  if (long(memory.size()) < floats) memory.resize(floats);
  return memory.data();
}

double total(const std::vector<double>& rows) {  // in a fixed order, whatever the number of threads
  double sum = 0;
  for (double row : rows) sum += row;
  return sum;
}

float* pointer(std::optional<Floats>& array) { return array ? array->data() : nullptr; }

ViewArguments view_of(const Floats& picture, const Floats& rotation, const float* intrinsics) {
  ViewArguments view{};
  view.height = int(picture.shape(1));
  view.width = int(picture.shape(2));
  for (int i = 0; i < 9; ++i) view.rotation[i] = rotation.data()[i];
  if (const float* k = intrinsics) view.focal_x = k[0], view.focal_y = k[1], view.center_x = k[2], view.center_y = k[3];
  return view;
}

std::pair<double, double> photometric_loss(Floats image, Floats target, float l1, float dssim, bool with_dssim,
                                           std::optional<Floats> gradient, std::optional<Floats> dissimilarity,
                                           int threads) {
  PhotometricArguments a{};
  a.image = image.data();
  a.target = target.data();
  a.channels = int(image.shape(0)), a.height = int(image.shape(1)), a.width = int(image.shape(2));
  double count = double(image.size());
  a.l1_scale = float(l1 / count), a.dssim_scale = float(dssim / count);
  a.gradient = pointer(gradient);
  a.dissimilarity = pointer(dissimilarity);
  a.threads = checked_threads(threads);
  nb::gil_scoped_release release;
  std::vector<double> l1_rows(size_t(a.channels) * a.height), dssim_rows(with_dssim ? l1_rows.size() : 0);
  a.l1_rows = l1_rows.data();
  if (with_dssim) {
    a.dssim_rows = dssim_rows.data();
    a.scratch = scratch(photometric_scratch(a.width) * a.threads);
  }
  RTGS_DISPATCH(photometric, a);
  return {total(l1_rows) / count, total(dssim_rows) / count};
}

double normal_consistency_loss(Floats normal, Floats depth, Floats alpha, bool depth_is_surface, Floats rotation,
                               Floats intrinsics, float near_depth, float inverse_depth_range,
                               std::optional<Floats> gradient_normal, std::optional<Floats> gradient_depth,
                               std::optional<Floats> gradient_alpha, int threads) {
  NormalArguments a{};
  a.view = view_of(normal, rotation, intrinsics.data());
  a.normal = normal.data();
  a.depth = depth.data();
  a.alpha = alpha.data();
  a.depth_is_surface = depth_is_surface;
  a.near_depth = near_depth, a.inverse_depth_range = inverse_depth_range;
  double count = double(depth.size());
  a.scale = float(1 / count);
  a.gradient_normal = pointer(gradient_normal);
  a.gradient_depth = pointer(gradient_depth);
  a.gradient_alpha = pointer(gradient_alpha);
  a.threads = checked_threads(threads);
  nb::gil_scoped_release release;
  std::vector<double> rows(a.view.height);
  a.rows = rows.data();
  a.scratch = scratch(normal_scratch(a.view.width) * a.threads);
  RTGS_DISPATCH(normal_consistency, a);
  return total(rows) / count;
}

double mono_normal_loss(Floats normal, Floats mono, std::optional<Floats> weight, Floats rotation, float l1,
                        std::optional<Floats> gradient_normal, int threads) {
  MonoNormalArguments a{};
  a.view = view_of(normal, rotation, nullptr);
  a.normal = normal.data();
  a.mono = mono.data();
  a.weight = pointer(weight);
  a.l1 = l1;
  double count = double(a.view.height) * a.view.width;
  a.scale = float(1 / count);
  a.gradient_normal = pointer(gradient_normal);
  a.threads = checked_threads(threads);
  nb::gil_scoped_release release;
  std::vector<double> rows(a.view.height);
  a.rows = rows.data();
  RTGS_DISPATCH(mono_normal, a);
  return total(rows) / count;
}

// Nearest-rank 1st and 99th percentile of the positive surface depths on every `step`-th pixel of every `step`-th row.
std::pair<float, float> depth_percentiles(Floats depth, std::optional<Floats> alpha, float least_alpha, int step) {
  if (step < 1) throw std::invalid_argument("depth_percentiles: step=" + std::to_string(step) + " must be at least 1");
  nb::gil_scoped_release release;
  long height = long(depth.shape(0)), width = long(depth.shape(1));
  std::vector<float> values;
  values.reserve(size_t((height / step + 1) * (width / step + 1)));
  for (long y = 0; y < height; y += step)
    for (long i = y * width; i < (y + 1) * width; i += step) {
      float value = depth.data()[i];
      if (alpha) value = alpha->data()[i] > least_alpha ? value / alpha->data()[i] : 0.f;
      if (value > 0) values.push_back(value);
    }
  if (values.empty()) return {0.f, 0.f};
  long last = long(values.size()) - 1, low = long(0.01 * last + 0.5), high = long(0.99 * last + 0.5);
  std::nth_element(values.begin(), values.begin() + low, values.end());
  float near = values[low];
  std::nth_element(values.begin() + low, values.begin() + high, values.end());
  return {near, values[high]};
}

SensorPicture sensor_of(const Floats& image, const Floats& photo, float brightest, const Floats& out, int threads) {
  const int64_t count = int64_t(image.size());
  require("sensor", photo, "photo", count);
  require("sensor", out, "what comes out", count);
  return {count, image.data(), photo.data(), brightest, checked_threads(threads)};
}

}  // namespace

void bind_image(nb::module_& m) {
  using nb::arg;
  m.def("cut_light", [](Floats image, Floats photo, float brightest, Floats cut, int threads) {
    const SensorPicture in = sensor_of(image, photo, brightest, cut, threads);
    nb::gil_scoped_release release;
    cut_light(in, cut.data());
  }, arg("image"), arg("photo"), arg("brightest"), arg("cut"), arg("threads"),
     "Fills cut with the image, no brighter than 1 where the photo is at least so bright; see rtgs/train/terms.py.");
  m.def("cut_light_backward", [](Floats image, Floats photo, float brightest, Floats upstream, Floats gradient,
                                 int threads) {
    const SensorPicture in = sensor_of(image, photo, brightest, gradient, threads);
    require("sensor", upstream, "upstream", in.count);
    nb::gil_scoped_release release;
    cut_light_backward(in, upstream.data(), gradient.data());
  }, arg("image"), arg("photo"), arg("brightest"), arg("upstream"), arg("gradient"), arg("threads"),
     "Fills the gradient by the image; there is none by what is cut off.");
  m.def("photometric_loss", &photometric_loss, arg("image"), arg("target"), arg("l1"), arg("dssim"), arg("with_dssim"),
        arg("gradient").none(), arg("dissimilarity").none(), arg("threads"),
        "Mean |image - target|, mean 1 - SSIM (0 unless wanted); fills the gradient of l1 * first + dssim * second.");
  m.def("normal_consistency_loss", &normal_consistency_loss, arg("normal"), arg("depth"), arg("alpha"),
        arg("depth_is_surface"), arg("rotation"), arg("intrinsics"), arg("near_depth"), arg("inverse_depth_range"),
        arg("gradient_normal").none(), arg("gradient_depth").none(), arg("gradient_alpha").none(), arg("threads"),
        "Mean of weight (1 - alpha normal . depth normal); intrinsics = fx, fy, cx, cy; fills the gradients.");
  m.def("depth_percentiles", &depth_percentiles, arg("depth"), arg("alpha").none(), arg("least_alpha"), arg("step"),
        "1st and 99th percentile of the positive depth / alpha (depth itself without alpha) over a grid of pixels.");
  m.def("mono_normal_loss", &mono_normal_loss, arg("normal"), arg("mono"), arg("weight").none(), arg("rotation"),
        arg("l1"), arg("gradient_normal").none(), arg("threads"),
        "Mean of weight (1 - n . mono + l1 |n - mono|_1), n the normal turned to the camera frame and normalised.");
}

}  // namespace rtgs
