// Gradients of a packet from its tape (docs/tracer.md): responses surfel by surfel, the recursion along the rays row by
// row, then all sums surfel by surfel, with rays as lanes and one transposed reduction per (surfel, packet). Surfels come
// by ascending id, so that the sums of a ray do not depend on the tree.
#include "common/parallel.h"
#include "trace/ray_rows.h"

namespace rtgs::RTGS_ISA {
namespace {

class PacketBackward {
 public:
  PacketBackward(const TraceBackwardArgs& args, TraceWorkspace& work, GroupRows& rows, const ColorMasks& masks,
                 int64_t packet)
      : args_(args), work_(work), group_(rows), tape_(args.tapes[packet]), rays_(args.rays, packet),
        ray_rows_(args.surfels, masks) {
    for (int k = 0; k < 3; ++k) to_origin_[k] = to_direction_[k] = broadcast(0.f);
  }

  void run() {
    load_upstream();
    if (args_.surfels.sh_dc) load_harmonics();
    respond();
    follow_rays();
    add_surfels();
    if (args_.ray_gradients) write_rays();
  }

 private:
  void load_upstream();
  vfloat upstream(const float* gradient, int stride, int component);
  void add_rest(vfloat to_output, const float* output, int stride, int component);
  void load_harmonics();

  void respond();
  vfloat value_gradient(const float* s, int64_t id, const PlaneHit& hit, uint64_t& clamped);
  void follow_rays();
  vint load_places(int row) const;

  void add_surfels();
  void geometry_sums(const float* s, const PlaneHit& hit, int32_t place, vmask met, vfloat w, vfloat* sums);
  void write_rays();

  const float* record(int32_t slot) const { return args_.records + int64_t(kTraceFields) * slot; }

  const TraceBackwardArgs& args_;
  TraceWorkspace& work_;
  GroupRows& group_;
  const PacketTape& tape_;
  const PacketRays rays_;

  vfloat to_features_[32], to_colors_[3], to_normal_[3], to_depth_ = broadcast(0.f);
  vmask finite_upstream_ = first_lanes(kLanes);
  vfloat rest_ = broadcast(0.f);  // upstream times what the hits not yet passed add to the ray
  vfloat basis_[16];
  vint last_place_ = broadcast_int(-1);
  vfloat to_origin_[3], to_direction_[3];
  RayRows ray_rows_;
};

// ---- upstream --------------------------------------------------------------------------------------------------
inline vfloat PacketBackward::upstream(const float* gradient, int stride, int component) {
  if (!gradient) return broadcast(0.f);
  const vfloat g = gather(gradient + component, rays_.ray * stride);
  const vmask good = finite(g);
  finite_upstream_ = finite_upstream_ & good;
  if (any(mask_not(good))) __atomic_store_n(args_.poisoned, 1, __ATOMIC_RELAXED);
  return where(rays_.exists, g);
}
inline void PacketBackward::add_rest(vfloat to_output, const float* output, int stride, int component) {
  if (output) rest_ += to_output * gather(output + component, rays_.ray * stride);
}

void PacketBackward::load_upstream() {
  const int features = args_.surfels.feature_count();
  ray_rows_.clear_channels();
  for (int c = 0; c < features; ++c) {
    to_features_[c] = upstream(args_.grad_features, features, c);
    add_rest(to_features_[c], args_.features, features, c);
    for (int lane = 0; lane < kLanes; ++lane) ray_rows_[lane].channels[c] = to_features_[c][lane];
  }
  for (int c = 0; c < 3; ++c) {
    to_colors_[c] = upstream(args_.surfels.sh_dc ? args_.grad_colors : nullptr, 3, c);
    add_rest(to_colors_[c], args_.colors, 3, c);
    if (args_.surfels.sh_dc)
      for (int lane = 0; lane < kLanes; ++lane) ray_rows_[lane].channels[features + c] = to_colors_[c][lane];
    to_normal_[c] = upstream(args_.grad_normal, 3, c);
    add_rest(to_normal_[c], args_.normal, 3, c);
  }
  to_depth_ = upstream(args_.grad_depth, 1, 0);
  add_rest(to_depth_, args_.depth, 1, 0);
  rest_ -= upstream(args_.grad_alpha, 1, 0) * (1.f - gather(args_.alpha, rays_.ray));
}

void PacketBackward::load_harmonics() {
  packet_basis(args_.surfels.degree, rays_.color_direction(args_.options.raw_sh), basis_);
  const int rest = rest_count(args_.surfels.degree);
  for (int lane = 0; lane < kLanes; ++lane) {
    ray_rows_.clear_coefficients(lane);
    RayRow& row = ray_rows_[lane];
    for (int k = 0; k < rest; ++k)
      for (int c = 0; c < 3; ++c) {
        row.pattern[3 * k + c] = to_colors_[c][lane];
        row.coefficients[3 * k + c] = to_colors_[c][lane] * basis_[k][lane];
      }
  }
}

// ---- along the rays ----------------------------------------------------------------------------------------------
// Gradient of the loss by the weight of a hit, alpha's part left out.
inline vfloat PacketBackward::value_gradient(const float* s, int64_t id, const PlaneHit& hit, uint64_t& clamped) {
  vfloat to_weight = hit.t * to_depth_;
  const int features = args_.grad_features ? args_.surfels.feature_count() : 0;
  const float* values = args_.surfels.arrays.features + int64_t(args_.surfels.feature_count()) * id;
  for (int c = 0; c < features; ++c) to_weight = fma(to_features_[c], broadcast(values[c]), to_weight);
  if (args_.grad_normal) {
    const float* n = s + kTraceNormal;
    const vfloat along = to_normal_[0] * n[0] + to_normal_[1] * n[1] + to_normal_[2] * n[2];
    to_weight += negated_where(gt(hit.cosine, broadcast(0.f)), along);
  }
  clamped = 0;
  if (args_.surfels.sh_dc) {
    vfloat raw[3];
    surfel_colors(args_.surfels, id, rest_count(args_.surfels.degree), basis_, raw);
    for (int c = 0; c < 3; ++c) {
      clamped |= uint64_t(mask_bits(le(raw[c], broadcast(0.f)))) << (16 * c);
      to_weight = fma(to_colors_[c], max(raw[c], broadcast(0.f)), to_weight);
    }
  }
  return to_weight;
}

void PacketBackward::respond() {
  const int64_t floats = int64_t(tape_.places_used) * kLanes;
  work_.exponents.reserve(floats);
  work_.to_weight.reserve(floats);
  work_.weights.reserve(floats);
  work_.clamped.reserve(tape_.surfels);
  for (int k = 0; k < tape_.surfels; ++k) {
    if (k + kTracePrefetch < tape_.surfels) {
      __builtin_prefetch(record(tape_.slots[k + kTracePrefetch]));
      prefetch_surfel(args_.surfels, tape_.ids[k + kTracePrefetch]);
    }
    const float* s = record(tape_.slots[k]);
    const int64_t at = int64_t(tape_.places[k]) * kLanes;
    const PlaneHit hit = plane_hit(s, rays_);
    store(work_.exponents.data + at, response_exponent(s, hit.rho));
    store(work_.to_weight.data + at, value_gradient(s, tape_.ids[k], hit, work_.clamped[k]));
    store(work_.weights.data + at, broadcast(0.f));
  }
}

inline vint PacketBackward::load_places(int row) const {
  if (tape_.wide) return load_int(static_cast<const int32_t*>(tape_.rows) + int64_t(row) * kLanes);
  const vint places = load_short(static_cast<const uint16_t*>(tape_.rows) + int64_t(row) * kLanes);
  return select_int(eq_int(places, broadcast_int(0xffff)), broadcast_int(-1), places);
}

// Front to back. Leaves the weights of the hits in `weights` and dL/d ln(alpha) in `exponents`.
void PacketBackward::follow_rays() {
  const vint lane = truncate(lane_numbers());
  vfloat transmittance = broadcast(1.f), rest = rest_;
  for (int row = 0; row < tape_.row_count; ++row) {
    const vint place = load_places(row);
    const vmask hit = gt_int(place, broadcast_int(-1));
    const vint at = max_int(place, broadcast_int(0)) * kLanes + lane;
    const vfloat raw = exp2_response(gather(work_.exponents.data, at)), alpha = min(raw, broadcast(kMaxAlpha));
    const vfloat to_weight = where(hit, gather(work_.to_weight.data, at));
    const vfloat w = where(hit, alpha * transmittance);
    rest -= w * to_weight;
    const vfloat log_alpha = where(lt(raw, broadcast(kMaxAlpha)),
                                   (transmittance * to_weight - rest * reciprocal(1.f - alpha)) * alpha);
    transmittance -= w;
    scatter(work_.exponents.data, at, log_alpha, hit);
    scatter(work_.weights.data, at, w, hit);
    last_place_ = select_int(hit, place, last_place_);
  }
}

// ---- the sums of the surfels -------------------------------------------------------------------------------------
inline void PacketBackward::geometry_sums(const float* s, const PlaneHit& hit, int32_t place, vmask met, vfloat w,
                                          vfloat* sums) {
  const float *n = s + kTraceNormal, *a = s + kTraceU, *b = s + kTraceV;
  const vfloat log_alpha = where(met, load(work_.exponents.data + int64_t(place) * kLanes));
  const vfloat t = where(met, hit.t), ex = where(met, hit.ex), ey = where(met, hit.ey), ez = where(met, hit.ez);
  const vfloat to_u = where(met, -log_alpha * hit.u), to_v = where(met, -log_alpha * hit.v);
  const vfloat speed_u = rays_.dx * a[0] + rays_.dy * a[1] + rays_.dz * a[2];
  const vfloat speed_v = rays_.dx * b[0] + rays_.dy * b[1] + rays_.dz * b[2];
  const vfloat to_t = to_u * speed_u + to_v * speed_v + w * to_depth_;
  const vfloat z = where(met, to_t * hit.inverse);
  vfloat to_hit[3];  // by the ray's origin; the surfel's mean moves the other way
  for (int k = 0; k < 3; ++k) {
    to_hit[k] = to_u * a[k] + to_v * b[k] - z * n[k];
    const vfloat later = t * to_hit[k];
    to_origin_[k] += to_hit[k];
    to_direction_[k] += later;
    sums[kTraceGradMean + k] = -to_hit[k];
    sums[kTraceGradProbe + k] = later * -0.5f;
  }
  const vfloat e[3] = {ex, ey, ez};
  for (int k = 0; k < 3; ++k) {
    sums[kTraceGradNormal + k] = -z * e[k];
    sums[kTraceGradU + k] = to_u * e[k];
    sums[kTraceGradV + k] = to_v * e[k];
  }
  if (args_.grad_normal) {
    const vfloat facing = negated_where(gt(hit.cosine, broadcast(0.f)), w);
    for (int k = 0; k < 3; ++k) sums[kTraceGradNormal + k] += facing * to_normal_[k];
  }
  sums[kTraceGradLogAlpha] = log_alpha;
}

void PacketBackward::add_surfels() {
  for (int k = 0; k < tape_.surfels; ++k) {
    const int32_t slot = tape_.slots[k], place = tape_.places[k];
    const float* s = record(slot);
    const PlaneHit hit = plane_hit(s, rays_);
    const vfloat w = load(work_.weights.data + int64_t(place) * kLanes);
    const vmask met = gt(w, broadcast(0.f));
    vfloat sums[kTraceGradChannels];
    geometry_sums(s, hit, place, met, w, sums);

    const SurfelHits hits = surfel_hits(met, w, work_.clamped[k]);
    if (args_.surfel_gradients) {
      bool adds;
      float* out = group_.of(slot, adds);
      for (int c = 0; c < kTraceGradChannels; c += kLanes) put(out + c, settled(sums_of<>(sums + c)), adds);
      if (args_.ray_gradients && !args_.options.last_sh && ray_rows_.sum_both(hits, tape_.ids[k], out, adds)) continue;
      ray_rows_.sum_hits(hits, out, adds);
    }
    if (args_.ray_gradients && ray_rows_.layout().coefficients) {
      const uint32_t last = mask_bits(eq_int(last_place_, broadcast_int(place)));
      ray_rows_.add_direction(hits, args_.options.last_sh ? hits.lanes & last : hits.lanes, tape_.ids[k]);
    }
  }
}

void PacketBackward::write_rays() {
  if (args_.options.last_sh)
    for (vfloat& v : to_direction_) v = broadcast(0.f);
  if (ray_rows_.layout().coefficients) {
    const Direction d = rays_.color_direction(args_.options.raw_sh);
    vfloat to_basis[kMostColumns];
    for (vfloat& v : to_basis) v = broadcast(0.f);
    for (int k = 0; k < rest_count(args_.surfels.degree); ++k)
      for (int lane = 0; lane < kLanes; ++lane) {
        const float* sums = ray_rows_.to_basis(lane) + 3 * k;
        to_basis[3 * k][lane] = sums[0] + sums[1] + sums[2];
      }
    Direction g = args_.surfels.degree == 1   ? sh_derivative<1>(d, to_basis)
                  : args_.surfels.degree == 2 ? sh_derivative<2>(d, to_basis)
                                              : sh_derivative<3>(d, to_basis);
    if (!args_.options.raw_sh) {
      const vfloat along = g.x * d.x + g.y * d.y + g.z * d.z;
      const vfloat inverse = where(gt(rays_.length, broadcast(0.f)), 1.f / max(rays_.length, broadcast(1e-37f)));
      g = {(g.x - along * d.x) * inverse, (g.y - along * d.y) * inverse, (g.z - along * d.z) * inverse};
    }
    to_direction_[0] += g.x, to_direction_[1] += g.y, to_direction_[2] += g.z;
  }
  for (int k = 0; k < 3; ++k) {
    vfloat origin = where(rays_.usable, to_origin_[k]), direction = where(rays_.usable, to_direction_[k]);
    origin = select(finite_upstream_, saturated(origin), origin);
    direction = select(finite_upstream_, saturated(direction), direction);
    if (args_.out_origins) scatter(args_.out_origins + k, rays_.ray * 3, origin, rays_.exists);
    if (args_.out_directions) scatter(args_.out_directions + k, rays_.ray * 3, direction, rays_.exists);
  }
}

}  // namespace

int trace_row_stride(const TraceSurfels& surfels) { return (RowLayout(surfels).floats + 15) / 16 * 16; }

int first_coefficient(const TraceSurfels& surfels) { return kTraceGradChannels + RowLayout(surfels).channels; }

void trace_backward(const TraceBackwardArgs& args) {
  const int threads = args.options.threads;
  const int64_t packets = packet_count(args.rays), groups = (packets + kGroup - 1) / kGroup;
  const int64_t surfels = args.surfels.arrays.count;
  // In waves, for the rows of all that wait are in memory. What a wave holds decides no order of additions.
  const int64_t wave = threads == 1 ? 1 : int64_t(threads) * kGroupsInWave;
  const ColorMasks masks(args.surfels.feature_count());
  for (int64_t first = 0; first < groups; first += wave) {
    const int64_t count = groups - first < wave ? groups - first : wave;
    for (int part = 0; part < threads; ++part) workspace_of(args.workspaces, part).summed = 0;
    in_turns(threads, count, 1, [&](int part, Turns& turns) {
      TraceWorkspace& work = workspace_of(args.workspaces, part);
      for (int64_t group, after; turns.next(group, after);) {
        GroupRows rows(work, args.surfel_gradients ? surfels : 0, args.row_stride);
        const int64_t begin = (first + group) * kGroup, end = begin + kGroup < packets ? begin + kGroup : packets;
        for (int64_t packet = begin; packet < end; ++packet) PacketBackward(args, work, rows, masks, packet).run();
        args.groups[group] = rows.done(part);
      }
    });
    if (!args.surfel_gradients) continue;
    in_shares(threads, surfels, [&](int64_t begin, int64_t end) {
      for (int64_t group = 0; group < count; ++group) add_group(args, args.groups[group], begin, end);
    });
  }
}

}  // namespace rtgs::RTGS_ISA
