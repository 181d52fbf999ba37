// Gradient rows of the tracer's backward pass: their layout, and how threads share them.
#pragma once
#include "common/parallel.h"
#include "trace/packet.h"

namespace rtgs::RTGS_ISA {

constexpr int kMostColumns = 48;  // of features and colours, and of the coefficients of sh_rest, padded
static constexpr int padded(int floats) { return (floats + kLanes - 1) / kLanes * kLanes; }

struct RowLayout {
  int channels, coefficients, floats;  // the first two padded to whole registers
  explicit RowLayout(const TraceSurfels& s)
      : channels(padded(s.feature_count() + s.colour_count())),
        coefficients(s.sh_dc ? padded(3 * rest_count(s.degree)) : 0),
        floats(kTraceGradChannels + channels + coefficients) {}
};

// ---- threads -----------------------------------------------------------------------------------------------------
// Ranges of about equal work: range_starts. And to which range each surfel's row belongs.
static inline void split_work(const TraceBackwardArgs& args) {
  const int64_t packets = packet_count(args.rays);
  const int threads = args.options.threads;
  int64_t total = 0, done = 0;
  const auto work = [&](int64_t p) { return int64_t(args.tapes[p].hits) + 8 * args.tapes[p].surfels; };
  for (int64_t packet = 0; packet < packets; ++packet) total += work(packet);
  int range = 0;
  for (int64_t packet = 0; packet < packets; ++packet) {
    while (range < threads && done * threads >= total * range) args.range_starts[range++] = packet;
    done += work(packet);
  }
  while (range <= threads) args.range_starts[range++] = packets;
  if (threads == 1 || !args.surfel_gradients) return;
  memset(args.owners, 0x7f, size_t(args.surfels.arrays.count) * sizeof(int32_t));
  in_parts(threads, [&](int part) {
    for (int64_t packet = args.range_starts[part]; packet < args.range_starts[part + 1]; ++packet)
      for (int32_t k = 0; k < args.tapes[packet].surfels; ++k) {
        int32_t* owner = args.owners + args.tapes[packet].slots[k];
        int32_t before = __atomic_load_n(owner, __ATOMIC_RELAXED);
        while (part < before &&
               !__atomic_compare_exchange_n(owner, &before, part, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
        }
      }
  });
}

// Each thread takes a share of the slots, so that the order of additions to a row is that of the packets.
static inline void add_waiting(const TraceBackwardArgs& args) {
  const int threads = args.options.threads;
  const int64_t count = args.surfels.arrays.count;
  const int floats = RowLayout(args.surfels).floats;
  in_parts(threads, [&](int part) {
    const int64_t begin = count * part / threads, end = count * (part + 1) / threads;
    for (int range = 1; range < threads; ++range) {
      TraceWorkspace& from = workspace_of(args.workspaces, range);
      for (int64_t k = 0; k < from.waiting; ++k) {
        const int64_t slot = from.waiting_slots[k];
        if (slot < begin || slot >= end) continue;
        const float* waiting = from.waiting_rows.data + args.row_stride * k;
        float* row = args.rows + args.row_stride * slot;
        for (int c = 0; c < floats; c += kLanes) store(row + c, load(row + c) + load(waiting + c));
      }
    }
  });
}

}  // namespace rtgs::RTGS_ISA
