#include <nanobind/stl/optional.h>

#include <optional>
#include <vector>

#include "bind/bindings.h"
#include "image/traced_pixels.h"

namespace rtgs {
namespace {

using Indices = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<const bool, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Places = nb::ndarray<int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

constexpr const char* kName = "traced pixels";

template <typename Integer>
void check_range(const Integer* values, int64_t count, int64_t end, const char* name) {
  int64_t lowest = 0, highest = -1;
  for (int64_t k = 0; k < count; ++k) {
    lowest = values[k] < lowest ? values[k] : lowest;
    highest = values[k] > highest ? values[k] : highest;
  }
  if (lowest < 0 || highest >= end)
    throw std::invalid_argument(std::string(kName) + ": " + name + " holds " +
                                std::to_string(lowest < 0 ? lowest : highest) + ", which is not in 0.." +
                                std::to_string(end - 1));
}

// The order of an image's pixels, checked once.
class Order {
 public:
  Order(Indices index, Indices quad, Indices corner) : index_(index), quad_(quad), corner_(corner) {
    const int64_t count = int64_t(index.size());
    if (count > INT32_MAX) throw std::invalid_argument("traced pixels: more than 2^31 - 1 pixels");
    require(kName, quad, "quad", count);
    require(kName, corner, "corner", count);
    check_range(index.data(), count, count, "index");
    check_range(corner.data(), count, 4, "corner");
    for (int64_t k = 0; k < count; ++k) quads_ = quad.data()[k] + 1 > quads_ ? quad.data()[k] + 1 : quads_;
    check_range(quad.data(), count, quads_, "quad");
    if (quads_ > INT32_MAX) throw std::invalid_argument("traced pixels: more than 2^31 - 1 blocks");
  }

  int64_t choose(Flags surface, std::optional<Flags> kept, Rows index, Places place) const {
    const PixelOrder order = pixels();
    require(kName, surface, "surface", order.count);
    if (kept) require(kName, *kept, "kept", order.count);
    require(kName, index, "index", order.count);
    require(kName, place, "place", order.count);
    nb::gil_scoped_release release;
    return choose_pixels(order, surface.data(), kept ? kept->data() : nullptr, index.data(), place.data());
  }

  int64_t share(int64_t count, Rows index, Places place, Floats showing, float below, int turn, Rows own,
                Rows ray) const {
    const PixelOrder order = pixels();
    require(kName, index, "index", order.count);
    require(kName, place, "place", order.count);
    require(kName, showing, "showing", order.count);
    require(kName, own, "own", order.count);
    require(kName, ray, "ray", order.count);
    if (count < 0 || count > order.count) throw std::invalid_argument("traced pixels: more are chosen than there are");
    check_range(place.data(), count, order.count, "place");
    check_range(index.data(), count, order.count, "index");
    std::vector<int32_t> first(static_cast<size_t>(quads_));
    const SharingPixels in = {count, place.data(), index.data(), showing.data(), below, turn};
    nb::gil_scoped_release release;
    return share_rays(order, in, {own.data(), ray.data(), first.data()}, quads_);
  }

 private:
  PixelOrder pixels() const { return {int64_t(index_.size()), index_.data(), quad_.data(), corner_.data()}; }

  const Indices index_, quad_, corner_;
  int64_t quads_ = 0;
};

}  // namespace

void bind_traced_pixels(nb::module_& m) {
  nb::class_<Order>(m, "PixelOrder", "An order of an image's N pixels; see rtgs/methods/shading/traced_pixels.py.")
      .def(nb::init<Indices, Indices, Indices>(), nb::arg("index"), nb::arg("quad"), nb::arg("corner"))
      .def("choose", &Order::choose, nb::arg("surface"), nb::arg("kept").none(), nb::arg("index"), nb::arg("place"),
           "Fills index and place (N) with the pixels on the surface (N) that are kept; returns how many they are.")
      .def("share", &Order::share, nb::arg("count"), nb::arg("index"), nb::arg("place"), nb::arg("showing"),
           nb::arg("below"), nb::arg("turn"), nb::arg("own"), nb::arg("ray"),
           "Fills own and ray (N) for the first `count` chosen pixels; returns how many rays they have.");
}

}  // namespace rtgs
