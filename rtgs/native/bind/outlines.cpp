#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <optional>
#include <string>
#include <tuple>
#include <vector>

#include "bind/bindings.h"
#include "common/isa.h"
#include "common/threads.h"
#include "mesh/distance.h"
#include "mesh/outlines.h"

namespace rtgs {
namespace {

constexpr const char* kName = "outlines";

using Points = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Picture = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<const bool, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Counts = nb::ndarray<int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Lens = std::tuple<double, double, double, double>;  // fx, fy, cx, cy
using Behind = std::tuple<Picture, Picture, Mask>;        // bare, surface, hidden

constexpr int64_t kMostOfSide = 1 << 24;  // pixels: places are float32, which would round past the last one above it
constexpr int64_t kMostPixels = 1 << 30;  // their indices are int32

template <typename Array>
std::string shape_of(const Array& a) {
  std::string found;
  for (size_t k = 0; k < a.ndim(); ++k) found += (k ? ", " : "") + std::to_string(a.shape(k));
  return "(" + found + ")";
}

// An array that is not (rows, columns) is a ValueError: as many numbers in another shape are others.
template <typename Array>
void require_shape(const Array& a, const char* name, int64_t rows, int64_t columns) {
  if (a.ndim() == 2 && int64_t(a.shape(0)) == rows && int64_t(a.shape(1)) == columns) return;
  throw std::invalid_argument("outlines: " + std::string(name) + " is " + shape_of(a) + ", expected (" +
                              std::to_string(rows) + ", " + std::to_string(columns) + ")");
}

// Checks the sides of a picture, which are then height and width.
template <typename Array>
std::tuple<int64_t, int64_t> sides_of(const Array& picture) {
  const int64_t height = int64_t(picture.shape(0)), width = int64_t(picture.shape(1));
  if (height < 1 || width < 1 || height > kMostOfSide || width > kMostOfSide || height * width > kMostPixels)
    throw std::invalid_argument("outlines: a picture of " + shape_of(picture) +
                                "; sides of 1 to 2^24 pixels and 2^30 pixels in all are possible");
  return {height, width};
}

Pinhole pinhole_of(const Pose& rotation, const Pose& translation, const Lens& lens, int64_t height, int64_t width) {
  require(kName, rotation, "rotation", 9);
  require(kName, translation, "translation", 3);
  Pinhole camera{};
  for (int k = 0; k < 9; ++k) camera.rotation[k] = rotation.data()[k];
  for (int k = 0; k < 3; ++k) camera.translation[k] = translation.data()[k];
  std::tie(camera.fx, camera.fy, camera.cx, camera.cy) = lens;
  camera.width = width, camera.height = height;
  return camera;
}

// The outline of one view; keeps the pictures alive.
class NativeOutline {
 public:
  NativeOutline(Pose rotation, Pose translation, Lens lens, Picture whole, std::optional<Behind> behind)
      : whole_(whole), behind_(behind) {
    const auto [height, width] = sides_of(whole);
    view_.camera = pinhole_of(rotation, translation, lens, height, width);
    view_.focal = float(std::sqrt(view_.camera.fx * view_.camera.fy));
    view_.whole = whole_.data();
    if (!behind_) return;
    const auto& [bare, surface, hidden] = *behind_;
    require_shape(bare, "bare", height, width);
    require_shape(surface, "surface", height, width);
    require_shape(hidden, "hidden", height, width);
    view_.bare = bare.data(), view_.surface = surface.data(), view_.hidden = hidden.data();
  }
  const OutlineView& view() const { return view_; }

 private:
  Picture whole_;
  std::optional<Behind> behind_;
  OutlineView view_{};
};

// The mask and the depth of one view; keeps them alive.
class NativeDepth {
 public:
  NativeDepth(Pose rotation, Pose translation, Lens lens, Mask mask, Picture depth) : mask_(mask), depth_(depth) {
    const auto [height, width] = sides_of(depth);
    require_shape(mask, "mask", height, width);
    view_ = {pinhole_of(rotation, translation, lens, height, width), mask_.data(), depth_.data()};
  }
  const DepthView& view() const { return view_; }

 private:
  Mask mask_;
  Picture depth_;
  DepthView view_{};
};

SpacePoints checked_points(const Points& points, int threads) {
  if (points.ndim() != 2 || points.shape(1) != 3)
    throw std::invalid_argument("outlines: points is " + shape_of(points) + ", expected (N, 3)");
  return {int64_t(points.shape(0)), points.data(), checked_threads(threads)};
}

// The views of argument `name` side by side, as kernels take them.
template <typename Row, typename Native>
std::vector<Row> rows_of(const std::vector<const Native*>& views, const char* name) {
  if (views.empty()) throw std::invalid_argument("outlines: there are no views");
  std::vector<Row> rows;
  for (const Native* each : views) {
    if (!each) throw std::invalid_argument("outlines: " + std::string(name) + " holds None");
    rows.push_back(each->view());
  }
  return rows;
}

using Outlines = std::vector<const NativeOutline*>;

struct Views {
  Views(const Outlines& outlines, const Points& points, int threads)
      : rows(rows_of<OutlineView>(outlines, "outlines")) {
    in = {checked_points(points, threads), int64_t(rows.size()), rows.data()};
  }
  std::vector<OutlineView> rows;
  OutlinePoints in;
};

void distances_of(const Outlines& outlines, Points points, Floats distance, int threads) {
  const Views views(outlines, points, threads);
  require_shape(distance, "distance", views.in.views, views.in.in.count);
  float* out = distance.data();
  nb::gil_scoped_release release;
  RTGS_DISPATCH(outline_distances, views.in, out);
}

void outvoting_of(const Outlines& outlines, Points points, const std::vector<int64_t>& counts, int64_t min_seen,
                  int64_t min_heard, Floats distance, int threads) {
  const Views views(outlines, points, threads);
  require_shape(distance, "distance", int64_t(counts.size()), views.in.in.count);
  int64_t most = 0;
  for (const int64_t k : counts) {
    if (k < 0 || k >= views.in.views)
      throw std::invalid_argument("outlines: k is " + std::to_string(k) + " of " + std::to_string(views.in.views));
    most = k > most ? k : most;
  }
  const OutvotingNumbers numbers = {int64_t(counts.size()), most + 1, counts.data(), min_seen, min_heard};
  float* out = distance.data();
  nb::gil_scoped_release release;
  std::vector<float> scratch(size_t(views.in.in.threads) * size_t(numbers.ranks) * kOutlineBlock);
  RTGS_DISPATCH(outvoting, views.in, numbers, scratch.data(), out);
}

void votes_of(const Outlines& outlines, Points points, Floats inside, Floats seen, int threads) {
  const Views views(outlines, points, threads);
  require(kName, inside, "inside", views.in.in.count);
  require(kName, seen, "seen", views.in.in.count);
  float *in_mask = inside.data(), *in_picture = seen.data();
  nb::gil_scoped_release release;
  RTGS_DISPATCH(outline_votes, views.in, in_mask, in_picture);
}

void in_front_of(const std::vector<const NativeDepth*>& depths, Points points, double margin, Counts views,
                 int threads) {
  const std::vector<DepthView> rows = rows_of<DepthView>(depths, "depths");
  const DepthPoints in = {checked_points(points, threads), int64_t(rows.size()), rows.data(), margin};
  require(kName, views, "views", in.in.count);
  int64_t* out = views.data();
  nb::gil_scoped_release release;
  RTGS_DISPATCH(views_in_front, in, out);
}

void distance_of(Mask inside, Floats distance) {
  const auto [height, width] = sides_of(inside);
  const int64_t count = height * width;
  require_shape(distance, "distance", height, width);
  const bool* mask = inside.data();
  float* out = distance.data();
  nb::gil_scoped_release release;
  int64_t covered = 0;
  for (int64_t p = 0; p < count; ++p) covered += mask[p];
  if (covered == 0 || covered == count) throw std::invalid_argument("outlines: the mask has no outline");
  std::vector<int32_t> scratch(size_t(2 * count + 2 * width));
  outline_distance(height, width, mask, scratch.data(), out);
}

}  // namespace

void bind_outlines(nb::module_& m) {
  nb::class_<NativeOutline>(m, "Outline", "The mask of one view as distances; see rtgs/mesh/outlines.py.")
      .def(nb::init<Pose, Pose, Lens, Picture, std::optional<Behind>>(), nb::arg("rotation"), nb::arg("translation"),
           nb::arg("lens"), nb::arg("whole"), nb::arg("behind").none());
  m.def("outline_distance", &distance_of, nb::arg("inside"), nb::arg("distance"),
        "Fills (H, W) the distance of pixels to the outline of a mask, positive inside, on the calling thread.");
  m.def("outline_distances", &distances_of, nb::arg("outlines"), nb::arg("points").noconvert(), nb::arg("distance"),
        nb::arg("threads"), "Fills the distances (V, N) of points (N, 3) to the outlines of V views, world units.");
  m.def("outvoting", &outvoting_of, nb::arg("outlines"), nb::arg("points").noconvert(), nb::arg("counts"),
        nb::arg("min_seen"), nb::arg("min_heard"), nb::arg("distance"), nb::arg("threads"),
        "Fills, for every k of the counts, the distances (C, N) that all but k views allow.");
  m.def("outline_votes", &votes_of, nb::arg("outlines"), nb::arg("points").noconvert(), nb::arg("inside"),
        nb::arg("seen"), nb::arg("threads"),
        "Fills (N,) the share of the views that show a point in the mask, and how many have it in the picture.");
  nb::class_<NativeDepth>(m, "DepthView", "Mask and z-depth of one view; see rtgs/mesh/hull.py.")
      .def(nb::init<Pose, Pose, Lens, Mask, Picture>(), nb::arg("rotation"), nb::arg("translation"), nb::arg("lens"),
           nb::arg("mask"), nb::arg("depth"));
  m.def("views_in_front", &in_front_of, nb::arg("depths"), nb::arg("points").noconvert(), nb::arg("margin"),
        nb::arg("views").noconvert(), nb::arg("threads"),
        "Fills (N,) how many views show a point in the mask and not behind the depth plus the margin.");
}

}  // namespace rtgs
