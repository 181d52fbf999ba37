// From the sums over a surfel's hits to the gradients of its parameters: the chain rule of records.cpp.
#include "common/parallel.h"
#include "common/rows.h"
#include "trace/trace.h"
#include "trace/surfels.h"
#include "gaussians/harmonics.h"

namespace rtgs::RTGS_ISA {
namespace {

constexpr int kPrefetchGroups = 2;

class GradientGroup {  // kLanes surfels from row `first` on
 public:
  GradientGroup(const TraceBackwardArgs& args, const int32_t* slots, bool saturate, int64_t first)
      : args_(args), saturate_(saturate), first_(first) {
    const int64_t count = args.surfels.arrays.count;
    lanes_ = int(count - first < kLanes ? count - first : kLanes);
    for (int lane = 0; lane < lanes_; ++lane) {
      const int64_t slot = slots[first + lane];
      rows_[lane] = args.touched[slot] ? args.rows + slot * args.row_stride : nullptr;
    }
    for (int lane = lanes_; lane < kLanes; ++lane) rows_[lane] = nullptr;
  }
  void write(const TraceGradients& out);

 private:
  void load_sums();
  vec3 vector(int k) const { return {sums_[k], sums_[k + 1], sums_[k + 2]}; }
  vfloat kept(vfloat v) const { return where(met_, saturate_ ? saturated(v) : v); }
  void write_vector(float* out, vec3 v) const;
  void write_columns(float* out, int width, int from, int count, float factor) const;

  const TraceBackwardArgs& args_;
  const bool saturate_;
  const int64_t first_;
  int lanes_;
  const float* rows_[kLanes];
  vmask met_;
  vfloat sums_[kTraceGradChannels];
};

void GradientGroup::load_sums() {
  uint32_t met = 0;
  for (int c = 0; c < kTraceGradChannels; c += kLanes) {
    vfloat block[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) block[lane] = rows_[lane] ? load(rows_[lane] + c) : broadcast(0.f);
    transpose(block);
    for (int k = 0; k < kLanes; ++k) sums_[c + k] = saturate_ ? saturated(block[k]) : block[k];
  }
  for (int lane = 0; lane < kLanes; ++lane) met |= uint32_t(rows_[lane] != nullptr) << lane;
  met_ = lanes_from_bits(met);
}

void GradientGroup::write_vector(float* out, vec3 v) const {
  if (!out) return;
  const vfloat parts[3] = {kept(v.x), kept(v.y), kept(v.z)};
  if (lanes_ == kLanes) return store_rows<3>(out + 3 * first_, parts);
  for (int lane = 0; lane < lanes_; ++lane)
    for (int k = 0; k < 3; ++k) out[3 * (first_ + lane) + k] = parts[k][lane];
}

// `count` sums of each row from field `from` on, times the factor, into the first columns of a table; zeros behind.
void GradientGroup::write_columns(float* out, int width, int from, int count, float factor) const {
  if (!out) return;
  for (int lane = 0; lane < lanes_; ++lane) {
    float* to = out + (first_ + lane) * width;
    const int used = rows_[lane] ? count : 0;
    for (int c = 0; c < used; c += kLanes) {
      const vfloat v = load_first(rows_[lane] + from + c, used - c < kLanes ? used - c : kLanes) * factor;
      store_first(to + c, saturate_ ? saturated(v) : v, used - c < kLanes ? used - c : kLanes);
    }
    if (used < width) memset(to + used, 0, size_t(width - used) * sizeof(float));
  }
}

void GradientGroup::write(const TraceGradients& out) {
  load_sums();
  const TraceSurfels& surfels = args_.surfels;
  const SurfelLanes s(surfels.arrays, first_, args_.options.alpha_cutoff);
  const vec3 to_u = vector(kTraceGradU), to_v = vector(kTraceGradV), to_normal = vector(kTraceGradNormal);
  const vfloat iu = 1.f / s.scale_u, iv = 1.f / s.scale_v;
  write_vector(out.means, vector(kTraceGradMean));
  write_vector(out.probe, vector(kTraceGradProbe));
  write_vector(out.tangent_u, iu * to_u + cross(s.tangent_v, to_normal));
  write_vector(out.tangent_v, iv * to_v + cross(to_normal, s.tangent_u));
  const vfloat scale_u = kept(-(dot(to_u, s.tangent_u) * iu) * iu), scale_v = kept(-(dot(to_v, s.tangent_v) * iv) * iv);
  const vfloat opacity = kept(sums_[kTraceGradLogAlpha] / s.opacity);
  for (int lane = 0; lane < lanes_; ++lane) {
    const int64_t id = first_ + lane;
    if (out.scales) out.scales[2 * id] = scale_u[lane], out.scales[2 * id + 1] = scale_v[lane];
    if (out.opacities) out.opacities[id] = opacity[lane];
  }
  const int features = surfels.feature_count(), used = 3 * rest_count(surfels.degree);
  const int coefficients = args_.first_coefficient;
  write_columns(out.features, features, kTraceGradChannels, features, 1.f);
  if (!surfels.sh_dc) return;
  write_columns(out.sh_dc, 3, kTraceGradChannels + features, 3, kSh0);
  write_columns(out.sh_rest, 3 * surfels.rest, coefficients, used, 1.f);
}

}  // namespace

void trace_surfel_gradients(const TraceBackwardArgs& args, const int32_t* slots, const TraceGradients& out,
                            bool saturate) {
  const int64_t count = args.surfels.arrays.count, groups = (count + kLanes - 1) / kLanes;
  each_in_shares(args.options.threads, groups, [&](int64_t group) {
    const int64_t ahead = (group + kPrefetchGroups) * kLanes;
    for (int64_t id = ahead; id < count && id < ahead + kLanes; ++id) {
      const float* row = args.rows + int64_t(slots[id]) * args.row_stride;
      for (int c = 0; c < args.row_stride; c += 16) __builtin_prefetch(row + c);
    }
    GradientGroup(args, slots, saturate, group * kLanes).write(out);
  });
}

}  // namespace rtgs::RTGS_ISA
