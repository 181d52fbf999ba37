// take_planes and put_planes of blend.h: memory moved, for every instruction set alike.
#include <cstring>

#include "common/parallel.h"
#include "image/blend.h"

namespace rtgs {

using namespace baseline;

constexpr int64_t kRows = 1024;  // of all planes one after the other: their part of the index stays in the cache

void take_planes(const TracedIndex& at, const PixelPlanes& maps) {
  each_block(at.threads, at.count, kRows, [&](int64_t begin) {
    const int64_t end = begin + kRows < at.count ? begin + kRows : at.count;
    for (int k = 0; k < maps.count; ++k) {
      const float* from = maps.planes[k];
      float* to = maps.rows[k];
      for (int64_t row = begin; row < end; ++row) to[row] = from[at.index[row]];
    }
  });
}

void put_planes(const TracedIndex& at, const PixelPlanes& maps) {
  in_shares(at.threads, at.pixels, [&](int64_t begin, int64_t end) {
    for (int k = 0; k < maps.count; ++k) memset(maps.planes[k] + begin, 0, size_t(end - begin) * sizeof(float));
  });
  each_block(at.threads, at.count, kRows, [&](int64_t begin) {
    const int64_t end = begin + kRows < at.count ? begin + kRows : at.count;
    for (int k = 0; k < maps.count; ++k) {
      const float* from = maps.rows[k];
      float* to = maps.planes[k];
      for (int64_t row = begin; row < end; ++row) to[at.index[row]] = from[row];
    }
  });
}

}  // namespace rtgs
