// From the sums over an ellipsoid's pixels to the gradients of its parameters: the chain rule of ellipsoid_geometry.h.
#include "common/parallel.h"
#include "raster/ellipsoid_geometry.h"

namespace rtgs::RTGS_ISA {
namespace {

using Sums = EllipsoidSums;

struct ParameterGradients {
  vec3 mean, tangent_u, tangent_v;
  vfloat scales[3], opacity, probe[2];
};

void saturate(ParameterGradients& g) {
  g.mean = saturated(g.mean);
  g.tangent_u = saturated(g.tangent_u);
  g.tangent_v = saturated(g.tangent_v);
  for (vfloat& scale : g.scales) scale = saturated(scale);
  g.opacity = saturated(g.opacity);
  for (vfloat& probe : g.probe) probe = saturated(probe);
}

// dL/d row_x and dL/d row_y, the projected axes. With S the dilated covariance, S^-1 = L L^T and w = L^T d,
// dL/dS = L sum(g w w^T) L^T / 2; dL/dM = 2 dL/dS M, where L^T M has no element above 1.
struct RowGradients {
  vec3 x, y;
};
RowGradients to_rows(const EllipsoidGeometry& g, const vfloat* sums) {
  const vfloat to_log = where(g.compensates, sums[Sums::kLogAlpha]);  // of the antialiased opacity: ln(det / det S) / 2
  const vfloat k00 = sums[Sums::kW00] * (1.f / kHalfLog2E) - to_log, k01 = sums[Sums::kW01] * (1.f / kHalfLog2E);
  const vfloat k11 = sums[Sums::kW11] * (1.f / kHalfLog2E) - to_log;
  const vec3 v0 = g.l0 * g.row_x, v1 = g.l1 * g.row_x + g.l2 * g.row_y;
  const vec3 to_v0 = k00 * v0 + k01 * v1, to_v1 = k01 * v0 + k11 * v1;
  const vfloat by_det = where(g.compensates, to_log / select(g.compensates, g.det, broadcast(1.f)));
  return {g.l0 * to_v0 + g.l1 * to_v1 + by_det * cross(g.row_y, g.minors),
          g.l2 * to_v1 + by_det * cross(g.minors, g.row_x)};
}

ParameterGradients chain_rule(const RasterCamera& camera, const EllipsoidGeometry& g, const RecordLayout& layout,
                              const GradientRows& rows, int features) {
  vfloat sums[row_registers<Sums::kChannels>];
  rows.fields<Sums::kChannels>(sums);
  const vfloat w0 = sums[Sums::kW0] * (1.f / kSqrtHalfLog2E), w1 = sums[Sums::kW1] * (1.f / kSqrtHalfLog2E);
  const vfloat to_mean_x = g.l0 * w0 + g.l1 * w1, to_mean_y = g.l2 * w1;
  const RowGradients to_row = to_rows(g, sums);

  ParameterGradients out;
  const vfloat sx = camera.fx * g.inverse_z, sy = camera.fy * g.inverse_z;
  const vfloat by_x[] = {sx * to_row.x.x, sx * to_row.x.y, sx * to_row.x.z};
  const vfloat by_y[] = {sy * to_row.y.x, sy * to_row.y.y, sy * to_row.y.z};
  vfloat to_ray_x = broadcast(0.f), to_ray_y = broadcast(0.f);
  vec3 to_axis[3];  // world, not scaled
  for (int k = 0; k < 3; ++k) {
    const vec3 to_scaled = {by_x[k], by_y[k], -(g.ray_x * by_x[k] + g.ray_y * by_y[k])};
    const vec3 world = rotate_back(camera.rotation, to_scaled);
    out.scales[k] = dot(world, g.axes[k]);
    to_axis[k] = g.scales[k] * world;
    to_ray_x = to_ray_x - by_x[k] * g.scaled[k].z;
    to_ray_y = to_ray_y - by_y[k] * g.scaled[k].z;
  }
  out.tangent_u = to_axis[0] + cross(g.axes[1], to_axis[2]);
  out.tangent_v = to_axis[1] + cross(to_axis[2], g.axes[0]);

  // Through x/z and y/z: the projected centre always, the Jacobian where its clamp does not bind.
  const vfloat to_x = camera.fx * to_mean_x + where(g.follows_x, to_ray_x);
  const vfloat to_y = camera.fy * to_mean_y + where(g.follows_y, to_ray_y);
  vec3 to_p = {to_x * g.inverse_z, to_y * g.inverse_z, broadcast(0.f)};
  to_p.z = -g.inverse_z * (to_p.x * g.p.x + to_p.y * g.p.y + dot(to_row.x, g.row_x) + dot(to_row.y, g.row_y));
  if (layout.depth) to_p.z = to_p.z + rows.field(Sums::kChannels + features);
  out.mean = rotate_back(camera.rotation, to_p);
  out.opacity = sums[Sums::kLogAlpha] / g.opacity;
  vfloat probe_x = to_mean_x, probe_y = to_mean_y;
  if (layout.absolute) {
    probe_x = rows.field(layout.gradient_sums - 2) * (1.f / kHalfLog2E);
    probe_y = rows.field(layout.gradient_sums - 1) * (1.f / kHalfLog2E);
  }
  out.probe[0] = probe_x * (0.5f * float(camera.width));
  out.probe[1] = probe_y * (0.5f * float(camera.height));
  return out;
}

}  // namespace

void project_ellipsoids_backward(const ProjectBackwardArgs& args, const EllipsoidSettings& settings) {
  const GaussianArrays& in = args.inputs;
  const GaussianGradients& out = args.out;
  const int64_t groups = (in.count + kLanes - 1) / kLanes;
  each_in_shares(args.threads, groups, [&](int64_t group) {
    const GradientRows rows(args, group * kLanes);
    const EllipsoidGeometry g = ellipsoid_geometry(args.camera, settings, in, rows.first);
    ParameterGradients p = chain_rule(args.camera, g, args.gaussians.layout, rows, in.channels);
    if (args.saturate) saturate(p);
    rows.write(out.means, p.mean);
    rows.write(out.tangent_u, p.tangent_u);
    rows.write(out.tangent_v, p.tangent_v);
    rows.write(out.scales, p.scales);
    rows.write<1>(out.opacities, {p.opacity});
    rows.write(out.screen_probe, p.probe);
    rows.write_features(out.features, in.channels, Sums::kChannels);
  });
}

}  // namespace rtgs::RTGS_ISA
