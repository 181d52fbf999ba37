// Stable radix sort of (32-bit key, id) pairs; the result does not depend on the number of threads.
#pragma once
#include <cstring>

#include "common/parallel.h"
#include "raster/raster.h"

namespace rtgs::RTGS_ISA {

constexpr int kDigitBits = 11, kDigits = 1 << kDigitBits;
constexpr int kMaxThreads = 64;  // of the sort: bounds the histograms, see sort_scratch

struct Chunk {
  int64_t begin, end;
};
static inline Chunk chunk_of(int64_t count, int part, int parts) {
  return {count * part / parts, count * (part + 1) / parts};
}

static inline int clipped_threads(int threads, int64_t count) {
  const int64_t useful = count / 4096 + 1;
  if (threads > useful) threads = int(useful);
  return threads < kMaxThreads ? threads : kMaxThreads;
}

// One stable pass over an 11-bit digit. histograms: (threads, kDigits).
static inline void radix_pass(const DepthKey* in, DepthKey* out, int64_t count, int shift, int threads,
                              int64_t* histograms) {
  in_parts(threads, [&](int part) {
    const Chunk chunk = chunk_of(count, part, threads);
    int64_t* mine = histograms + int64_t(part) * kDigits;
    memset(mine, 0, kDigits * sizeof(int64_t));
    for (int64_t k = chunk.begin; k < chunk.end; ++k) ++mine[in[k].depth >> shift & (kDigits - 1)];
  });
  int64_t start = 0;
  for (int digit = 0; digit < kDigits; ++digit)
    for (int part = 0; part < threads; ++part) {
      int64_t size = histograms[int64_t(part) * kDigits + digit];
      histograms[int64_t(part) * kDigits + digit] = start;
      start += size;
    }
  in_parts(threads, [&](int part) {
    const Chunk chunk = chunk_of(count, part, threads);
    int64_t* mine = histograms + int64_t(part) * kDigits;
    for (int64_t k = chunk.begin; k < chunk.end; ++k) out[mine[in[k].depth >> shift & (kDigits - 1)]++] = in[k];
  });
}

// From spare into keys by ascending key; both hold count. scratch: kMaxThreads * kDigits numbers.
static inline void radix_sort(DepthKey* spare, DepthKey* keys, int64_t count, int64_t* scratch, int threads) {
  threads = clipped_threads(threads, count);
  radix_pass(spare, keys, count, 0, threads, scratch);
  radix_pass(keys, spare, count, kDigitBits, threads, scratch);
  radix_pass(spare, keys, count, 2 * kDigitBits, threads, scratch);
}

}  // namespace rtgs::RTGS_ISA
