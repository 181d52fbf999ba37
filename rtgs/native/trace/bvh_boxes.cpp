// Bounding boxes of surfels, kLanes at a time.
#include "common/parallel.h"
#include "trace/bvh.h"
#include "trace/surfels.h"

namespace rtgs::RTGS_ISA {

// Padded so that a hit which the tracer accepts lies inside in spite of rounding: in the plane of the surfel by a part
// of its extent, off the plane by a part of its distance from the world's origin (the tracer pads by the ray's own).
void surfel_boxes(const SurfelArrays& in, float alpha_cutoff, SurfelBox* boxes, int threads) {
  const int64_t groups = (in.count + kLanes - 1) / kLanes;
  each_in_shares(threads, groups, [&](int64_t group) {
    const int64_t first = group * kLanes;
    const SurfelLanes s(in, first, alpha_cutoff);
    const vfloat radius = sqrt(max(s.reach, broadcast(0.f)));
    const vfloat mean[] = {s.mean.x, s.mean.y, s.mean.z};
    const vfloat u[] = {s.tangent_u.x, s.tangent_u.y, s.tangent_u.z};
    const vfloat v[] = {s.tangent_v.x, s.tangent_v.y, s.tangent_v.z};
    const vfloat magnitude = max(max(abs(mean[0]), abs(mean[1])), abs(mean[2]));
    vfloat low[3], high[3];
    for (int k = 0; k < 3; ++k) {
      // hypot, without overflow of the squares
      const vfloat a = abs(u[k] * s.scale_u), b = abs(v[k] * s.scale_v), larger = max(a, b);
      const vfloat ratio = min(a, b) / max(larger, broadcast(1e-37f));
      const vfloat half = radius * larger * sqrt(1.f + ratio * ratio);
      const vfloat padded = half * 1.00002f + (magnitude + half) * kBoxPadding;
      low[k] = select(s.hittable, mean[k] - padded, broadcast(3.4e38f));
      high[k] = select(s.hittable, mean[k] + padded, broadcast(-3.4e38f));
    }
    const int64_t lanes = in.count - first < kLanes ? in.count - first : kLanes;
    for (int lane = 0; lane < lanes; ++lane) {
      SurfelBox& box = boxes[first + lane];
      for (int k = 0; k < 3; ++k) box.low[k] = low[k][lane], box.high[k] = high[k][lane];
      box.low[3] = box.high[3] = 0.f;
    }
  });
}

}  // namespace rtgs::RTGS_ISA
