// Gradient rows of the tracer's backward pass: their layout, and in which order they are summed.
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

// ---- groups ------------------------------------------------------------------------------------------------------
constexpr int64_t kGroup = 32;  // packets; where rays are coherent they meet the same surfels: few rows, in the cache
constexpr int64_t kGroupsInWave = 16;  // for each thread

// The rows of one group of packets, at the end of those of its thread.
class GroupRows {
 public:
  GroupRows(TraceWorkspace& work, int64_t surfels, int stride) : work_(work), stride_(stride), first_(work.summed) {
    const int64_t before = work.places.capacity;
    work.places.reserve(surfels);
    if (work.places.capacity > before)
      memset(work.places.data + before, 0, size_t(work.places.capacity - before) * sizeof(int32_t));
  }
  // Of the surfel; adds: whether the group has summed anything into it.
  float* of(int32_t slot, bool& adds) {
    int32_t& place = work_.places[slot];  // of an earlier group or call where it does not hold the slot
    adds = place >= first_ && place < work_.summed && work_.summed_slots[place] == slot;
    if (!adds) {
      place = int32_t(work_.summed);
      work_.summed_slots.reserve(place + 1);
      work_.summed_rows.reserve(int64_t(place + 1) * stride_);
      work_.summed_slots[work_.summed++] = slot;
    }
    return work_.summed_rows.data + int64_t(place) * stride_;
  }
  TraceGroup done(int part) const { return {part, first_, work_.summed}; }

 private:
  TraceWorkspace& work_;
  const int stride_;
  const int64_t first_;
};

// Adds what a group has for the surfels with slots begin .. end - 1 to their rows.
static inline void add_group(const TraceBackwardArgs& args, const TraceGroup& group, int64_t begin, int64_t end) {
  const TraceWorkspace& from = workspace_of(args.workspaces, group.part);
  const int floats = RowLayout(args.surfels).floats;
  for (int64_t k = group.begin; k < group.end; ++k) {
    const int64_t slot = from.summed_slots.data[k];
    if (slot < begin || slot >= end) continue;
    const float* sums = from.summed_rows.data + args.row_stride * k;
    float* row = args.rows + args.row_stride * slot;
    const bool adds = args.touched[slot];
    args.touched[slot] = 1;
    for (int c = 0; c < floats; c += kLanes) store(row + c, adds ? load(row + c) + load(sums + c) : load(sums + c));
  }
}

}  // namespace rtgs::RTGS_ISA
