// Planes, rays and colours of blend.h: memory moved, for every instruction set alike.
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

void take_rays(const TracedIndex& at, const RayTables& tables, bool rows, float* directions) {
  const int64_t of_ray = rows ? 3 : 1, of_axis = rows ? 1 : at.count;
  in_shares(worth(at.threads, at.count), at.count, [&](int64_t begin, int64_t end) {
    int64_t row = 0;
    for (int64_t k = begin; k < end; ++k) {
      int64_t column = at.index[k] - row * tables.width;
      if (uint64_t(column) >= uint64_t(tables.width))  // neighbours are mostly in one row: few divisions
        row = at.index[k] / tables.width, column = at.index[k] - row * tables.width;
      const double *across = tables.across + 3 * column, *along = tables.along + 3 * row;
      for (int axis = 0; axis < 3; ++axis) directions[k * of_ray + axis * of_axis] = float(across[axis] + along[axis]);
    }
  });
}

void show_rays(const ShownRays& shown, const float* colors, float* planes, int threads) {
  each_in_shares(worth(threads, shown.pixels), shown.pixels, [&](int64_t k) {
    for (int c = 0; c < 3; ++c) planes[c * shown.pixels + k] = colors[3 * shown.ray[k] + c];
  });
}

void show_rays_backward(const ShownRays& shown, const float* planes, float* colors) {
  memset(colors, 0, size_t(shown.rays) * 3 * sizeof(float));
  for (int64_t k = 0; k < shown.pixels; ++k)
    for (int c = 0; c < 3; ++c) colors[3 * shown.ray[k] + c] += planes[c * shown.pixels + k];
}

}  // namespace rtgs
