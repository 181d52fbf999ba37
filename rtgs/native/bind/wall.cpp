#include <vector>

#include "bind/bindings.h"
#include "common/isa.h"
#include "common/threads.h"
#include "image/wall.h"

namespace rtgs {
namespace {

const char* const kWall = "wall";

// `Sums` partial sums of each block of `count` rows, and in the end their totals.
struct Blocks {
  Blocks(int64_t count, int sums) : sums(sums), parts(size_t((count + kWallBlock - 1) / kWallBlock * sums)) {}
  void total(float* out) const {
    for (int k = 0; k < sums; ++k) {
      double total = 0;
      for (size_t part = size_t(k); part < parts.size(); part += size_t(sums)) total += parts[part];
      out[k] = float(total);
    }
  }
  int sums;
  std::vector<float> parts;
};

}  // namespace

void bind_wall(nb::module_& m) {
  m.def("wall_reflectance", [](Floats cosine, float index, Floats reflected, int threads) {
    const WallAngles in = {int64_t(cosine.size()), cosine.data(), index, checked_threads(threads)};
    require(kWall, reflected, "reflected", in.count);
    float* out = reflected.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(wall_reflectance, in, out);
  }, nb::arg("cosine"), nb::arg("index"), nb::arg("reflected"), nb::arg("threads"),
     "Fills what thin walls of glass reflect at these angles; see rtgs/optics/dielectric.py.");
  m.def("wall_reflectance_backward", [](Floats cosine, float index, Floats upstream, Floats to_cosine, Floats to_index,
                                        int threads) {
    const WallAngles in = {int64_t(cosine.size()), cosine.data(), index, checked_threads(threads)};
    for (const Floats* each : {&upstream, &to_cosine}) require(kWall, *each, "a gradient", in.count);
    require(kWall, to_index, "gradient of the index", 1);
    const float* from = upstream.data();
    float *by_cosine = to_cosine.data(), *by_index = to_index.data();
    nb::gil_scoped_release release;
    Blocks blocks(in.count, 1);
    RTGS_DISPATCH(wall_reflectance_backward, in, from, by_cosine, blocks.parts.data());
    blocks.total(by_index);
  }, nb::arg("cosine"), nb::arg("index"), nb::arg("upstream"), nb::arg("to_cosine"), nb::arg("to_index"),
     nb::arg("threads"), "Fills the gradients by the cosines, and by the index, which all share.");
}

}  // namespace rtgs
