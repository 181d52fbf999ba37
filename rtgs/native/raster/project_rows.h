// What projections of every kind of Gaussian share: vectors with kLanes Gaussians to a register, rows in and out of
// memory, screen bounds.
#pragma once
#include "raster/raster.h"
#include "common/rows.h"
#include "common/simd.h"

namespace rtgs::RTGS_ISA {

struct vec3 {
  vfloat x, y, z;
};
static inline vec3 cross(vec3 a, vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
static inline vfloat dot(vec3 a, vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline vec3 operator*(vfloat s, vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
static inline vec3 operator+(vec3 a, vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
static inline vmask finite(vec3 a) { return finite(a.x) & finite(a.y) & finite(a.z); }

static inline vec3 rotate(const float* r, vec3 a) {  // R a
  return {r[0] * a.x + r[1] * a.y + r[2] * a.z, r[3] * a.x + r[4] * a.y + r[5] * a.z, r[6] * a.x + r[7] * a.y + r[8] * a.z};
}
static inline vec3 rotate_back(const float* r, vec3 a) {  // R^T a
  return {r[0] * a.x + r[3] * a.y + r[6] * a.z, r[1] * a.x + r[4] * a.y + r[7] * a.z, r[2] * a.x + r[5] * a.y + r[8] * a.z};
}

// ---- rows in ---------------------------------------------------------------------------------------------------
// kLanes rows of width components, from row `first`; lanes past the last row repeat it.
struct RowReader {
  vint row;
  bool full;  // no lane is past the last row
  RowReader(int64_t first, int64_t count) : full(first + kLanes <= count) {
    for (int lane = 0; lane < kLanes; ++lane) row[lane] = first + lane < count ? lane : int32_t(count - 1 - first);
  }
  vfloat component(const float* base, int width, int64_t first, int index) const {
    return gather(base + first * width + index, row * width);
  }
  template <int W>
  void components(const float* base, int64_t first, vfloat (&out)[W]) const {
    if (full) return load_rows<W>(base + first * W, out);
    for (int k = 0; k < W; ++k) out[k] = component(base, W, first, k);
  }
  vec3 vector(const float* base, int64_t first) const {
    vfloat v[3];
    components(base, first, v);
    return {v[0], v[1], v[2]};
  }
};

static inline bool all_finite(const float* values, int count) {
  vmask ok = first_lanes(kLanes);
  for (int k = 0; k < count; k += kLanes) ok = ok & finite(load_first(values + k, count - k));
  return !any(mask_not(ok));
}

// ---- rows out --------------------------------------------------------------------------------------------------
static inline vfloat saturated(vfloat v) {  // infinite: the largest float of that sign; NaN, from infinities that cancel: 0
  const vfloat zero = broadcast(0.f), largest = broadcast(3e38f);
  return select(finite(v), v, select(gt(v, zero), largest, where(lt(v, zero), -largest)));
}
static inline vec3 saturated(vec3 v) { return {saturated(v.x), saturated(v.y), saturated(v.z)}; }

// The gradient rows of kLanes Gaussians, taken out of the memory of the raster pass; zeros where nothing shows.
struct GradientRows {
  static constexpr int kLongest = 64;  // floats: what the footprint with most sums takes, in whole cache lines
  int64_t first;
  int lanes;
  vmask visible;
  alignas(64) float staged[kLanes][kLongest];

  // Leaves zeros behind for the next call.
  GradientRows(const ProjectBackwardArgs& args, int64_t first)
      : first(first), lanes(int(args.inputs.count - first < kLanes ? args.inputs.count - first : kLanes)) {
    const int stride = args.gaussians.layout.gradient_stride;
    const vfloat zero = broadcast(0.f);
    float shown[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      const bool shows = lane < lanes && args.gaussians.rects[first + lane].tiles() > 0;
      shown[lane] = shows ? 1.f : 0.f;
      float *row = staged[lane], *from = args.rows + (first + lane) * stride;
      for (int k = 0; k < stride; k += kLanes) {
        const vfloat values = shows ? load(from + k) : zero;
        store(row + k, args.saturate ? saturated(values) : values);
        if (shows) store(from + k, zero);
      }
    }
    visible = gt(load(shown), zero);
  }
  vfloat field(int k) const { return load_strided(staged[0] + k, kLongest); }
  // The first L sums of every row.
  template <int L>
  void fields(vfloat (&out)[row_registers<L>]) const {
    load_long_rows<L>(staged[0], kLongest, out);
  }
  void write_features(float* out, int channels, int first_field) const {
    if (!out) return;
    for (int lane = 0; lane < lanes; ++lane)
      memcpy(out + (first + lane) * channels, staged[lane] + first_field, channels * sizeof(float));
  }
  // W components per Gaussian to `out` (null: not wanted).
  template <int W>
  void write(float* out, const vfloat (&values)[W]) const {
    if (!out) return;
    vfloat kept[W];
    for (int k = 0; k < W; ++k) kept[k] = where(visible, values[k]);
    if (lanes == kLanes) return store_rows<W>(out + first * W, kept);
    float rest[W * kLanes];
    store_rows<W>(rest, kept);
    memcpy(out + first * W, rest, size_t(lanes) * W * sizeof(float));
  }
  void write(float* out, const vec3& v) const {
    const vfloat values[] = {v.x, v.y, v.z};
    write<3>(out, values);
  }
};

// ---- screen bounds ---------------------------------------------------------------------------------------------
// Squared half-widths grow a little, so that rounding never loses a pixel.
static inline vfloat widened(vfloat squared) { return squared * 1.0001f + 1e-4f; }

// BoundFields of the ellipse with these second moments; area = xx yy - xy^2, computed without cancellation.
static inline void conditional_form(vfloat xx, vfloat yy, vfloat xy, vfloat area, vfloat (&out)[kBoundFields]) {
  const vfloat wide_x = widened(xx), wide_y = widened(yy);
  out[kSlopeY] = xy / wide_x;
  out[kSlopeX] = xy / wide_y;
  out[kInvX2] = 1.f / wide_x;
  out[kInvY2] = 1.f / wide_y;
  out[kInvY2GivenX] = 1.f / ((area / wide_x) * 1.0001f + (1e-4f + 1e-10f * yy));
  out[kInvX2GivenY] = 1.f / ((area / wide_y) * 1.0001f + (1e-4f + 1e-10f * xx));
}

// First and last pixel whose centre lies in [low, high], clipped to the image; first > last: none.
struct PixelRange {
  vfloat first, last;
};
static inline PixelRange pixel_range(vfloat low, vfloat high, int size) {
  const float limit = float(size);
  return {max(-floor(clamp(0.5f - low, -limit - 1.f, 1.f)), broadcast(0.f)),
          min(floor(clamp(high - 0.5f, -1.f, limit + 1.f)), broadcast(limit - 1.f))};
}

// Tiles of a box of pixels; `meets` where it holds a pixel.
struct TileBox {
  vint x0, y0, x1, y1;
  vmask meets;
  TileBox() = default;
  TileBox(const RasterCamera& camera, vfloat left, vfloat right, vfloat top, vfloat bottom) {
    const PixelRange x = pixel_range(left, right, camera.width), y = pixel_range(top, bottom, camera.height);
    meets = ge(x.last, x.first) & ge(y.last, y.first);
    x0 = truncate(x.first) / kTileSide;
    x1 = truncate(x.last) / kTileSide;
    y0 = truncate(y.first) / kTileSide;
    y1 = truncate(y.last) / kTileSide;
  }
  TileRect rect(int lane) const { return {int16_t(x0[lane]), int16_t(y0[lane]), int16_t(x1[lane]), int16_t(y1[lane])}; }
};
constexpr TileRect kNoTiles = {0, 0, -1, -1};

}  // namespace rtgs::RTGS_ISA
