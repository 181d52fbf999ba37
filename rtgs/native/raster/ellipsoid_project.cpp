// World to screen: one record, one tile rectangle and one depth per ellipsoid.
#include "common/parallel.h"
#include "raster/ellipsoid_geometry.h"

namespace rtgs::RTGS_ISA {
namespace {

using Record = EllipsoidRecord;

struct Projection {
  vfloat fields[Record::kChannels], depth;
  TileBox tiles;
  uint32_t visible;  // bit per lane
};

Projection project_lanes(const RasterCamera& camera, const EllipsoidSettings& settings, const EllipsoidGeometry& g) {
  Projection out;
  vmask keep = g.finite_inputs & gt(g.p.z, broadcast(camera.near)) & ge(g.opacity, broadcast(camera.min_alpha));
  for (const vfloat& scale : g.scales) keep = keep & gt(scale, broadcast(0.f));
  const vfloat opacity = g.opacity * g.compensation;
  const vfloat log_opacity = log2(select(keep, opacity, broadcast(1.f)));
  const vfloat exact = (log_opacity - camera.log2_min_alpha) * (1.f / kHalfLog2E);
  const vfloat reach = max(min(exact, broadcast(settings.largest_radius)), broadcast(0.f));
  const vfloat xx = reach * g.xx, yy = reach * g.yy;
  vfloat bound[kBoundFields];
  conditional_form(xx, yy, reach * g.xy, reach * reach * g.det_dilated, bound);
  const vfloat half_x = sqrt(widened(xx)), half_y = sqrt(widened(yy));
  out.tiles = TileBox(camera, g.mean_x - half_x, g.mean_x + half_x, g.mean_y - half_y, g.mean_y + half_y);
  keep = keep & out.tiles.meets & ge(opacity, broadcast(camera.min_alpha));
  out.depth = g.p.z;
  const vfloat fields[Record::kChannels] = {
      g.mean_x, g.mean_y, g.l0 * kSqrtHalfLog2E, g.l1 * kSqrtHalfLog2E, g.l2 * kSqrtHalfLog2E, log_opacity,
      bound[0], bound[1], bound[2], bound[3], bound[4], bound[5]};
  for (int k = 0; k < Record::kChannels; ++k) {
    out.fields[k] = fields[k];
    keep = keep & finite(fields[k]);
  }
  out.visible = mask_bits(keep);
  return out;
}

void write_channels(const RecordLayout& layout, const float* features, int count, float depth, float* channels) {
  for (int k = 0; k < count; ++k) channels[k] = features[k];
  if (layout.depth) channels[count++] = depth;
  for (int k = count; k < layout.padded_channels; ++k) channels[k] = 0.f;
}

}  // namespace

void project_ellipsoids(const RasterCamera& camera, const EllipsoidSettings& settings, const GaussianArrays& in,
                        const ProjectedGaussians& out, int threads) {
  const RecordLayout layout = out.layout;
  const int64_t groups = (in.count + kLanes - 1) / kLanes;
  each_in_shares(threads, groups, [&](int64_t group) {
    const int64_t first = group * kLanes;
    const int lanes = int(in.count - first < kLanes ? in.count - first : kLanes);
    const Projection p = project_lanes(camera, settings, ellipsoid_geometry(camera, settings, in, first));
    float* records = out.records + first * layout.record_stride;
    vfloat fields[row_registers<Record::kChannels>];
    for (int k = 0; k < Record::kChannels; ++k) fields[k] = p.fields[k];
    store_long_rows<Record::kChannels>(records, layout.record_stride, fields);  // the memory has room for a whole group
    store(out.depths + first, p.depth);
    for (int lane = 0; lane < lanes; ++lane) {
      const float* features = in.features + (first + lane) * in.channels;
      const bool visible = (p.visible >> lane & 1) && all_finite(features, in.channels);
      out.rects[first + lane] = visible ? p.tiles.rect(lane) : kNoTiles;
      if (visible)
        write_channels(layout, features, in.channels, p.depth[lane],
                       records + lane * layout.record_stride + Record::kChannels);
    }
  });
}

}  // namespace rtgs::RTGS_ISA
