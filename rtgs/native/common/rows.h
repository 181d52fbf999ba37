// Rows of a structure of arrays <-> registers with one lane per row, by shuffles in registers (no gathers).
#pragma once
#include "common/simd.h"

namespace rtgs::RTGS_ISA {

template <int... I>
static inline vfloat shuffle_lanes(vfloat a, vfloat b, LaneList<I...>) {  // lane I of (a, b), b's lanes from kLanes on
#if defined(__clang__)
  return __builtin_shufflevector(a, b, I...);
#else
  return __builtin_shuffle(a, b, vint{I...});
#endif
}

// ---- short rows: C floats each, contiguous ---------------------------------------------------------------------
// Lane i of component c is float i * C + c of the C source registers; register K is merged into what is there.
template <int C, int c, int K, int... I>
static inline vfloat pick_component(vfloat merged, vfloat source, LaneList<I...>) {
  return shuffle_lanes(merged, source,
                       LaneList<((I * C + c) / kLanes == K ? kLanes + (I * C + c) % kLanes
                                 : K == 1 && (I * C + c) / kLanes == 0 ? (I * C + c) % kLanes : I)...>{});
}
template <int C, int c, int K = 1>
static inline vfloat component(const vfloat* source, vfloat merged) {
  if constexpr (K >= C) return merged;
  else return component<C, c, K + 1>(source, pick_component<C, c, K>(merged, source[K], typename MakeLanes<kLanes>::type{}));
}
// kLanes rows of C <= 4 floats from p: component c of row i in lane i of out[c].
template <int C>
static inline void load_rows(const float* p, vfloat* out) {
  vfloat source[C];
  for (int k = 0; k < C; ++k) source[k] = load(p + k * kLanes);
  out[0] = component<C, 0>(source, source[0]);
  if constexpr (C > 1) out[1] = component<C, 1>(source, source[0]);
  if constexpr (C > 2) out[2] = component<C, 2>(source, source[0]);
  if constexpr (C > 3) out[3] = component<C, 3>(source, source[0]);
}

// Lane l of output register o is component (o * kLanes + l) % C of row (o * kLanes + l) / C.
template <int C, int o, int K, int... I>
static inline vfloat place_component(vfloat merged, vfloat source, LaneList<I...>) {
  return shuffle_lanes(merged, source,
                       LaneList<((o * kLanes + I) % C == K ? kLanes + (o * kLanes + I) / C
                                 : K == 1 && (o * kLanes + I) % C == 0 ? (o * kLanes + I) / C : I)...>{});
}
template <int C, int o, int K = 1>
static inline vfloat interleaved(const vfloat* v, vfloat merged) {
  if constexpr (K >= C) return merged;
  else return interleaved<C, o, K + 1>(v, place_component<C, o, K>(merged, v[K], typename MakeLanes<kLanes>::type{}));
}
// The inverse of load_rows.
template <int C>
static inline void store_rows(float* p, const vfloat* v) {
  store(p, interleaved<C, 0>(v, v[0]));
  if constexpr (C > 1) store(p + kLanes, interleaved<C, 1>(v, v[0]));
  if constexpr (C > 2) store(p + 2 * kLanes, interleaved<C, 2>(v, v[0]));
  if constexpr (C > 3) store(p + 3 * kLanes, interleaved<C, 3>(v, v[0]));
}

// ---- long rows: transposes of kLanes x kLanes blocks ------------------------------------------------------------
template <int S, int... I>
static inline void exchange(vfloat& a, vfloat& b, LaneList<I...>) {  // swaps a's groups of S lanes 1, 3, .. with b's 0, 2, ..
  vfloat low = shuffle_lanes(a, b, LaneList<((I & S) == 0 ? I : kLanes + I - S)...>{});
  b = shuffle_lanes(a, b, LaneList<((I & S) == 0 ? I + S : kLanes + I)...>{});
  a = low;
}
template <int S = 1>
static inline void transpose(vfloat* v) {  // v[i] lane j <-> v[j] lane i, in place
  if constexpr (S < kLanes) {
#pragma GCC unroll 16
    for (int i = 0; i < kLanes; ++i)
      if ((i & S) == 0) exchange<S>(v[i], v[i + S], typename MakeLanes<kLanes>::type{});
    transpose<2 * S>(v);
  }
}

// First column of chunk k when a row of L floats is cut into registers; the last chunk overlaps the one before.
template <int L>
constexpr int chunk_start(int k) {
  return L < kLanes || k * kLanes + kLanes <= L ? k * kLanes : L - kLanes;
}
template <int L>
constexpr int chunk_count = (L + kLanes - 1) / kLanes;
template <int L>
constexpr int row_registers = L < kLanes ? kLanes : L;

// kLanes rows of L floats, row i at p + i * stride: column c of row i in lane i of out[c], c < L.
template <int L>
static inline void load_long_rows(const float* p, int stride, vfloat (&out)[row_registers<L>]) {
#pragma GCC unroll 16
  for (int k = 0; k < chunk_count<L>; ++k) {
    vfloat block[kLanes];
    const float* first = p + chunk_start<L>(k);
#pragma GCC unroll 16
    for (int i = 0; i < kLanes; ++i) block[i] = L < kLanes ? load_first(first + i * stride, L) : load(first + i * stride);
    transpose(block);
#pragma GCC unroll 16
    for (int j = 0; j < kLanes; ++j) out[chunk_start<L>(k) + j] = block[j];
  }
}
// The inverse of load_long_rows.
template <int L>
static inline void store_long_rows(float* p, int stride, const vfloat (&v)[row_registers<L>]) {
#pragma GCC unroll 16
  for (int k = 0; k < chunk_count<L>; ++k) {
    vfloat block[kLanes];
#pragma GCC unroll 16
    for (int j = 0; j < kLanes; ++j) block[j] = v[chunk_start<L>(k) + j];
    transpose(block);
    float* first = p + chunk_start<L>(k);
#pragma GCC unroll 16
    for (int i = 0; i < kLanes; ++i)
      if (L < kLanes) store_first(first + i * stride, block[i], L);
      else store(first + i * stride, block[i]);
  }
}

}  // namespace rtgs::RTGS_ISA
