// World to screen: one record, one tile rectangle and one depth per surfel.
#include "common/parallel.h"
#include "raster/surfel_geometry.h"

namespace rtgs::RTGS_ISA {
namespace {

// Where a surfel can show: an axis-aligned box and, for the test of a block of pixels, its ellipse in conditional form.
struct ScreenBound {
  vfloat left, right, top, bottom;  // pixels
  vfloat centre_x, centre_y, conditional[kBoundFields], disc2;
};

// Bound of a circle that meets the camera plane, where only what lies beyond `near` shows: a rectangle of the plane,
// one side along the steepest change of z, holds that part; the box of its four projected corners holds the picture.
void bound_cut_circle(const RasterCamera& camera, const SurfelGeometry& g, vfloat reach, vmask cut, ScreenBound& s) {
  const vfloat slope = max(sqrt(g.a.z * g.a.z + g.b.z * g.b.z), broadcast(1e-30f));
  const vfloat cosine = g.a.z / slope, sine = g.b.z / slope, radius = sqrt(reach) * 1.001f;
  const vec3 steep = cosine * g.a + sine * g.b, level = cosine * g.b + (-sine) * g.a;
  const vfloat nearest = max(-radius, (camera.near * 0.999f - g.p.z) / slope);
  const vfloat ends[] = {nearest, radius}, sides[] = {-radius, radius};
  for (const vfloat along : ends)
    for (const vfloat across : sides) {
      const vec3 corner = g.p + along * steep + across * level;
      const vfloat z = max(corner.z, broadcast(camera.near * 0.99f));
      const vfloat x = camera.fx * corner.x / z + camera.cx, y = camera.fy * corner.y / z + camera.cy;
      const vfloat slack_x = abs(x) * 1e-3f + 0.1f, slack_y = abs(y) * 1e-3f + 0.1f;
      s.left = select(cut, min(s.left, x - slack_x), s.left);
      s.right = select(cut, max(s.right, x + slack_x), s.right);
      s.top = select(cut, min(s.top, y - slack_y), s.top);
      s.bottom = select(cut, max(s.bottom, y + slack_y), s.bottom);
    }
}

// The circle u^2 + v^2 <= reach maps to an ellipse while it stays in front of the camera plane; its dual conic needs
// no inverse of A. Squared half-widths grow a little so that rounding never loses a pixel. Circles that meet the
// camera plane have no ellipse: they get a box, in which every block passes the test.
ScreenBound screen_bound(const RasterCamera& camera, const SurfelGeometry& g, vfloat reach) {
  ScreenBound s;
  vfloat sx = camera.fx * g.inverse_z * g.inverse_z, sy = camera.fy * g.inverse_z * g.inverse_z;
  vfloat a00 = sx * g.pa.y, a01 = sx * g.pb.y, a10 = -sy * g.pa.x, a11 = -sy * g.pb.x;
  vfloat e0 = g.a.z * g.inverse_z, e1 = g.b.z * g.inverse_z;
  vfloat margin = 1.f - reach * (e0 * e0 + e1 * e1);
  vmask bounded = gt(margin, broadcast(1e-3f));
  vfloat t = reach / select(bounded, margin, broadcast(1.f));
  vfloat x = -t * (a00 * e0 + a01 * e1), y = -t * (a10 * e0 + a11 * e1);
  vfloat xx = x * x + t * (a00 * a00 + a01 * a01), yy = y * y + t * (a10 * a10 + a11 * a11);
  vfloat xy = x * y + t * (a00 * a10 + a01 * a11);
  vfloat det = sx * camera.fy * (dot(g.n, g.p) * g.inverse_z);  // det A = fx fy n.p / z^3
  vfloat area = t * t * det * det / select(bounded, margin, broadcast(1.f));
  vfloat wide_x = widened(xx), wide_y = widened(yy);
  s.centre_x = g.mean_x + x;
  s.centre_y = g.mean_y + y;
  conditional_form(xx, yy, xy, area, s.conditional);
  const BoundField variances[] = {kInvX2, kInvY2, kInvY2GivenX, kInvX2GivenY};
  for (const BoundField k : variances) s.conditional[k] = where(bounded, s.conditional[k]);
  s.disc2 = reach * (1.0001f / camera.low_pass) + 1e-4f;
  vfloat half_x = sqrt(wide_x), half_y = sqrt(wide_y), disc = sqrt(s.disc2);
  s.left = g.mean_x + select(bounded, min(x - half_x, -disc), -disc);
  s.right = g.mean_x + select(bounded, max(x + half_x, disc), disc);
  s.top = g.mean_y + select(bounded, min(y - half_y, -disc), -disc);
  s.bottom = g.mean_y + select(bounded, max(y + half_y, disc), disc);
  if (any(mask_not(bounded))) bound_cut_circle(camera, g, reach, mask_not(bounded), s);
  return s;
}

struct Projection {
  vfloat fields[kChannels], depth_scale, depth;
  vec3 normal;          // world, facing the camera
  TileBox tiles;
  uint32_t visible;     // bit per lane
};

Projection project_lanes(const RasterCamera& camera, const SurfelGeometry& g) {
  Projection out;
  vmask keep = g.finite_inputs & gt(g.p.z, broadcast(camera.near)) & ge(g.opacity, broadcast(camera.min_alpha)) &
               gt(g.scale_u, broadcast(0.f)) & gt(g.scale_v, broadcast(0.f));
  vfloat log_opacity = log2(select(keep, g.opacity, broadcast(1.f)));
  vfloat reach = max((log_opacity - camera.log2_min_alpha) * (1.f / kHalfLog2E), broadcast(0.f));
  ScreenBound bound = screen_bound(camera, g, reach);
  out.depth = g.p.z;
  out.depth_scale = g.p.z * g.c[6];
  out.normal = normal_sign(g) * cross(g.tangent_u, g.tangent_v);
  keep = keep & finite(out.normal);
  vfloat min_inverse = select(gt(out.depth_scale, broadcast(1e-37f)),
                              camera.near / max(out.depth_scale, broadcast(1e-37f)), broadcast(3e38f));
  const vfloat fields[kChannels] = {
      g.mean_x, g.mean_y, g.c[0], g.c[1], g.c[2], g.c[3], g.c[4], g.c[5], g.c[6], log_opacity, min_inverse,
      bound.centre_x, bound.centre_y, bound.conditional[kSlopeY], bound.conditional[kSlopeX], bound.conditional[kInvX2],
      bound.conditional[kInvY2GivenX], bound.conditional[kInvY2], bound.conditional[kInvX2GivenY], bound.disc2};
  for (int k = 0; k < kChannels; ++k) {
    out.fields[k] = fields[k];
    keep = keep & finite(fields[k]);
  }
  out.tiles = TileBox(camera, bound.left, bound.right, bound.top, bound.bottom);
  keep = keep & out.tiles.meets;
  out.visible = mask_bits(keep);
  return out;
}

void write_channels(const RecordLayout& layout, const Projection& p, int lane, const float* features,
                    float* channels) {
  const int count = layout.normal ? layout.channels - 3 : layout.channels;
  for (int k = 0; k < count; ++k) channels[k] = features[k];
  for (int k = layout.channels; k < layout.padded_channels; ++k) channels[k] = 0.f;
  if (layout.normal) {
    float* normal = channels + count;
    normal[0] = p.normal.x[lane];
    normal[1] = p.normal.y[lane];
    normal[2] = p.normal.z[lane];
  }
}

}  // namespace

void project_surfels(const RasterCamera& camera, const GaussianArrays& in, const ProjectedGaussians& out, int threads) {
  const RecordLayout layout = out.layout;
  const int64_t groups = (in.count + kLanes - 1) / kLanes;
  each_in_shares(threads, groups, [&](int64_t group) {
    const int64_t first = group * kLanes;
    const int lanes = int(in.count - first < kLanes ? in.count - first : kLanes);
    SurfelGeometry g = surfel_geometry(camera, in, first);
    Projection p = project_lanes(camera, g);
    alignas(64) float fields[kChannels][kLanes];
    for (int k = 0; k < kChannels; ++k) store(fields[k], p.fields[k]);
    for (int lane = 0; lane < lanes; ++lane) {
      const int64_t id = first + lane;
      const float* features = in.features + id * in.channels;
      if (!(p.visible >> lane & 1) || !all_finite(features, in.channels)) {
        out.rects[id] = kNoTiles;
        continue;
      }
      out.rects[id] = p.tiles.rect(lane);
      out.depths[id] = p.depth[lane];
      float* record = out.records + id * layout.record_stride;
      for (int k = 0; k < kChannels; ++k) record[k] = fields[k][lane];
      write_channels(layout, p, lane, features, record + kChannels);
      float* depth = record + kChannels + layout.padded_channels;
      if (layout.depth) {
        depth[0] = p.depth_scale[lane];
        depth[1] = p.depth[lane];
      }
    }
  });
}

}  // namespace rtgs::RTGS_ISA
