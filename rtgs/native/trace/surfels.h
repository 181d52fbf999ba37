// What of a surfel does not depend on the ray, kLanes surfels at a time: for boxes, records and the chain rule.
#pragma once
#include "raster/project_rows.h"

namespace rtgs::RTGS_ISA {

// Distance by which rounding may move a hit off its surfel's plane, as a part of its distance from the world's origin.
constexpr float kBoxPadding = 2e-6f;

struct SurfelLanes {
  vec3 mean, tangent_u, tangent_v, normal;  // normal = tangent_u x tangent_v, as long as it comes
  vfloat scale_u, scale_v, opacity;
  vfloat log_opacity;  // log2
  vfloat reach;        // a hit counts where rho <= reach; -1 where the surfel is left out
  vmask hittable;
  vint row;            // lanes past the last surfel repeat it

  SurfelLanes(const SurfelArrays& in, int64_t first, float alpha_cutoff) {
    const RowReader rows(first, in.count);
    row = rows.row + int32_t(first);
    mean = rows.vector(in.means, first);
    tangent_u = rows.vector(in.tangent_u, first);
    tangent_v = rows.vector(in.tangent_v, first);
    scale_u = rows.component(in.scales, 2, first, 0);
    scale_v = rows.component(in.scales, 2, first, 1);
    opacity = rows.component(in.opacities, 1, first, 0);
    normal = cross(tangent_u, tangent_v);
    hittable = finite(opacity) & finite(scale_u) & finite(scale_v) & gt(scale_u, broadcast(0.f)) &
               gt(scale_v, broadcast(0.f)) & ge(opacity, broadcast(alpha_cutoff));
    const vec3 vectors[] = {mean, tangent_u, tangent_v, normal};
    for (const vec3& v : vectors) hittable = hittable & finite(v.x) & finite(v.y) & finite(v.z);
    // Opacity over the cut near 1 loses digits as a difference of logarithms; it is only compared with rho.
    log_opacity = log2(select(hittable, opacity, broadcast(1.f)));
    const vfloat over_cut = select(hittable, opacity, broadcast(alpha_cutoff)) / alpha_cutoff;
    reach = select(hittable, max(log2(over_cut), broadcast(0.f)) * (1.f / kHalfLog2E), broadcast(-1.f));
  }

  // Box of the part where alpha reaches the cut, empty for what is never hit. Padded so that a hit which the tracer
  // accepts lies inside in spite of rounding: in the plane of the surfel by a part of its extent, off the plane by a
  // part of its distance from the world's origin (the tracer pads by the ray's own).
  void bound(vfloat* low, vfloat* high) const {
    const vfloat radius = sqrt(max(reach, broadcast(0.f)));
    const vfloat m[] = {mean.x, mean.y, mean.z};
    const vfloat u[] = {tangent_u.x, tangent_u.y, tangent_u.z}, v[] = {tangent_v.x, tangent_v.y, tangent_v.z};
    const vfloat magnitude = max(max(abs(m[0]), abs(m[1])), abs(m[2]));
    for (int k = 0; k < 3; ++k) {
      // hypot, without overflow of the squares
      const vfloat a = abs(u[k] * scale_u), b = abs(v[k] * scale_v), larger = max(a, b);
      const vfloat ratio = min(a, b) / max(larger, broadcast(1e-37f));
      const vfloat half = radius * larger * sqrt(1.f + ratio * ratio);
      const vfloat padded = half * 1.00002f + (magnitude + half) * kBoxPadding;
      low[k] = select(hittable, m[k] - padded, broadcast(3.4e38f));
      high[k] = select(hittable, m[k] + padded, broadcast(-3.4e38f));
    }
  }
};

}  // namespace rtgs::RTGS_ISA
