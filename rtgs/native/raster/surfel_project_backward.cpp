// From the sums over a surfel's pixels to the gradients of its parameters: the chain rule of surfel_project.cpp.
#include "common/parallel.h"
#include "raster/surfel_geometry.h"

namespace rtgs::RTGS_ISA {
namespace {

struct ParameterGradients {
  vec3 mean, tangent_u, tangent_v;
  vfloat scale_u, scale_v, opacity, probe_x, probe_y;
};

void saturate(ParameterGradients& g) {
  g.mean = saturated(g.mean);
  g.tangent_u = saturated(g.tangent_u);
  g.tangent_v = saturated(g.tangent_v);
  g.scale_u = saturated(g.scale_u);
  g.scale_v = saturated(g.scale_v);
  g.opacity = saturated(g.opacity);
  g.probe_x = saturated(g.probe_x);
  g.probe_y = saturated(g.probe_y);
}

ParameterGradients chain_rule(const RasterCamera& camera, const SurfelGeometry& g, const RecordLayout& layout,
                              const GradientRows& rows) {
  vfloat sums[row_registers<kGradChannels>];
  rows.fields<kGradChannels>(sums);
  const vfloat to_u = sums[kGradU], to_v = sums[kGradV], to_d = sums[kGradD];
  const int depth_field = kGradChannels + layout.padded_channels;
  const vfloat to_inverse = layout.depth ? rows.field(depth_field) : broadcast(0.f);
  const vfloat to_centre_depth = layout.depth ? rows.field(depth_field + 1) : broadcast(0.f);
  // Projected centre: moves every d, in the plane branch and in the disc.
  const vfloat to_mean_x = to_u * g.c[0] + to_v * g.c[2] - to_d * g.c[4] + camera.low_pass * sums[kGradDiscX];
  const vfloat to_mean_y = to_u * g.c[1] + to_v * g.c[3] - to_d * g.c[5] + camera.low_pass * sums[kGradDiscY];
  // Coefficients, undoing their normalisation.
  const float ix = 1.f / camera.fx, iy = 1.f / camera.fy;
  const vfloat zero = broadcast(0.f), fx = g.factor * ix, fy = g.factor * iy;
  const vec3 to_pb = {sums[kGradUx] * fx, sums[kGradUy] * fy, zero};
  const vec3 to_pa = {-(sums[kGradVx] * fx), -(sums[kGradVy] * fy), zero};
  const vfloat to_d0 = (to_d + g.p.z * to_inverse) * g.factor;
  vec3 to_n = {sums[kGradDx] * fx, sums[kGradDy] * fy, zero};
  to_n = to_n + (to_d0 * g.inverse_z) * g.p;
  const vec3 to_a = cross(to_pa, g.p) + cross(g.b, to_n);
  const vec3 to_b = cross(to_pb, g.p) + cross(to_n, g.a);
  vec3 to_p = cross(g.a, to_pa) + cross(g.b, to_pb) + (to_d0 * g.inverse_z) * g.n;
  to_p.x += to_mean_x * camera.fx * g.inverse_z;
  to_p.y += to_mean_y * camera.fy * g.inverse_z;
  to_p.z += g.c[6] * to_inverse + to_centre_depth -
            g.inverse_z * (to_d0 * dot(g.n, g.p) * g.inverse_z +
                           (to_mean_x * camera.fx * g.p.x + to_mean_y * camera.fy * g.p.y) * g.inverse_z);

  ParameterGradients out;
  out.mean = rotate_back(camera.rotation, to_p);
  const vec3 a_world = rotate_back(camera.rotation, to_a), b_world = rotate_back(camera.rotation, to_b);
  out.scale_u = dot(a_world, g.tangent_u);
  out.scale_v = dot(b_world, g.tangent_v);
  out.tangent_u = g.scale_u * a_world;
  out.tangent_v = g.scale_v * b_world;
  if (layout.normal) {
    const int first = kGradChannels + layout.channels - 3;
    const vfloat sign = normal_sign(g);
    const vec3 to_normal = sign * vec3{rows.field(first), rows.field(first + 1), rows.field(first + 2)};
    out.tangent_u = out.tangent_u + cross(g.tangent_v, to_normal);
    out.tangent_v = out.tangent_v + cross(to_normal, g.tangent_u);
  }
  out.opacity = sums[kGradLogAlpha] / g.opacity;
  const float half_width = 0.5f * float(camera.width), half_height = 0.5f * float(camera.height);
  if (layout.absolute) {
    out.probe_x = rows.field(layout.gradient_sums - 2) * half_width;
    out.probe_y = rows.field(layout.gradient_sums - 1) * half_height;
  } else {
    out.probe_x = to_p.x * g.p.z * (half_width / camera.fx);
    out.probe_y = to_p.y * g.p.z * (half_height / camera.fy);
  }
  return out;
}

}  // namespace

void mend_wide_scales(const ProjectBackwardArgs&, const GradientRows&);  // surfel_wide_scales.cpp

void project_backward(const ProjectBackwardArgs& args) {
  const RecordLayout& layout = args.gaussians.layout;
  const GaussianArrays& in = args.inputs;
  const GaussianGradients& out = args.out;
  const int64_t groups = (in.count + kLanes - 1) / kLanes;
  each_in_shares(args.threads, groups, [&](int64_t group) {
    const GradientRows rows(args, group * kLanes);
    const SurfelGeometry g = surfel_geometry(args.camera, in, rows.first);
    ParameterGradients p = chain_rule(args.camera, g, layout, rows);
    if (args.saturate) saturate(p);
    rows.write(out.means, p.mean);
    rows.write(out.tangent_u, p.tangent_u);
    rows.write(out.tangent_v, p.tangent_v);
    rows.write<2>(out.scales, {p.scale_u, p.scale_v});
    if (out.scales) mend_wide_scales(args, rows);
    rows.write<1>(out.opacities, {p.opacity});
    rows.write<2>(out.screen_probe, {p.probe_x, p.probe_y});
    rows.write_features(out.features, in.channels, kGradChannels);
  });
}

}  // namespace rtgs::RTGS_ISA
