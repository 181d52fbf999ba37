// Bounding boxes of surfels, kLanes at a time.
#include "common/parallel.h"
#include "trace/bvh.h"
#include "trace/surfels.h"

namespace rtgs::RTGS_ISA {

void surfel_boxes(const SurfelArrays& in, float alpha_cutoff, SurfelBox* boxes, int threads) {
  const int64_t groups = (in.count + kLanes - 1) / kLanes;
  each_in_shares(threads, groups, [&](int64_t group) {
    const int64_t first = group * kLanes;
    vfloat low[3], high[3];
    SurfelLanes(in, first, alpha_cutoff).bound(low, high);
    const int64_t lanes = in.count - first < kLanes ? in.count - first : kLanes;
    for (int lane = 0; lane < lanes; ++lane) {
      SurfelBox& box = boxes[first + lane];
      for (int k = 0; k < 3; ++k) box.low[k] = low[k][lane], box.high[k] = high[k][lane];
      box.low[3] = box.high[3] = 0.f;
    }
  });
}

}  // namespace rtgs::RTGS_ISA
