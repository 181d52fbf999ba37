#include "bind/bindings.h"
#include "common/isa.h"
#include "common/threads.h"
#include "light/features.h"

namespace rtgs {
namespace {

const char* const kFeatures = "feature light";

FeatureMap map_of(const Floats& texels, const Table& sides) {
  if (sides.size() < 2 || sides.size() > size_t(kMaxMapLevels))
    throw std::invalid_argument("feature light: " + std::to_string(sides.size()) + " levels; 2 to 16 are possible");
  FeatureMap map = {};
  map.texels = texels.data();
  map.levels = int(sides.size());
  int64_t start = 0;
  for (int k = 0; k < map.levels; ++k) {
    const int64_t side = sides.data()[k];
    if (side < 1 || side > 8192) throw std::invalid_argument("feature light: a level of side " + std::to_string(side));
    map.side[k] = int32_t(side);
    map.start[k] = start;
    start += 2 * side * side;
  }
  require(kFeatures, texels, "texels", kDirection * start);
  return map;
}

// The network's matrices and biases in the order of FeatureNetwork.
FeatureNetwork network_of(const nb::tuple& packed) {
  if (packed.size() != 9) throw std::invalid_argument("feature light: the network has 9 arrays");
  Floats arrays[9];
  for (int k = 0; k < 9; ++k) arrays[k] = nb::cast<Floats>(packed[k], false);
  const int64_t width = int64_t(arrays[6].size());
  if (width < kWidthStep || width > 4096 || width % kWidthStep)
    throw std::invalid_argument("feature light: a width of " + std::to_string(width) + ", not a multiple of 16");
  const int64_t sizes[9] = {width * kInputs, width * width, 8 * width, kInputs * width, width * width, width * kColors,
                            width, width, kColors};
  const char* names[9] = {"first", "second", "last", "first_t", "second_t", "last_t", "first_bias", "second_bias",
                          "last_bias"};
  for (int k = 0; k < 9; ++k) require(kFeatures, arrays[k], names[k], sizes[k]);
  return {int(width), arrays[0].data(), arrays[1].data(), arrays[2].data(), arrays[3].data(), arrays[4].data(),
          arrays[5].data(), arrays[6].data(), arrays[7].data(), arrays[8].data()};
}

FeatureRays rays_of(const Floats& directions, const Floats& level, const Floats& surface, int threads) {
  const int64_t count = int64_t(level.size());
  require(kFeatures, directions, "directions", 3 * count);
  require(kFeatures, surface, "surface", kSurface * count);
  return {count, directions.data(), level.data(), surface.data(), checked_threads(threads)};
}

// What both directions read, and where they work.
struct Given {
  FeatureMap map;
  FeatureNetwork net;
  FeatureRays rays;
  FeatureSaved saved;
  float* work;
};

Given given_of(const Floats& texels, const Table& sides, const nb::tuple& network, const Floats& directions,
               const Floats& level, const Floats& surface, const Floats& scratch, const Floats& found,
               const Floats& places, int threads) {
  const FeatureMap map = map_of(texels, sides);
  const FeatureNetwork net = network_of(network);
  const FeatureRays rays = rays_of(directions, level, surface, threads);
  require(kFeatures, found, "found", kDirection * rays.count);
  require(kFeatures, places, "places", 2 * rays.count);
  require(kFeatures, scratch, "scratch", kFeatureChunks * feature_scratch(net.width));
  return {map, net, rays, {found.data(), places.data()}, scratch.data()};
}

}  // namespace

void bind_features(nb::module_& m) {
  m.attr("feature_chunks") = kFeatureChunks;
  m.def("feature_scratch", [](int64_t width) { return kFeatureChunks * feature_scratch(width); }, nb::arg("width"),
        "Floats that feature_light works in.");
  m.def("feature_weights", &feature_weights, nb::arg("width"), "Floats of the gradient of a network, one chunk.");
  m.def("feature_light", [](Floats texels, Table sides, nb::tuple network, Floats directions, Floats level,
                            Floats surface, Floats scratch, Floats found, Floats places, Floats color, int threads) {
    const Given given =
        given_of(texels, sides, network, directions, level, surface, scratch, found, places, threads);
    require(kFeatures, color, "color", 3 * given.rays.count);
    float* out = color.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(feature_light, given.map, given.net, given.rays, given.work, given.saved, out);
  }, nb::arg("texels"), nb::arg("sides"), nb::arg("network"), nb::arg("directions"), nb::arg("level"),
     nb::arg("surface"), nb::arg("scratch"), nb::arg("found"), nb::arg("places"), nb::arg("color"), nb::arg("threads"),
     "Fills color (P, 3), found (P, 16) and places (P, 2); see rtgs/light/feature_network.py.");
  m.def("feature_light_backward", [](Floats texels, Table sides, nb::tuple network, Floats directions, Floats level,
                                     Floats surface, Floats scratch, Floats found, Floats places, Floats upstream,
                                     nb::tuple gradients, int threads) {
    const Given given =
        given_of(texels, sides, network, directions, level, surface, scratch, found, places, threads);
    require(kFeatures, upstream, "upstream", 3 * given.rays.count);
    if (gradients.size() != 6) throw std::invalid_argument("feature light: there are 6 arrays of gradients");
    Floats to[6];
    for (int k = 0; k < 6; ++k) to[k] = nb::cast<Floats>(gradients[k], false);
    const int64_t count = given.rays.count;
    const int64_t sizes[6] = {int64_t(texels.size()), 3 * count, count, kSurface * count,
                              kFeatureChunks * feature_weights(given.net.width), kDirection * count};
    for (int k = 0; k < 6; ++k) require(kFeatures, to[k], "a gradient", sizes[k]);
    const FeatureGradients out = {to[0].data(), to[1].data(), to[2].data(), to[3].data(), to[4].data(), to[5].data()};
    const float* from = upstream.data();
    nb::gil_scoped_release release;
    RTGS_DISPATCH(feature_light_backward, given.map, given.net, given.rays, given.work, given.saved, from, out);
  }, nb::arg("texels"), nb::arg("sides"), nb::arg("network"), nb::arg("directions"), nb::arg("level"),
     nb::arg("surface"), nb::arg("scratch"), nb::arg("found"), nb::arg("places"), nb::arg("upstream"),
     nb::arg("gradients"), nb::arg("threads"),
     "Adds to the gradients of texels and of each chunk's network, fills those of directions, level and surface.");
}

}  // namespace rtgs
