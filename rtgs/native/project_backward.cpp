// From the sums over a surfel's pixels to the gradients of its parameters: the chain rule of project_kernels.cpp.
#include "project_geometry.h"

namespace rtgs::RTGS_ISA {
namespace {

// kLanes gradient rows as registers: field k of every surfel in one register.
struct Rows {
  alignas(64) float staged[kLanes][kGradChannels + 36 + 2 + 16];
  vfloat field(int k) const {
    vfloat v;
    for (int lane = 0; lane < kLanes; ++lane) v[lane] = staged[lane][k];
    return v;
  }
};

// Moves a surfel's row out, and leaves zeros for the next call.
void take_row(const RecordLayout& layout, float* from, float* row) {
  for (int k = 0; k < layout.gradient_stride; k += kLanes) {
    store(row + k, load(from + k));
    store(from + k, broadcast(0.f));
  }
}

struct ParameterGradients {
  vec3 mean, tangent_u, tangent_v;
  vfloat scale_u, scale_v, opacity, probe_x, probe_y;
};

vfloat saturated(vfloat v) {  // infinite: the largest float of that sign; NaN, from infinities that cancel: 0
  const vfloat zero = broadcast(0.f), largest = broadcast(3e38f);
  return select(finite(v), v, select(gt(v, zero), largest, where(lt(v, zero), -largest)));
}
vec3 saturated(vec3 v) { return {saturated(v.x), saturated(v.y), saturated(v.z)}; }

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
                              const Rows& rows) {
  const vfloat to_u = rows.field(kGradU), to_v = rows.field(kGradV), to_d = rows.field(kGradD);
  const int depth_field = kGradChannels + layout.padded_channels;
  const vfloat to_inverse = layout.depth ? rows.field(depth_field) : broadcast(0.f);
  const vfloat to_centre_depth = layout.depth ? rows.field(depth_field + 1) : broadcast(0.f);
  // Projected centre: moves every d, in the plane branch and in the disc.
  const vfloat to_mean_x = to_u * g.c[0] + to_v * g.c[2] - to_d * g.c[4] + 2.f * rows.field(kGradDiscX);
  const vfloat to_mean_y = to_u * g.c[1] + to_v * g.c[3] - to_d * g.c[5] + 2.f * rows.field(kGradDiscY);
  // Coefficients, undoing their normalisation.
  const float ix = 1.f / camera.fx, iy = 1.f / camera.fy;
  const vfloat zero = broadcast(0.f), fx = g.factor * ix, fy = g.factor * iy;
  const vec3 to_pb = {rows.field(kGradUx) * fx, rows.field(kGradUy) * fy, zero};
  const vec3 to_pa = {-(rows.field(kGradVx) * fx), -(rows.field(kGradVy) * fy), zero};
  const vfloat to_d0 = (to_d + g.p.z * to_inverse) * g.factor;
  vec3 to_n = {rows.field(kGradDx) * fx, rows.field(kGradDy) * fy, zero};
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
  out.opacity = rows.field(kGradLogAlpha) / g.opacity;
  out.probe_x = to_p.x * g.p.z * (0.5f * float(camera.width) / camera.fx);
  out.probe_y = to_p.y * g.p.z * (0.5f * float(camera.height) / camera.fy);
  return out;
}

void write_vector(float* out, int64_t id, const vec3& v, int lane, bool visible) {
  if (!out) return;
  out[3 * id] = visible ? v.x[lane] : 0.f;
  out[3 * id + 1] = visible ? v.y[lane] : 0.f;
  out[3 * id + 2] = visible ? v.z[lane] : 0.f;
}
void write_pair(float* out, int64_t id, vfloat x, vfloat y, int lane, bool visible) {
  if (!out) return;
  out[2 * id] = visible ? x[lane] : 0.f;
  out[2 * id + 1] = visible ? y[lane] : 0.f;
}

}  // namespace

void project_backward(const ProjectBackwardArgs& args) {
  const RecordLayout& layout = args.surfels.layout;
  const SurfelArrays& in = args.inputs;
  const SurfelGradients& out = args.out;
  const int64_t groups = (in.count + kLanes - 1) / kLanes;
#pragma omp parallel for num_threads(args.threads) schedule(static) if (args.threads > 1)
  for (int64_t group = 0; group < groups; ++group) {
    const int64_t first = group * kLanes;
    const int lanes = int(in.count - first < kLanes ? in.count - first : kLanes);
    Rows rows;
    bool visible[kLanes] = {};
    for (int lane = 0; lane < kLanes; ++lane) {
      visible[lane] = lane < lanes && args.surfels.rects[first + lane].tiles() > 0;
      float* row = rows.staged[lane];
      if (visible[lane]) take_row(layout, args.rows + (first + lane) * layout.gradient_stride, row);
      else memset(row, 0, layout.gradient_stride * sizeof(float));
      if (args.saturate)
        for (int k = 0; k < layout.gradient_stride; k += kLanes) store(row + k, saturated(load(row + k)));
    }
    const SurfelGeometry g = surfel_geometry(args.camera, in, first);
    ParameterGradients p = chain_rule(args.camera, g, layout, rows);
    if (args.saturate) saturate(p);
    for (int lane = 0; lane < lanes; ++lane) {
      const int64_t id = first + lane;
      const bool seen = visible[lane];
      write_vector(out.means, id, p.mean, lane, seen);
      write_vector(out.tangent_u, id, p.tangent_u, lane, seen);
      write_vector(out.tangent_v, id, p.tangent_v, lane, seen);
      write_pair(out.scales, id, p.scale_u, p.scale_v, lane, seen);
      write_pair(out.screen_probe, id, p.probe_x, p.probe_y, lane, seen);
      if (out.opacities) out.opacities[id] = seen ? p.opacity[lane] : 0.f;
      if (out.features)
        memcpy(out.features + id * in.channels, rows.staged[lane] + kGradChannels, in.channels * sizeof(float));
    }
  }
}

}  // namespace rtgs::RTGS_ISA
