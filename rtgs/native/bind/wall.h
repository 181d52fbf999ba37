// What the bindings of walls of glass share.
#pragma once
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <optional>
#include <tuple>
#include <vector>

#include "bind/bindings.h"
#include "image/wall.h"

namespace rtgs {

constexpr const char* kWall = "wall";

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

using Maybe = std::optional<Floats>;
using Tint = std::tuple<float, float, float>;
using GlassNumbers = std::tuple<float, std::optional<Tint>>;  // index, tint

inline float* pointer(const Maybe& array) { return array ? array->data() : nullptr; }

inline Glass glass_of(const GlassNumbers& numbers) {
  const auto& [index, tint] = numbers;
  if (!tint) return {index, false, {1, 1, 1}};
  const auto [red, green, blue] = *tint;
  return {index, true, {red, green, blue}};
}

using Rows = nb::ndarray<const int64_t, nb::c_contig, nb::device::cpu>;

// Puts the number of each of `rows` at its place, among `count` of which those with -1 are free.
inline void put_rows(std::vector<int32_t>& place, const Rows& rows, int64_t count, const char* told) {
  for (size_t k = 0; k < rows.size(); ++k) {
    const int64_t row = rows.data()[k];
    if (row < 0 || row >= count || place[size_t(row)] != -1)
      throw std::invalid_argument("wall: row " + std::to_string(row) + " of " + std::to_string(count) + " " + told);
    place[size_t(row)] = int32_t(k);
  }
}

}  // namespace rtgs
