// Surfels to the records that rays read, and their boxes, in the order of the tree's leaves.
#include "common/parallel.h"
#include "trace/trace.h"
#include "trace/surfels.h"

namespace rtgs::RTGS_ISA {

static void fill_empty(SlotBoxes& boxes) {
  for (int k = 0; k < 3; ++k)
    for (int place = 0; place < kSlotsPerBlock; ++place) boxes.low[k][place] = 3.4e38f, boxes.high[k][place] = -3.4e38f;
}

// slots: row -> slot, the inverse of the tree's ids.
void trace_records(const SurfelArrays& in, const TreeView& tree, float alpha_cutoff, float* records, SlotBoxes* boxes,
                   int32_t* slots, int threads) {
  each_in_shares(threads, in.count, [&](int64_t slot) { slots[tree.ids[slot]] = int32_t(slot); });
  if (in.count) fill_empty(boxes[(in.count - 1) / kSlotsPerBlock]);
  each_block(threads, in.count, kLanes, [&](int64_t first) {
    const SurfelLanes s(in, first, alpha_cutoff);
    const vfloat iu = 1.f / s.scale_u, iv = 1.f / s.scale_v;
    const vfloat fields[] = {s.mean.x, s.mean.y, s.mean.z, s.normal.x, s.normal.y, s.normal.z,
                             s.tangent_u.x * iu, s.tangent_u.y * iu, s.tangent_u.z * iu,
                             s.tangent_v.x * iv, s.tangent_v.y * iv, s.tangent_v.z * iv, s.reach, s.log_opacity,
                             (vfloat)s.row, broadcast(0.f)};
    vfloat low[3], high[3];
    s.bound(low, high);
    const int64_t lanes = in.count - first < kLanes ? in.count - first : kLanes;
    for (int64_t lane = 0; lane < lanes; ++lane) {
      float* record = records + int64_t(kTraceFields) * slots[first + lane];
      for (int k = 0; k < kTraceFields; ++k) record[k] = fields[k][lane];
      const int32_t slot = slots[first + lane], place = slot % kSlotsPerBlock;
      SlotBoxes& box = boxes[slot / kSlotsPerBlock];
      for (int k = 0; k < 3; ++k) box.low[k][place] = low[k][lane], box.high[k][place] = high[k][lane];
    }
  });
}

}  // namespace rtgs::RTGS_ISA
