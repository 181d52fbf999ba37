// What the tracer's forward and backward passes share: a packet of rays, its workspace, the hit of a surfel.
#pragma once
#include <cstdlib>

#include "common/memory.h"
#include "gaussians/harmonics.h"
#include "trace/trace.h"
#include "trace/surfels.h"

namespace rtgs::RTGS_ISA {

constexpr float kFarAway = 3e38f;          // as t: no hit
constexpr float kGrazing = 1e-6f;          // a hit counts where |n.d| >= kGrazing |d|
constexpr int kTracePrefetch = 4;          // surfels ahead in a packet's list

static inline int64_t packet_count(const TraceRays& rays) { return (rays.count + kLanes - 1) / kLanes; }

// Memory that only grows and keeps its contents.
template <class T>
struct Growing {
  T* data = nullptr;
  int64_t capacity = 0;
  void reserve(int64_t count) {
    if (__builtin_expect(count > capacity, 0)) grow(count);
  }
  T& operator[](int64_t i) { return data[i]; }
  void release() { free(data); }

 private:
  __attribute__((noinline)) void grow(int64_t count) {
    const int64_t wanted = (2 * count + 63) / 64 * 64;
    T* larger = static_cast<T*>(allocate(64, size_t(wanted) * sizeof(T)));
    if (data) memcpy(static_cast<void*>(larger), data, size_t(capacity) * sizeof(T));
    free(data);
    data = larger;
    capacity = wanted;
  }
};

struct PacketRays {
  vfloat ox, oy, oz, dx, dy, dz, length, least_cosine, t_min, t_max;
  vint ray;
  vmask exists, usable;  // usable: exists, and is finite; of others origin and direction are 0
  int count;

  PacketRays(const TraceRays& rays, int64_t packet) {
    const int64_t first = packet * kLanes;
    count = int(rays.count - first < kLanes ? rays.count - first : kLanes);
    exists = first_lanes(count);
    // Lanes past the last ray repeat its bounds, and have stopped.
    ray = min_int(truncate(lane_numbers()), broadcast_int(count - 1)) + int32_t(first);
    if (rays.order) ray = gather_int(rays.order, ray);
    const vint row = ray * 3;
    ox = gather(rays.origins, row), oy = gather(rays.origins + 1, row), oz = gather(rays.origins + 2, row);
    dx = gather(rays.directions, row), dy = gather(rays.directions + 1, row), dz = gather(rays.directions + 2, row);
    usable = exists & finite(ox) & finite(oy) & finite(oz) & finite(dx) & finite(dy) & finite(dz);
    ox = where(usable, ox), oy = where(usable, oy), oz = where(usable, oz);
    dx = where(usable, dx), dy = where(usable, dy), dz = where(usable, dz);
    const vfloat longest = max(max(max(abs(dx), abs(dy)), abs(dz)), broadcast(1e-37f));  // no square overflows
    const vfloat x = dx / longest, y = dy / longest, z = dz / longest;
    length = longest * sqrt(x * x + y * y + z * z);
    least_cosine = kGrazing * length;
    t_min = rays.t_min_each ? gather(rays.t_min_each, ray) : broadcast(rays.t_min);
    t_max = rays.t_max_each ? gather(rays.t_max_each, ray) : broadcast(rays.t_max);
    t_max = select(usable, min(t_max, broadcast(kFarAway)), broadcast(-kFarAway));
  }
  // Where colours are looked up: at the unit direction, or at the direction as it is given.
  Direction color_direction(bool raw) const {
    if (raw) return {where(usable, dx), where(usable, dy), where(usable, dz)};
    return unit_direction();
  }
  Direction unit_direction() const {
    const vfloat inverse = where(gt(length, broadcast(0.f)), 1.f / max(length, broadcast(1e-37f)));
    return {dx * inverse, dy * inverse, dz * inverse};
  }
};

struct PlaneHit {
  vfloat cosine, inverse, t, ex, ey, ez, u, v, rho;  // cosine = n.d; e = x - mean; u, v in standard deviations
};

static inline PlaneHit plane_hit(const float* s, const PacketRays& r) {
  PlaneHit h;
  const vfloat qx = r.ox - s[kTraceMean], qy = r.oy - s[kTraceMean + 1], qz = r.oz - s[kTraceMean + 2];
  const float *n = s + kTraceNormal, *u = s + kTraceU, *v = s + kTraceV;
  h.cosine = fma(r.dz, broadcast(n[2]), fma(r.dy, broadcast(n[1]), r.dx * n[0]));
  const vfloat height = fma(qz, broadcast(n[2]), fma(qy, broadcast(n[1]), qx * n[0]));
  h.inverse = reciprocal(h.cosine);
  h.t = -height * h.inverse;
  h.ex = fma(h.t, r.dx, qx), h.ey = fma(h.t, r.dy, qy), h.ez = fma(h.t, r.dz, qz);
  h.u = fma(h.ez, broadcast(u[2]), fma(h.ey, broadcast(u[1]), h.ex * u[0]));
  h.v = fma(h.ez, broadcast(v[2]), fma(h.ey, broadcast(v[1]), h.ex * v[0]));
  h.rho = fma(h.u, h.u, h.v * h.v);
  return h;
}
static inline vfloat response_exponent(const float* s, vfloat rho) {  // alpha before the clamp is 2^this
  return s[kTraceLogOpacity] - kHalfLog2E * rho;
}
static inline int32_t record_id(const float* s) {
  int32_t id;
  memcpy(&id, s + kTraceId, sizeof id);
  return id;
}

struct PendingChild {
  float nearest;   // no hit inside is nearer
  int32_t child;
  uint32_t lanes;  // that meet its box
};

struct TraceWorkspace {
  Growing<PendingChild> pending;
  // Candidates, one place each in the order found: kLanes floats per place.
  Growing<float> t, exponents, weights, to_weight;
  Growing<int32_t> slots;
  // Not yet composited hits, one column per lane.
  Growing<int32_t> columns, sorted_places;
  Growing<float> sorted_t;
  // Composited: places by row; then the surfels met.
  Growing<int32_t> rows, keys, met_ids, met_slots, met_places;
  Growing<uint64_t> long_keys, spare_keys;
  // Of the backward pass.
  Growing<uint64_t> clamped;    // by surfel met: colours at zero, a bit per ray, 16 bits apart per channel
  Growing<float> summed_rows;   // of the groups of packets, one after the other (rows.h)
  Growing<int32_t> summed_slots, places;  // of each row its surfel; of each surfel its last row
  int64_t summed;

  void release() {
    pending.release(), t.release(), exponents.release(), weights.release(), to_weight.release(), slots.release();
    columns.release(), sorted_places.release(), sorted_t.release(), rows.release(), keys.release();
    met_ids.release(), met_slots.release(), met_places.release(), long_keys.release(), spare_keys.release();
    clamped.release(), summed_rows.release(), summed_slots.release(), places.release();
  }
};

static inline TraceWorkspace& workspace_of(void** workspaces, int thread) {
  if (!workspaces[thread]) {
    const size_t bytes = (sizeof(TraceWorkspace) + 63) / 64 * 64;
    workspaces[thread] = memset(allocate(64, bytes), 0, bytes);
  }
  return *static_cast<TraceWorkspace*>(workspaces[thread]);
}

static inline char* arena_take(TapeArena& arena, int64_t bytes) {
  bytes = (bytes + 63) / 64 * 64;
  if (bytes > arena.left) arena.more(arena, bytes);
  char* taken = arena.free;
  arena.free += bytes;
  arena.left -= bytes;
  return taken;
}

// What the sums over a packet's surfels will read of one.
static inline void prefetch_surfel(const TraceSurfels& s, int64_t id) {
  const float* features = s.arrays.features + int64_t(s.feature_count()) * id;
  for (int c = 0; c < s.feature_count(); c += 16) __builtin_prefetch(features + c);
  if (s.feature_count()) __builtin_prefetch(features + s.feature_count() - 1);
  if (!s.sh_dc) return;
  __builtin_prefetch(s.sh_dc + 3 * id);
  const float* rest = s.sh_rest + int64_t(3) * s.rest * id;
  for (int c = 0; c < 3 * rest_count(s.degree); c += 16) __builtin_prefetch(rest + c);
}

// Colours at a surfel: 0.5 + SH before the clamp at zero, for a packet's directions. basis holds rest_count(degree).
static inline void surfel_colors(const TraceSurfels& s, int64_t id, int rest, const vfloat* basis, vfloat* raw) {
  const float *dc = s.sh_dc + 3 * id, *c = s.sh_rest + int64_t(3) * s.rest * id;
  vfloat r = broadcast(0.5f + kSh0 * dc[0]), g = broadcast(0.5f + kSh0 * dc[1]), b = broadcast(0.5f + kSh0 * dc[2]);
  for (int k = 0; k < rest; ++k) {
    r = fma(basis[k], broadcast(c[3 * k]), r);
    g = fma(basis[k], broadcast(c[3 * k + 1]), g);
    b = fma(basis[k], broadcast(c[3 * k + 2]), b);
  }
  raw[0] = r, raw[1] = g, raw[2] = b;
}
static inline void packet_basis(int degree, Direction d, vfloat* basis) {
  if (degree == 1) sh_basis<1>(d, basis);
  else if (degree == 2) sh_basis<2>(d, basis);
  else if (degree >= 3) sh_basis<3>(d, basis);
}

}  // namespace rtgs::RTGS_ISA
