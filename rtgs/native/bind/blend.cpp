#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <vector>

#include "bind/bindings.h"
#include "common/isa.h"
#include "common/threads.h"
#include "image/blend.h"

namespace rtgs {
namespace {

using Index = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using MaybeFloats = std::optional<Floats>;

TracedIndex traced_index(const Index& index, int64_t pixels, int threads) {
  const int64_t count = int64_t(index.size());
  int64_t lowest = 0, highest = -1;
  for (int64_t row = 0; row < count; ++row) {
    const int64_t pixel = index.data()[row];
    lowest = pixel < lowest ? pixel : lowest;
    highest = pixel > highest ? pixel : highest;
  }
  if (lowest < 0 || highest >= pixels)
    throw std::invalid_argument("blend: the index names pixel " + std::to_string(lowest < 0 ? lowest : highest) +
                                " of a picture of " + std::to_string(pixels));
  if (pixels > INT32_MAX) throw std::invalid_argument("blend: more than 2^31 - 1 pixels");
  return {pixels, count, index.data(), checked_threads(threads)};
}

using Planes = std::vector<Floats>;

// The planes of some arrays, of `size` numbers each.
class PlaneList {
 public:
  PlaneList(const Planes& maps, const Planes& rows, const TracedIndex& at) {
    if (maps.size() != rows.size()) throw std::invalid_argument("planes: as many maps as rows");
    for (size_t k = 0; k < maps.size(); ++k) {
      const int64_t planes = at.pixels ? int64_t(maps[k].size()) / at.pixels : 0;
      append(maps_, maps[k], planes, at.pixels, "a map");
      append(rows_, rows[k], planes, at.count, "its rows");
    }
  }
  PixelPlanes planes() const { return {int(maps_.size()), maps_.data(), rows_.data()}; }

 private:
  static void append(std::vector<float*>& to, const Floats& array, int64_t planes, int64_t size, const char* name) {
    require("planes", array, name, planes * size);
    for (int64_t k = 0; k < planes; ++k) to.push_back(array.data() + k * size);
  }
  std::vector<float*> maps_, rows_;
};

float* data_of(const MaybeFloats& array, const char* name, int64_t size) {
  if (!array) return nullptr;
  require("blend", *array, name, size);
  return array->data();
}

using Arrays = std::vector<MaybeFloats>;

BlendedPixels blended_pixels(const TracedIndex& at, const MaybeFloats& diffuse, const MaybeFloats& specular,
                             const Arrays& weights, const Arrays& colors) {
  if (weights.size() != colors.size() || weights.size() > size_t(kMostLights))
    throw std::invalid_argument("blend: as many weights as colours, at most " + std::to_string(kMostLights));
  BlendedPixels found = {data_of(diffuse, "diffuse", 3 * at.pixels), data_of(specular, "specular", at.count), {}};
  for (size_t k = 0; k < weights.size(); ++k) {
    const int planes = weights[k] && int64_t(weights[k]->size()) == 3 * at.count && at.count > 0 ? 3 : 1;
    found.lights[k] = {data_of(weights[k], "weight", planes * at.count), planes,
                       data_of(colors[k], "color", 3 * at.count)};
  }
  return found;
}

BlendedPixels given_pixels(const TracedIndex& at, const Floats& diffuse, const Floats& specular,
                           const Planes& weights, const Planes& colors) {
  return blended_pixels(at, diffuse, specular, Arrays(weights.begin(), weights.end()),
                        Arrays(colors.begin(), colors.end()));
}

using Doubles = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

void take_rays_of(Index index, Doubles across, Doubles along, bool rows, Floats directions, int threads) {
  if (across.shape(1) != 3 || along.shape(1) != 3) throw std::invalid_argument("rays: tables have three columns");
  const int64_t width = int64_t(across.shape(0));
  const TracedIndex at = traced_index(index, width * int64_t(along.shape(0)), threads);
  require("rays", directions, "directions", 3 * at.count);
  nb::gil_scoped_release release;
  take_rays(at, {width, across.data(), along.data()}, rows, directions.data());
}

ShownRays shown_rays(const Index& ray, const Floats& colors, const Floats& planes) {
  const TracedIndex at = traced_index(ray, int64_t(colors.size()) / 3, 1);  // checked
  require("shared rays", colors, "colors", 3 * at.pixels);
  require("shared rays", planes, "planes", 3 * at.count);
  return {at.count, at.pixels, at.index};
}

}  // namespace

void bind_blend(nb::module_& m) {
  m.def("take_rays", &take_rays_of, nb::arg("index"), nb::arg("across"), nb::arg("along"), nb::arg("rows"),
        nb::arg("directions"), nb::arg("threads"),
        "Fills directions, (P, 3) if rows and (3, P) else, of the rays through the pixels of the index (P).");
  m.def("show_rays", [](Index ray, Floats colors, Floats planes, int threads) {
    const ShownRays shown = shown_rays(ray, colors, planes);
    const int checked = checked_threads(threads);
    nb::gil_scoped_release release;
    show_rays(shown, colors.data(), planes.data(), checked);
  }, nb::arg("ray"), nb::arg("colors"), nb::arg("planes"), nb::arg("threads"),
     "Fills planes (3, P) with the colours (R, 3) of the rays (P) that pixels show.");
  m.def("show_rays_backward", [](Index ray, Floats planes, Floats colors) {
    const ShownRays shown = shown_rays(ray, colors, planes);
    nb::gil_scoped_release release;
    show_rays_backward(shown, planes.data(), colors.data());
  }, nb::arg("ray"), nb::arg("planes"), nb::arg("colors"), "Fills the gradient (R, 3) by the colours.");
  m.def("take_planes", [](Index index, int64_t pixels, Planes maps, Planes rows, int threads) {
    const TracedIndex at = traced_index(index, pixels, threads);
    const PlaneList list(maps, rows, at);
    nb::gil_scoped_release release;
    take_planes(at, list.planes());
  }, nb::arg("index"), nb::arg("pixels"), nb::arg("maps"), nb::arg("rows"), nb::arg("threads"),
     "Fills rows (C, P) with what each of the maps (C, N) holds at the index (P).");
  m.def("put_planes", [](Index index, int64_t pixels, Planes rows, Planes maps, int threads) {
    const TracedIndex at = traced_index(index, pixels, threads);
    const PlaneList list(maps, rows, at);
    nb::gil_scoped_release release;
    put_planes(at, list.planes());
  }, nb::arg("index"), nb::arg("pixels"), nb::arg("rows"), nb::arg("maps"), nb::arg("threads"),
     "Fills maps (C, N) with rows (C, P) at the index (P), none twice, and with 0 elsewhere.");
  m.def("blend_lights", [](Index index, Floats diffuse, Floats specular, Planes weights, Planes colors,
                           MaybeFloats emphasis, bool linear, bool additive, Floats image, int threads) {
    const TracedIndex at = traced_index(index, int64_t(diffuse.size()) / 3, threads);
    const BlendedPixels in = given_pixels(at, diffuse, specular, weights, colors);
    const BlendRules rules = {int(weights.size()), linear, additive, data_of(emphasis, "emphasis", at.count)};
    float* out = data_of(image, "image", 3 * at.pixels);
    nb::gil_scoped_release release;
    RTGS_DISPATCH(blend_lights, at, rules, in, out);
  }, nb::arg("index"), nb::arg("diffuse"), nb::arg("specular"), nb::arg("weights"), nb::arg("colors"),
     nb::arg("emphasis").none(), nb::arg("linear"), nb::arg("additive"), nb::arg("image"), nb::arg("threads"),
     "Fills the image (3, N) of C_d and the lights of P traced pixels; see rtgs/methods/shading/blend.py.");
  m.def("blend_lights_backward", [](Index index, Floats diffuse, Floats specular, Planes weights, Planes colors,
                                    MaybeFloats emphasis, bool linear, bool additive, Floats upstream,
                                    MaybeFloats to_diffuse, MaybeFloats to_specular, Arrays to_weights,
                                    Arrays to_colors, int threads) {
    const TracedIndex at = traced_index(index, int64_t(diffuse.size()) / 3, threads);
    const BlendedPixels in = given_pixels(at, diffuse, specular, weights, colors);
    BlendedPixels out = blended_pixels(at, to_diffuse, to_specular, to_weights, to_colors);
    if (to_weights.size() != weights.size()) throw std::invalid_argument("blend: as many gradients as lights");
    for (size_t k = 0; k < weights.size(); ++k)
      if (out.lights[k].weight && out.lights[k].weight_planes != in.lights[k].weight_planes)
        throw std::invalid_argument("blend: the gradient of a weight has its shape");
    const BlendRules rules = {int(weights.size()), linear, additive, data_of(emphasis, "emphasis", at.count)};
    const float* from = data_of(upstream, "upstream", 3 * at.pixels);
    nb::gil_scoped_release release;
    RTGS_DISPATCH(blend_lights_backward, at, rules, in, from, out);
  }, nb::arg("index"), nb::arg("diffuse"), nb::arg("specular"), nb::arg("weights"), nb::arg("colors"),
     nb::arg("emphasis").none(), nb::arg("linear"), nb::arg("additive"), nb::arg("upstream"),
     nb::arg("to_diffuse").none(), nb::arg("to_specular").none(), nb::arg("to_weights"), nb::arg("to_colors"),
     nb::arg("threads"), "Fills the gradients by all but emphasis and index; None: not wanted.");
}

}  // namespace rtgs
