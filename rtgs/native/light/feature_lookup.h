// Places of directions in a map of features, its bilinear texels and their gradients. Kernel files include it.
#pragma once
#include <cmath>

#include "light/features.h"

namespace rtgs::RTGS_ISA {

constexpr float kPi = 3.14159265358979f, kNoLongitude = 1e-12f;  // squared distance from the axis

struct Spot {  // four texels of one level and where between them
  int64_t texel[4];
  float u, v;
};

struct Levels {  // the two levels of a place between levels
  int first;
  float share;  // of the second
  bool inside;  // the place is not beyond the ends
};

inline Levels levels_at(const FeatureMap& map, float level) {
  const float last = float(map.levels - 1);
  const float kept = level < 0.f ? 0.f : level > last ? last : level;  // what is no number stays none
  const int first = kept >= 1.f ? (int(kept) < map.levels - 2 ? int(kept) : map.levels - 2) : 0;
  return {first, kept - float(first), level >= 0.f && level <= last};
}

inline int32_t clamped(int32_t value, int32_t last) { return value < 0 ? 0 : value > last ? last : value; }

inline Spot spot_at(const FeatureMap& map, int level, const float* place) {
  const int32_t rows = map.side[level], columns = 2 * rows;
  const float column = place[0] * float(columns) - 0.5f, row = place[1] * float(rows) - 0.5f;
  // An index is made of numbers alone; the shares keep what is none.
  const int32_t left = column >= 0.f ? (column < float(columns) ? int32_t(column) : columns) : -1;
  const int32_t top = row >= 0.f ? (row < float(rows) ? int32_t(row) : rows - 1) : -1;
  const int32_t near = left < 0 ? columns - 1 : left >= columns ? 0 : left, far = near + 1 == columns ? 0 : near + 1;
  const int64_t upper = map.start[level] + int64_t(clamped(top, rows - 1)) * columns;
  const int64_t lower = map.start[level] + int64_t(clamped(top + 1, rows - 1)) * columns;
  return {{upper + near, upper + far, lower + near, lower + far}, column - float(left), row - float(top)};
}

// Shares of the map's width and height along a direction.
inline void place_of(const float* d, float* place) {
  const float square = d[0] * d[0] + d[2] * d[2];
  const bool aside = !(square <= kNoLongitude);
  place[0] = std::atan2(d[0], aside ? -d[2] : 1.f) * (0.5f / kPi) + 0.5f;
  place[1] = std::atan2(aside ? std::sqrt(square) : 0.f, d[1]) * (1.f / kPi);
}

// The gradient of a direction from that of its place.
inline void place_backward(const float* d, const float* by_place, float* by_direction) {
  const float square = d[0] * d[0] + d[2] * d[2];
  if (square <= kNoLongitude) {
    by_direction[0] = by_direction[1] = by_direction[2] = 0.f;
    return;
  }
  const float aside = std::sqrt(square), around = by_place[0] * (0.5f / kPi) / square;
  const float length = 1.f / (kPi * (square + d[1] * d[1])), outward = by_place[1] * length * d[1] / aside;
  by_direction[0] = -around * d[2] + outward * d[0];
  by_direction[1] = -by_place[1] * length * aside;
  by_direction[2] = around * d[0] + outward * d[2];
}

inline void corner_shares(const Spot& at, float scale, float* share) {
  share[0] = scale * (1.f - at.u) * (1.f - at.v);
  share[1] = scale * at.u * (1.f - at.v);
  share[2] = scale * (1.f - at.u) * at.v;
  share[3] = scale * at.u * at.v;
}

inline void add_texels(const FeatureMap& map, const Spot& at, float scale, float* found) {
  float share[4];
  corner_shares(at, scale, share);
  for (int k = 0; k < 4; ++k) {
    const float* texel = map.texels + at.texel[k] * kDirection;
    for (int f = 0; f < kDirection; ++f) found[f] += share[k] * texel[f];
  }
}

// How the product of the texels at `at` with an upstream gradient depends on the column and the row; returns it.
inline float texels_backward(const FeatureMap& map, const Spot& at, const float* upstream, float* by_column,
                             float* by_row) {
  float product[4];
  for (int k = 0; k < 4; ++k) {
    const float* texel = map.texels + at.texel[k] * kDirection;
    float sum = 0.f;
    for (int f = 0; f < kDirection; ++f) sum += texel[f] * upstream[f];
    product[k] = sum;
  }
  const float upper = product[0] + at.u * (product[1] - product[0]);
  const float lower = product[2] + at.u * (product[3] - product[2]);
  *by_column = (product[1] - product[0]) + at.v * ((product[3] - product[2]) - (product[1] - product[0]));
  *by_row = lower - upper;
  return upper + at.v * (lower - upper);
}

}  // namespace rtgs::RTGS_ISA
