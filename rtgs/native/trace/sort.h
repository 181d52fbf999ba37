// Sorting in the tracer: rows of hits lane by lane, and the list of a packet's surfels.
#pragma once
#include "common/rows.h"

namespace rtgs::RTGS_ISA {

// Sorts every lane of the rows by t, carrying the places along (Batcher's odd-even merge exchange, any count). Equal t
// may come in any order.
static inline void sort_rows(float* t, int32_t* places, int count) {
  for (int p = 1; p < count; p *= 2)
    for (int k = p; k >= 1; k /= 2)
      for (int j = k & (p - 1); j + k < count; j += 2 * k)
        for (int i = j, end = j + k < count - k ? j + k : count - k; i < end; ++i) {
          if ((i ^ (i + k)) >= 2 * p) continue;  // the two belong to different runs
          float *ta = t + i * kLanes, *tb = ta + k * kLanes;
          int32_t *pa = places + i * kLanes, *pb = pa + k * kLanes;
          const vfloat a = load(ta), b = load(tb);
          const vint x = load_int(pa), y = load_int(pb);
          const vmask swap = lt(b, a);
          store(ta, min(a, b));
          store(tb, max(a, b));
          const vint low = select_int(swap, y, x), high = select_int(swap, x, y);
          memcpy(pa, &low, sizeof low);
          memcpy(pb, &high, sizeof high);
        }
}

// ---- ascending bitonic sort of integers -------------------------------------------------------------------------
template <int S, bool kMirror, int... I>
static inline vint compare_within(vint v, LaneList<I...>) {
  // Lane I meets its mirror image in its group of 2 S lanes, or lane I ^ S.
  const vfloat f = (vfloat)v;
  const vint other = (vint)shuffle_lanes(f, f, LaneList<(kMirror ? I ^ (2 * S - 1) : I ^ S)...>{});
  const vint low = min_int(v, other), high = max_int(v, other);
  return (vint)shuffle_lanes((vfloat)low, (vfloat)high, LaneList<((I & S) == 0 ? I : kLanes + I)...>{});
}
template <int S>
static inline vint merge_within(vint v) {  // strides S, S/2, .. 1
  if constexpr (S == 0) return v;
  else return merge_within<S / 2>(compare_within<S, false>(v, typename MakeLanes<kLanes>::type{}));
}
template <int S = 1>
static inline vint sort_within(vint v) {
  if constexpr (S == kLanes) return v;
  else return sort_within<2 * S>(merge_within<S / 2>(compare_within<S, true>(v, typename MakeLanes<kLanes>::type{})));
}
template <int... I>
static inline vint reversed(vint v, LaneList<I...>) {
  return (vint)shuffle_lanes((vfloat)v, (vfloat)v, LaneList<(kLanes - 1 - I)...>{});
}
static inline void store_ints(int32_t* p, vint v) { memcpy(p, &v, sizeof v); }
static inline void exchange_ints(int32_t* a, int32_t* b) {
  const vint x = load_int(a), y = load_int(b);
  store_ints(a, min_int(x, y));
  store_ints(b, max_int(x, y));
}

// keys has room for padded_count(count) values.
static inline int padded_count(int count) {
  int padded = kLanes;
  while (padded < count) padded *= 2;
  return padded;
}
static inline void sort_ints(int32_t* keys, int count) {
  const int padded = padded_count(count);
  for (int i = count; i < padded; ++i) keys[i] = INT32_MAX;
  for (int i = 0; i < padded; i += kLanes) store_ints(keys + i, sort_within<>(load_int(keys + i)));
  for (int run = 2 * kLanes; run <= padded; run *= 2)
    for (int base = 0; base < count; base += run) {
      int32_t* first = keys + base;
      for (int i = 0; i < run / 2; i += kLanes) {  // each register with its mirror image
        int32_t *pa = first + i, *pb = first + run - kLanes - i;
        const vint a = load_int(pa), b = reversed(load_int(pb), typename MakeLanes<kLanes>::type{});
        store_ints(pa, min_int(a, b));
        store_ints(pb, max_int(a, b));  // its order within is put right below
      }
      for (int stride = run / 4; stride >= kLanes; stride /= 2)
        for (int i = 0; i < run; i += 2 * stride)
          for (int j = i; j < i + stride; j += kLanes) exchange_ints(first + j, first + j + stride);
      for (int i = 0; i < run; i += kLanes) store_ints(first + i, merge_within<kLanes / 2>(load_int(first + i)));
    }
}

}  // namespace rtgs::RTGS_ISA
