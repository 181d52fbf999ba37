// Projection of kLanes ellipsoids (docs/rasterizer.md, "Ellipsoids"), shared by forward and backward.
#pragma once
#include "raster/project_rows.h"
#include "raster/ellipsoids.h"

namespace rtgs::RTGS_ISA {

constexpr float kFieldMargin = 0.15f;            // of the width: where the Jacobian stops following, on each side
constexpr float kCompensationFloor = 2.5e-5f;    // of det / det dilated in the antialiased opacity

struct EllipsoidGeometry {
  vec3 axes[3];  // world, not scaled; the third is the cross product of the others
  vfloat scales[3], opacity;
  vec3 p, scaled[3];  // camera frame: centre, scaled axes
  vfloat inverse_z, mean_x, mean_y;
  vfloat ray_x, ray_y;      // x/z, y/z, clamped
  vmask follows_x, follows_y;  // where the clamp does not bind
  vec3 row_x, row_y, minors;  // of the projected axes; minors = row_x x row_y, det of the covariance is its square
  vfloat det, det_dilated;    // without and with dilation
  vfloat xx, yy, xy;        // dilated covariance
  vfloat l0, l1, l2;        // Cholesky factor of its inverse, in standard deviations per pixel
  vfloat compensation;      // antialiasing factor of the opacity
  vmask compensates;        // where it has a gradient
  vmask finite_inputs;
};

static inline vfloat clamped_ray(vfloat ray, float low, float high, vmask& follows) {
  follows = ge(ray, broadcast(low)) & ge(broadcast(high), ray);
  return clamp(ray, low, high);
}

static inline EllipsoidGeometry ellipsoid_geometry(const RasterCamera& camera, const EllipsoidSettings& settings,
                                                   const GaussianArrays& in, int64_t first) {
  EllipsoidGeometry g;
  const RowReader rows(first, in.count);
  const vec3 mean = rows.vector(in.means, first);
  g.axes[0] = rows.vector(in.tangent_u, first);
  g.axes[1] = rows.vector(in.tangent_v, first);
  g.axes[2] = cross(g.axes[0], g.axes[1]);
  rows.components(in.scales, first, g.scales);
  g.opacity = rows.component(in.opacities, 1, first, 0);
  g.finite_inputs = finite(g.opacity) & finite(mean) & finite(g.axes[0]) & finite(g.axes[1]) & finite(g.scales[0]) &
                    finite(g.scales[1]) & finite(g.scales[2]);

  const float* t = camera.translation;
  g.p = rotate(camera.rotation, mean) + vec3{broadcast(t[0]), broadcast(t[1]), broadcast(t[2])};
  g.inverse_z = 1.f / g.p.z;
  const vfloat x = g.p.x * g.inverse_z, y = g.p.y * g.inverse_z;
  g.mean_x = camera.fx * x + camera.cx;
  g.mean_y = camera.fy * y + camera.cy;
  const float margin_x = kFieldMargin * float(camera.width), margin_y = kFieldMargin * float(camera.height);
  g.ray_x = clamped_ray(x, (-camera.cx - margin_x) / camera.fx, (float(camera.width) - camera.cx + margin_x) / camera.fx,
                        g.follows_x);
  g.ray_y = clamped_ray(y, (-camera.cy - margin_y) / camera.fy, (float(camera.height) - camera.cy + margin_y) / camera.fy,
                        g.follows_y);
  const vfloat sx = camera.fx * g.inverse_z, sy = camera.fy * g.inverse_z;
  vfloat row_x[3], row_y[3];
  for (int k = 0; k < 3; ++k) {
    g.scaled[k] = g.scales[k] * rotate(camera.rotation, g.axes[k]);
    row_x[k] = sx * (g.scaled[k].x - g.ray_x * g.scaled[k].z);
    row_y[k] = sy * (g.scaled[k].y - g.ray_y * g.scaled[k].z);
  }
  g.row_x = {row_x[0], row_x[1], row_x[2]};
  g.row_y = {row_y[0], row_y[1], row_y[2]};
  g.minors = cross(g.row_x, g.row_y);
  g.det = dot(g.minors, g.minors);
  const vfloat own_x = dot(g.row_x, g.row_x), own_y = dot(g.row_y, g.row_y);
  g.xx = own_x + settings.dilation;
  g.yy = own_y + settings.dilation;
  g.xy = dot(g.row_x, g.row_y);
  g.det_dilated = g.det + settings.dilation * (own_x + own_y) + settings.dilation * settings.dilation;
  g.l0 = sqrt(1.f / g.xx);
  g.l2 = sqrt(g.xx / g.det_dilated);
  g.l1 = -(g.xy / g.xx) * g.l2;
  const vfloat ratio = g.det / g.det_dilated, floor = broadcast(kCompensationFloor);
  g.compensates = settings.antialiased ? gt(ratio, floor) : first_lanes(0);
  g.compensation = settings.antialiased ? sqrt(select(g.compensates, ratio, floor)) : broadcast(1.f);
  return g;
}

}  // namespace rtgs::RTGS_ISA
