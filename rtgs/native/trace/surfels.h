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
};

}  // namespace rtgs::RTGS_ISA
