// sensor.h: one pass over the numbers, bound by memory.
#include "image/sensor.h"

#include "common/parallel.h"

namespace rtgs {

using namespace baseline;

namespace {

inline void put(const SensorPicture& in, const float* from, float instead, float* to) {
  in_shares(worth(in.threads, in.count), in.count, [&](int64_t begin, int64_t end) {
    for (int64_t k = begin; k < end; ++k) {
      const bool cut = (in.photo[k] >= in.brightest) & (in.image[k] > 1.f);
      to[k] = cut ? instead : from[k];
    }
  });
}

}  // namespace

void cut_light(const SensorPicture& in, float* to) { put(in, in.image, 1.f, to); }

void cut_light_backward(const SensorPicture& in, const float* upstream, float* to) { put(in, upstream, 0.f, to); }

}  // namespace rtgs
