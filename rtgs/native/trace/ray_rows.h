// What a ray puts into the gradient rows of the surfels it hit, and the sums over the hits of a packet on a surfel, a
// register of columns at a time.
#pragma once
#include "trace/rows.h"

namespace rtgs::RTGS_ISA {

// Upstream gradients of one ray, as the rows of the surfels it hit want them. Every hit adds weight times this.
struct alignas(64) RayRow {
  float channels[kMostColumns];      // features, colours
  float coefficients[kMostColumns];  // colour c times basis k, at 3 k + c
  float pattern[kMostColumns];       // colour c at 3 k + c
};

// Bits of a ray row that stay where some colours of a surfel are clamped at zero; by those colours, a bit each.
struct alignas(64) ColorMasks {
  uint32_t channels[8][kMostColumns], coefficients[8][kMostColumns];
  explicit ColorMasks(int features) {
    for (int clamped = 0; clamped < 8; ++clamped) {
      for (int c = 0; c < kMostColumns; ++c)
        channels[clamped][c] = c >= features && c < features + 3 && clamped >> (c - features) & 1 ? 0 : ~0u;
      for (int c = 0; c < kMostColumns; ++c) coefficients[clamped][c] = clamped >> (c % 3) & 1 ? 0 : ~0u;
    }
  }
};

struct SurfelHits {  // of one packet on one surfel
  uint32_t lanes;
  bool clamped;                    // any colour of any hit
  alignas(64) float weights[kLanes];
  uint8_t clamped_colors[kLanes];  // where clamped
};

static inline SurfelHits surfel_hits(vmask met, vfloat w, uint64_t clamped) {
  SurfelHits hits;
  hits.lanes = mask_bits(met);
  store(hits.weights, w);
  clamped &= hits.lanes * 0x000100010001ull;  // what the other rays would see does not matter
  hits.clamped = clamped != 0;
  if (hits.clamped)
    for (uint32_t left = hits.lanes; left; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      const uint64_t bits = clamped >> lane;
      hits.clamped_colors[lane] = uint8_t((bits & 1) | (bits >> 15 & 2) | (bits >> 30 & 4));
    }
  return hits;
}

// The rows of a packet's rays. Sums what the hits on a surfel add to its row, and to the gradients of the rays' bases.
class RayRows {
 public:
  RayRows(const TraceSurfels& surfels, const ColorMasks& masks) : surfels_(surfels), masks_(masks), layout_(surfels) {}
  const RowLayout& layout() const { return layout_; }
  RayRow& operator[](int lane) { return rows_[lane]; }
  void clear_channels();
  void clear_coefficients(int lane);

  void sum_hits(const SurfelHits& hits, float* out, bool adds) const;
  void add_direction(const SurfelHits& hits, uint32_t lanes, int64_t id);
  // Both at once where that is quicker: false where it is not, and nothing was done.
  bool sum_both(const SurfelHits& hits, int64_t id, float* out, bool adds);
  const float* to_basis(int lane) const { return to_basis_[lane]; }

 private:
  template <bool kClamped>
  vfloat sum_column(const SurfelHits& hits, const float* column, const uint32_t (*masks)[kMostColumns]) const;
  template <int K, bool kClamped>
  void sum_both_of(const SurfelHits& hits, int64_t id, float* out, bool adds);

  const TraceSurfels& surfels_;
  const ColorMasks& masks_;
  const RowLayout layout_;
  RayRow rows_[kLanes];
  alignas(64) float to_basis_[kLanes][kMostColumns];  // of the ray: gradient to its basis, at 3 k + c
};

inline void RayRows::clear_channels() {
  for (RayRow& row : rows_) memset(row.channels, 0, layout_.channels * sizeof(float));
}
inline void RayRows::clear_coefficients(int lane) {
  memset(rows_[lane].coefficients, 0, layout_.coefficients * sizeof(float));
  memset(rows_[lane].pattern, 0, layout_.coefficients * sizeof(float));
  memset(to_basis_[lane], 0, layout_.coefficients * sizeof(float));
}

static inline void put(float* out, vfloat v, bool adds) { store(out, adds ? load(out) + v : v); }

// Sum of weight times one register of the ray rows; column: that register of the first ray's row.
template <bool kClamped>
inline vfloat RayRows::sum_column(const SurfelHits& hits, const float* column,
                                  const uint32_t (*masks)[kMostColumns]) const {
  constexpr int kRowFloats = sizeof(RayRow) / sizeof(float);
  vfloat sum = broadcast(0.f);
  for (uint32_t left = hits.lanes; left; left &= left - 1) {
    const int lane = __builtin_ctz(left);
    vfloat values = load(column + lane * kRowFloats);
    if (kClamped) values = (vfloat)((vint)values & load_int((const int32_t*)masks[hits.clamped_colors[lane]]));
    sum = fma(broadcast(hits.weights[lane]), values, sum);
  }
  return sum;
}

inline void RayRows::sum_hits(const SurfelHits& hits, float* out, bool adds) const {
  const RayRow& first = rows_[0];
  for (int c = 0; c < layout_.channels; c += kLanes) {
    const auto masks = (const uint32_t(*)[kMostColumns])(masks_.channels[0] + c);
    const vfloat sum = hits.clamped ? sum_column<true>(hits, first.channels + c, masks)
                                    : sum_column<false>(hits, first.channels + c, masks);
    put(out + kTraceGradChannels + c, sum, adds);
  }
  for (int c = 0; c < layout_.coefficients; c += kLanes) {
    const auto masks = (const uint32_t(*)[kMostColumns])(masks_.coefficients[0] + c);
    const vfloat sum = hits.clamped ? sum_column<true>(hits, first.coefficients + c, masks)
                                    : sum_column<false>(hits, first.coefficients + c, masks);
    put(out + kTraceGradChannels + layout_.channels + c, sum, adds);
  }
}

inline void RayRows::add_direction(const SurfelHits& hits, uint32_t lanes, int64_t id) {
  const float* values = surfels_.sh_rest + int64_t(3) * surfels_.rest * id;
  const int used = 3 * rest_count(surfels_.degree);
  for (int c = 0; c < layout_.coefficients; c += kLanes) {
    const vfloat value = load_first(values + c, used - c < kLanes ? used - c : kLanes);
    for (uint32_t left = lanes; left; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      vfloat pattern = load(rows_[lane].pattern + c);
      if (hits.clamped) {
        const uint32_t* mask = masks_.coefficients[hits.clamped_colors[lane]] + c;
        pattern = (vfloat)((vint)pattern & load_int((const int32_t*)mask));
      }
      float* sum = to_basis_[lane] + c;
      store(sum, fma(hits.weights[lane] * pattern, value, load(sum)));
    }
  }
}

// sum_hits and add_direction in one pass over the hits, for colours alone and K registers of coefficients.
template <int K, bool kClamped>
inline void RayRows::sum_both_of(const SurfelHits& hits, int64_t id, float* out, bool adds) {
  const float* values = surfels_.sh_rest + int64_t(3) * surfels_.rest * id;
  const int used = 3 * rest_count(surfels_.degree);
  vfloat value[K], sums[K], channels = broadcast(0.f);
  for (int k = 0; k < K; ++k) {
    value[k] = load_first(values + k * kLanes, used - k * kLanes < kLanes ? used - k * kLanes : kLanes);
    sums[k] = broadcast(0.f);
  }
  for (uint32_t left = hits.lanes; left; left &= left - 1) {
    const int lane = __builtin_ctz(left);
    const RayRow& row = rows_[lane];
    const vfloat w = broadcast(hits.weights[lane]);
    const auto kept = [&](const float* from, const uint32_t* mask) {
      const vfloat v = load(from);
      return kClamped ? (vfloat)((vint)v & load_int((const int32_t*)mask)) : v;
    };
    const int clamped = kClamped ? hits.clamped_colors[lane] : 0;
    channels = fma(w, kept(row.channels, masks_.channels[clamped]), channels);
#pragma GCC unroll 6
    for (int k = 0; k < K; ++k) {
      const uint32_t* mask = masks_.coefficients[clamped] + k * kLanes;
      float* to = to_basis_[lane] + k * kLanes;
      sums[k] = fma(w, kept(row.coefficients + k * kLanes, mask), sums[k]);
      store(to, fma(w * kept(row.pattern + k * kLanes, mask), value[k], load(to)));
    }
  }
  put(out + kTraceGradChannels, channels, adds);
  for (int k = 0; k < K; ++k) put(out + kTraceGradChannels + (k + 1) * kLanes, sums[k], adds);
}
inline bool RayRows::sum_both(const SurfelHits& hits, int64_t id, float* out, bool adds) {
  if (layout_.channels != kLanes) return false;
  switch (layout_.coefficients / kLanes) {
#define RTGS_SUM_BOTH(K)                                        \
  case K:                                                       \
    if (hits.clamped) sum_both_of<K, true>(hits, id, out, adds); \
    else sum_both_of<K, false>(hits, id, out, adds);            \
    return true;
    RTGS_SUM_BOTH(1) RTGS_SUM_BOTH(2) RTGS_SUM_BOTH(3) RTGS_SUM_BOTH(6)
#undef RTGS_SUM_BOTH
    default: return false;
  }
}

}  // namespace rtgs::RTGS_ISA
