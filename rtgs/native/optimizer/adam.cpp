// Elementwise kernels: the result does not depend on the thread count.
#include "common/parallel.h"
#include "optimizer/adam.h"

#include "common/simd.h"

namespace rtgs::RTGS_ISA {
namespace {

constexpr int kExponent = 0x7f800000;
constexpr long kChunk = 8192;  // floats of each array that a thread takes at once

// Moments below these are set to 0: a surfel that no view sees would otherwise keep them in the range of denormal
// numbers for ever, each a trap to microcode. Far below what changes a parameter: eps is 1e-15.
constexpr float kSmallestFirst = 1e-30f, kSmallestSecond = 1.2e-38f, kLargestRoot = 1e37f;

inline vmask is_finite(vfloat a) {
  return gt(to_float(broadcast_int(kExponent) - ((vint)a & kExponent)), vfloat{});
}

struct Element {
  vfloat value, gradient, first, second;
};
// One Adam update of a register; returns the lanes whose gradient is NaN or inf.
inline vmask update(Element& e, float step_size, const AdamSettings& s) {
  const vmask finite = is_finite(e.gradient);
  const vfloat g = where(finite, e.gradient);
  e.first += (g - e.first) * s.one_minus_beta1;
  e.first = where(gt(abs(e.first), broadcast(kSmallestFirst)), e.first);
  e.second = e.second * s.beta2 + s.one_minus_beta2 * g * g;
  e.second = where(gt(e.second, broadcast(kSmallestSecond)), e.second);
  const vfloat root = min(sqrt(e.second) * s.second_scale, broadcast(kLargestRoot));
  e.value -= step_size * e.first / (root + s.eps);
  return mask_not(finite);
}

// Updates a run of consecutive floats; returns the number of NaN or inf gradients.
inline long update_run(const AdamTensor& t, long start, long count, const AdamSettings& s) {
  float *p = t.values + start, *m = t.first + start, *v = t.second + start;
  const float* g = t.gradients + start;
  long bad = 0, i = 0;
  for (; i + kLanes <= count; i += kLanes) {
    Element e = {load(p + i), load(g + i), load(m + i), load(v + i)};
    const vmask wrong = update(e, t.step_size, s);
    store(p + i, e.value);
    store(m + i, e.first);
    store(v + i, e.second);
    if (any(wrong)) bad += __builtin_popcount(mask_bits(wrong));
  }
  if (i < count) {
    const int rest = int(count - i);
    Element e = {load_first(p + i, rest), load_first(g + i, rest), load_first(m + i, rest), load_first(v + i, rest)};
    const vmask wrong = update(e, t.step_size, s);
    store_first(p + i, e.value, rest);
    store_first(m + i, e.first, rest);
    store_first(v + i, e.second, rest);
    bad += __builtin_popcount(mask_bits(wrong));
  }
  return bad;
}

inline long rows_per_chunk(const AdamTensor& t) { return t.stride >= kChunk ? 1 : kChunk / t.stride; }
inline long chunk_total(const AdamTensor& t) { return (t.rows + rows_per_chunk(t) - 1) / rows_per_chunk(t); }

inline long update_chunk(const AdamTensor& t, long chunk, const AdamSettings& s) {
  const long first = chunk * rows_per_chunk(t), left = t.rows - first;
  const long rows = left < rows_per_chunk(t) ? left : rows_per_chunk(t);
  if (t.active == t.stride) return update_run(t, first * t.stride, rows * t.stride, s);
  long bad = 0;
  for (long row = first; row < first + rows; ++row) bad += update_run(t, row * t.stride, t.active, s);
  return bad;
}

// Waking a thread costs more than a few chunks.
inline int useful_threads(long chunks, int threads) {
  const long most = 1 + chunks / 8;
  return most < threads ? int(most) : threads;
}

}  // namespace

long adam_step(const AdamTensor* tensors, int count, const AdamSettings& s) {
  long chunks = 0, bad = 0;
  for (int k = 0; k < count; ++k) chunks += chunk_total(tensors[k]);
  const int threads = useful_threads(chunks, s.threads);
  each_in_shares(threads, chunks, [&](int64_t chunk) {
    long local = chunk;
    int k = 0;
    while (local >= chunk_total(tensors[k])) local -= chunk_total(tensors[k++]);
    if (const long wrong = update_chunk(tensors[k], local, s)) __atomic_fetch_add(&bad, wrong, __ATOMIC_RELAXED);
  });
  return bad;
}

long count_nonfinite(const float* values, long count, int threads) {
  long bad = 0;
  const long chunks = (count + kChunk - 1) / kChunk;
  threads = useful_threads(chunks, threads);
  each_in_shares(threads, chunks, [&](int64_t chunk) {
    const float* p = values + chunk * kChunk;
    const long left = count - chunk * kChunk, length = left < kChunk ? left : kChunk;
    int wrong = 0;
    for (long i = 0; i < length; ++i) {
      int32_t bits;
      memcpy(&bits, p + i, sizeof bits);
      wrong += (bits & kExponent) == kExponent;
    }
    if (wrong) __atomic_fetch_add(&bad, long(wrong), __ATOMIC_RELAXED);
  });
  return bad;
}

}  // namespace rtgs::RTGS_ISA
