// Scale gradients of surfels much wider than the picture, in a file of its own: the compiler rounds the chain rule of
// all others (surfel_project_backward.cpp) as it did without this.
#include "raster/surfel_geometry.h"

namespace rtgs::RTGS_ISA {
namespace {

// A standard deviation of more than four pictures: in all pixels u or v is small, and of the chain rule's sum over the
// coefficients, whose terms stay as they are, next to nothing is left. Below it float32 holds the sum to 1e-5.
vmask wider_than_pictures(const RasterCamera& camera, const SurfelGeometry& g, vec3 axis) {
  const float fx = camera.fx / float(camera.width), fy = camera.fy / float(camera.height);
  const float pictures = 0.25f * (fx < fy ? fx : fy);
  return gt(pictures * pictures * dot(axis, axis), g.p.z * g.p.z);
}

}  // namespace

// Scale gradients of such surfels without that sum: s_u moves no plane, so of the hit it changes u alone, as 1/s_u.
// Hence dL/ds_u is the sum over the pixels of dL/d ln(alpha_raw) u^2 / s_u, which is linear in the sums that there are.
void mend_wide_scales(const ProjectBackwardArgs& args, const GradientRows& rows) {
  const SurfelGeometry g = surfel_geometry(args.camera, args.inputs, rows.first);
  const vmask wide_u = wider_than_pictures(args.camera, g, g.a), wide_v = wider_than_pictures(args.camera, g, g.b);
  if (!any((wide_u | wide_v) & rows.visible)) return;
  vfloat sums[row_registers<kGradChannels>];
  rows.fields<kGradChannels>(sums);
  const vfloat scale_u = (g.c[0] * sums[kGradUx] + g.c[1] * sums[kGradUy]) / g.scale_u;
  const vfloat scale_v = (g.c[2] * sums[kGradVx] + g.c[3] * sums[kGradVy]) / g.scale_v;
  for (int lane = 0; lane < rows.lanes; ++lane) {
    float* out = args.out.scales + (rows.first + lane) * 2;
    if (mask_bits(wide_u & rows.visible) >> lane & 1) out[0] = (args.saturate ? saturated(scale_u) : scale_u)[lane];
    if (mask_bits(wide_v & rows.visible) >> lane & 1) out[1] = (args.saturate ? saturated(scale_v) : scale_v)[lane];
  }
}

}  // namespace rtgs::RTGS_ISA
