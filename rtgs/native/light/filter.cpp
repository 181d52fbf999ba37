// The filter of cubemap.h: each weight is used for eight texels and three colours at once.
#include "common/parallel.h"
#include "common/rows.h"
#include "light/cubemap.h"

namespace rtgs::RTGS_ISA {
namespace {

constexpr int kImages = 8, kRow = 4 * kImages, kRegisters = kRow / kLanes;  // rgb and a zero of eight mirrored texels

inline void add_row(vfloat* sum, float weight, const float* row) {
  for (int k = 0; k < kRegisters; ++k) sum[k] = fma(broadcast(weight), load(row + k * kLanes), sum[k]);
}

}  // namespace

// spread: (texels, 32) floats to work in
void cube_filter(const CubeFilter& f, const float* x, float* spread, float* y) {
  each_in_shares(f.threads, f.texels, [&](int64_t j) {
    for (int g = 0; g < kImages; ++g) {
      const int64_t from = f.images[g * f.texels + j];
      float* to = spread + j * kRow + 4 * g;
      for (int c = 0; c < 3; ++c) to[c] = f.before[j] * x[3 * from + c];
      to[3] = 0.f;
    }
  });
  each_in_shares(f.threads, f.rows, [&](int64_t row) {
    vfloat even[kRegisters] = {}, odd[kRegisters] = {};
    int64_t k = f.start[row];
    const int64_t end = f.start[row + 1];
    for (; k + 1 < end; k += 2) {
      add_row(even, f.weight[k], spread + int64_t(f.column[k]) * kRow);
      add_row(odd, f.weight[k + 1], spread + int64_t(f.column[k + 1]) * kRow);
    }
    if (k < end) add_row(even, f.weight[k], spread + int64_t(f.column[k]) * kRow);
    float sums[kRow];
    for (int r = 0; r < kRegisters; ++r) store(sums + r * kLanes, even[r] + odd[r]);
    const int64_t texel = f.texel[row];
    for (int g = 0; g < kImages; ++g)
      for (int c = 0; c < 3; ++c) y[3 * int64_t(f.images[g * f.texels + texel]) + c] = f.after[texel] * sums[4 * g + c];
  });
}

}  // namespace rtgs::RTGS_ISA
