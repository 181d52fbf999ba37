// Camera-frame geometry of kLanes surfels (docs/rasterizer.md, "Per surfel"), shared by projection and its backward.
#pragma once
#include "raster/project_rows.h"
#include "raster/surfels.h"

namespace rtgs::RTGS_ISA {

struct SurfelGeometry {
  vec3 tangent_u, tangent_v;       // world
  vfloat scale_u, scale_v, opacity;
  vec3 p, a, b;                    // camera frame: centre, scaled tangents
  vec3 pa, pb, n;                  // p x a, p x b, a x b
  vfloat inverse_z, mean_x, mean_y;
  vfloat c[7];                     // ux uy vx vy dx dy d0, divided by their largest magnitude, d0 >= 0
  vfloat factor;                   // what they were multiplied by (its sign is that of det A)
  vmask finite_inputs, faces_away;  // faces away: the normal tangent_u x tangent_v points away from the camera
};

static inline vfloat normal_sign(const SurfelGeometry& g) {
  return select(g.faces_away, broadcast(-1.f), broadcast(1.f));
}

static inline SurfelGeometry surfel_geometry(const RasterCamera& camera, const GaussianArrays& in, int64_t first) {
  SurfelGeometry g;
  RowReader rows(first, in.count);
  const vec3 mean = rows.vector(in.means, first);
  g.tangent_u = rows.vector(in.tangent_u, first);
  g.tangent_v = rows.vector(in.tangent_v, first);
  vfloat scales[2];
  rows.components(in.scales, first, scales);
  g.scale_u = scales[0];
  g.scale_v = scales[1];
  g.opacity = rows.component(in.opacities, 1, first, 0);
  g.finite_inputs = finite(g.opacity) & finite(g.scale_u) & finite(g.scale_v) & finite(mean) & finite(g.tangent_u) &
                    finite(g.tangent_v);

  const float* t = camera.translation;
  g.p = rotate(camera.rotation, mean) + vec3{broadcast(t[0]), broadcast(t[1]), broadcast(t[2])};
  g.a = g.scale_u * rotate(camera.rotation, g.tangent_u);
  g.b = g.scale_v * rotate(camera.rotation, g.tangent_v);
  g.inverse_z = 1.f / g.p.z;
  g.mean_x = camera.fx * (g.p.x * g.inverse_z) + camera.cx;
  g.mean_y = camera.fy * (g.p.y * g.inverse_z) + camera.cy;
  g.pa = cross(g.p, g.a);
  g.pb = cross(g.p, g.b);
  g.n = cross(g.a, g.b);
  // adj(A), adj(A)^T e and det A of the page, times z^2 / (fx fy): no division, finite for edge-on surfels.
  const float ix = 1.f / camera.fx, iy = 1.f / camera.fy;
  g.c[0] = g.pb.x * -ix;
  g.c[1] = g.pb.y * -iy;
  g.c[2] = g.pa.x * ix;
  g.c[3] = g.pa.y * iy;
  g.c[4] = g.n.x * ix;
  g.c[5] = g.n.y * iy;
  g.c[6] = dot(g.n, g.p) * g.inverse_z;
  vfloat largest = abs(g.c[6]);
  for (int k = 0; k < 6; ++k) largest = max(largest, abs(g.c[k]));
  g.factor = 1.f / max(largest, broadcast(1e-37f));
  g.faces_away = gt(g.c[6], broadcast(0.f));
  g.factor = select(lt(g.c[6], broadcast(0.f)), -g.factor, g.factor);
  for (int k = 0; k < 7; ++k) g.c[k] = g.c[k] * g.factor;
  return g;
}

}  // namespace rtgs::RTGS_ISA
