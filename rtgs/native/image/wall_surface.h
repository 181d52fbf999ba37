// Reflectance of thin walls of glass, and sums over rows, for the kernels of wall.h. Kernel files include it.
#pragma once
#include "common/parallel.h"
#include "image/wall.h"
#include "image/vectors.h"

namespace rtgs::RTGS_ISA {

constexpr float kSmallestCosine = 1e-4f;

// work(first, lanes, totals) for every group of rows; Sums totals of each block go to `sums` (blocks, Sums).
template <int Sums, class Work>
static inline void for_blocks(int threads, int64_t count, float* sums, const Work& work) {
  each_block(threads, count, kWallBlock, [&](int64_t begin) {
    const int64_t end = begin + kWallBlock < count ? begin + kWallBlock : count;
    vfloat totals[Sums] = {};
    for (int64_t first = begin; first < end; first += kLanes) work(first, lanes_at(first, count), totals);
    for (int k = 0; k < Sums; ++k) sums[begin / kWallBlock * Sums + k] = sum(totals[k]);
  });
}

// F of kLanes walls with the cosine c and the index n. With p = n times the cosine inside, p^2 = n^2 - 1 + c^2, the
// amplitudes are (c - p) / (c + p) and (n^2 c - p) / (n^2 c + p), here without the differences of equals.
struct Surface {
  vmask inside;  // of the clamp
  vfloat cosine, p, across, along, over_across, over_along, fresnel;
  float index, excess;  // n, n^2 - 1

  Surface(vfloat raw, float n) : index(n), excess(float(double(n) * n - 1)) {
    const vfloat low = broadcast(kSmallestCosine), one = broadcast(1.f);
    inside = ge(raw, low) & le(raw, one);
    cosine = select(lt(raw, low), low, select(gt(raw, one), one, raw));  // NaN is handed on
    const vfloat square = cosine * cosine;
    p = sqrt(square + excess);
    over_across = 1.f / (cosine + p);
    over_along = 1.f / (n * n * cosine + p);
    across = -excess * over_across * over_across;
    along = excess * ((n * n + 1) * square - 1.f) * over_along * over_along;
    fresnel = 0.5f * (across * across + along * along);
  }
  vfloat reflected() const { return 2.f * fresnel / (1.f + fresnel); }  // R of the wall
  vfloat slope() const {  // of R by F, over p
    const vfloat sum = 1.f + fresnel;
    return 2.f / (sum * sum * p);
  }
  vfloat by_cosine() const {
    const vfloat of_along = 2.f * index * index * excess * over_along * over_along;
    return where(inside, slope() * (along * of_along - 2.f * across * across));
  }
  vfloat by_index() const {
    const vfloat of_across = over_across * over_across, of_along = over_along * over_along;
    const vfloat twice = 2.f * index * cosine;
    return slope() * twice * (along * (2.f * p * p - index * index) * of_along - across * of_across);
  }
};

}  // namespace rtgs::RTGS_ISA
