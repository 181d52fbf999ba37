// Which children of a node a packet of rays meets.
#pragma once
#include "trace/packet.h"

namespace rtgs::RTGS_ISA {

typedef float Float8 __attribute__((vector_size(32)));
static inline Float8 load8(const float* p) {
  Float8 v;
  memcpy(&v, p, sizeof v);
  return v;
}
static inline Float8 min8(Float8 a, Float8 b) { return a < b ? a : b; }
static inline Float8 max8(Float8 a, Float8 b) { return a > b ? a : b; }
static inline uint32_t bits8(Float8 low, Float8 high) {  // low <= high
#if defined(__AVX2__)
  return uint32_t(_mm256_movemask_ps(_mm256_cmp_ps((__m256)low, (__m256)high, _CMP_LE_OQ)));
#else
  uint32_t bits = 0;
  for (int k = 0; k < 8; ++k) bits |= uint32_t(low[k] <= high[k]) << k;
  return bits;
#endif
}

class PacketSlabs {
 public:
  explicit PacketSlabs(const PacketRays& r) {
    // A smaller component counts as this one: what that moves a hit aside is less than half a padding.
    const vfloat tiny = max(r.length, broadcast(1e-29f)) * 1e-8f;
    const vfloat d[3] = {r.dx, r.dy, r.dz}, o[3] = {r.ox, r.oy, r.oz};
    const vfloat padding = kBoxPadding * max(max(abs(o[0]), abs(o[1])), abs(o[2]));
    for (int k = 0; k < 3; ++k) {
      scale_[k] = 1.f / select(lt(abs(d[k]), tiny), tiny, d[k]);
      const vfloat shift = -o[k] * scale_[k], pad = padding * scale_[k];
      low_shift_[k] = shift - pad;
      high_shift_[k] = shift + pad;
      bound_axis(axes_[k], o[k], scale_[k], padding, r.usable);
    }
    t_min_ = r.t_min;
    nearest_ = smallest_of(r.usable, r.t_min);
  }

  // Children, as bits, that the box of all the rays may meet: no child is missed.
  uint32_t may_meet(const TreeNode& node) const {
    return may_meet(node.low, node.high) & bits8(load8(node.low[0]), load8(node.high[0]));
  }
  // The same of any 8 boxes; one that holds nothing may be among them.
  uint32_t may_meet(const float (&low)[3][8], const float (&high)[3][8]) const {
    Float8 nearest = Float8{} + nearest_, farthest = Float8{} + kFarAway;
    for (int k = 0; k < 3; ++k) {
      const Axis& axis = axes_[k];
      if (!axis.sign) continue;
      const Float8 a = load8(axis.sign > 0 ? low[k] : high[k]) - axis.last_origin;
      const Float8 b = load8(axis.sign > 0 ? high[k] : low[k]) - axis.first_origin;
      nearest = max8(nearest, min8(a * axis.slowest, a * axis.fastest));
      farthest = min8(farthest, max8(b * axis.slowest, b * axis.fastest));
    }
    return bits8(nearest, farthest);
  }

  // Rays that meet the child's box before t_max, and where.
  vmask meet(const TreeNode& node, int child, vfloat t_max, vfloat& nearest) const {
    vfloat farthest = t_max;
    nearest = t_min_;
    for (int k = 0; k < 3; ++k) {
      const vfloat a = fma(scale_[k], broadcast(node.low[k][child]), low_shift_[k]);
      const vfloat b = fma(scale_[k], broadcast(node.high[k][child]), high_shift_[k]);
      nearest = max(nearest, min(a, b));
      farthest = min(farthest, max(a, b));
    }
    return le(nearest, farthest);
  }

 private:
  struct Axis {
    int sign;  // of all directions; 0: they differ
    float first_origin, last_origin, slowest, fastest;  // along that sign; bounds of 1/d
  };
  static float smallest_of(vmask rays, vfloat v) { return smallest(select(rays, v, broadcast(kFarAway))); }
  static float largest_of(vmask rays, vfloat v) { return -smallest_of(rays, -v); }
  static void bound_axis(Axis& axis, vfloat origin, vfloat scale, vfloat padding, vmask rays) {
    const vfloat speed = abs(scale);
    axis.sign = smallest_of(rays, scale) > 0.f ? 1 : largest_of(rays, scale) < 0.f ? -1 : 0;
    const float sign = float(axis.sign);
    axis.slowest = sign * smallest_of(rays, speed), axis.fastest = sign * largest_of(rays, speed);
    const vfloat along = origin * sign;
    axis.first_origin = sign * smallest_of(rays, along - padding);
    axis.last_origin = sign * largest_of(rays, along + padding);
  }

  vfloat scale_[3], low_shift_[3], high_shift_[3], t_min_;
  float nearest_;
  Axis axes_[3];
};

}  // namespace rtgs::RTGS_ISA
