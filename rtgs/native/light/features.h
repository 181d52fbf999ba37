// The light of Ref-GS: a lat-long map of features with box mips, and the network that makes light of them and of the
// features of a surface. Twin: rtgs/light/feature_network.py, rtgs/light/feature_map.py.
#pragma once
#include <cstdint>

namespace rtgs {

constexpr int kMaxMapLevels = 16;
constexpr int kDirection = 16, kSurface = 4;                    // features of a direction, and of a surface
constexpr int kInputs = kDirection * kSurface + kDirection;     // of the network: their products, and the first again
constexpr int kWidthStep = 16, kColors = 16;                    // widths are padded to multiples of it; rgb and zeros
constexpr int kFeatureBlock = 64;                               // pixels that go through the network together
constexpr int kFeatureChunks = 16;                              // shares of the pixels, whatever the threads

// Levels one behind the other, each (side, 2 side, 16): rows from the pole that is up.
struct FeatureMap {
  const float* texels;
  int levels;  // 2 or more
  int32_t side[kMaxMapLevels];
  int64_t start[kMaxMapLevels];  // first texel
};

// Padded with zeros to `width`, a multiple of kWidthStep; each matrix also transposed.
struct FeatureNetwork {
  int width;
  const float *first, *second, *last;        // (width, kInputs), (width, width), (8, width)
  const float *first_t, *second_t, *last_t;  // (kInputs, width), (width, width), (width, kColors)
  const float *first_bias, *second_bias, *last_bias;  // (width), (width), (kColors)
};

struct FeatureRays {
  int64_t count;
  const float* directions;  // (P, 3) in the map's frame, any length
  const float* level;       // (P) place between levels
  const float* surface;     // (P, 4), any length
  int threads;
};

struct FeatureSaved {
  float* found;   // (P, 16) features of the directions
  float* places;  // (P, 2) shares of the map's width and height
};

// Floats that one chunk needs to work in, and those of a chunk's share of the gradients of the network: first, second,
// last, then the three biases.
constexpr int64_t feature_scratch(int64_t width) { return kFeatureBlock * (2 * kInputs + 2 * kColors + 4 * width); }
constexpr int64_t feature_weights(int64_t width) { return width * (kInputs + width + 8 + 2) + kColors; }

struct FeatureGradients {
  float* texels;      // as FeatureMap::texels, zero beforehand
  float* directions;  // (P, 3)
  float* level;       // (P)
  float* surface;     // (P, 4)
  float* network;     // (kFeatureChunks, feature_weights), zero beforehand; the sum is in the first row afterwards
  float* found;       // (P, 16) to work in
};

#define RTGS_DECLARE_FEATURE_KERNELS(isa)                                                                     \
  namespace isa {                                                                                             \
  void feature_light(const FeatureMap& map, const FeatureNetwork& network, const FeatureRays& rays,           \
                     float* scratch, const FeatureSaved& saved, float* color);                                \
  void feature_light_backward(const FeatureMap& map, const FeatureNetwork& network, const FeatureRays& rays,  \
                              float* scratch, const FeatureSaved& saved, const float* upstream,               \
                              const FeatureGradients& out);                                                   \
  }
RTGS_DECLARE_FEATURE_KERNELS(portable)
#if defined(__x86_64__)
RTGS_DECLARE_FEATURE_KERNELS(avx2)
RTGS_DECLARE_FEATURE_KERNELS(avx512)
#endif
#undef RTGS_DECLARE_FEATURE_KERNELS

}  // namespace rtgs
