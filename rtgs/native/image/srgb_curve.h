// The sRGB curve (IEC 61966-2-1), its inverse and their slopes, for kernels. Twin: rtgs/optics/light.py.
#pragma once
#include "common/simd.h"

namespace rtgs::RTGS_ISA {

constexpr float kDarkColor = 0.04045f, kDarkLight = 0.0031308f, kSlope = 12.92f, kOffset = 0.055f, kPower = 2.4f;

// a normal and above 0; at most 2^126
static inline vfloat power(vfloat a, float exponent) { return exp2_response(min(exponent * log2(a), broadcast(126.f))); }
static inline vfloat decode_base(vfloat color) { return (max(color, broadcast(kDarkColor)) + kOffset) * (1 / (1 + kOffset)); }

// The line is the other case of "brighter than", so that it hands NaN on.
static inline vfloat decoded(vfloat color) {
  return select(gt(color, broadcast(kDarkColor)), power(decode_base(color), kPower), color * (1 / kSlope));
}
static inline vfloat encoded(vfloat light) {
  const vfloat bright = (1 + kOffset) * power(max(light, broadcast(kDarkLight)), 1 / kPower) - kOffset;
  return select(gt(light, broadcast(kDarkLight)), bright, light * kSlope);
}
static inline vfloat decode_slope(vfloat color) {
  const vfloat bright = (kPower / (1 + kOffset)) * power(decode_base(color), kPower - 1);
  return select(gt(color, broadcast(kDarkColor)), bright, broadcast(1 / kSlope));
}
static inline vfloat encode_slope(vfloat light) {
  const vfloat bright = ((1 + kOffset) / kPower) * power(max(light, broadcast(kDarkLight)), 1 / kPower - 1);
  return select(gt(light, broadcast(kDarkLight)), bright, broadcast(kSlope));
}

// Values and slopes at once, at the cost of one power.
struct Curve {
  vfloat value, slope;
};
static inline Curve decode_curve(vfloat color) {
  const vfloat base = max(color, broadcast(kDarkColor)) + kOffset, light = power(base * (1 / (1 + kOffset)), kPower);
  const vmask bright = gt(color, broadcast(kDarkColor));
  return {select(bright, light, color * (1 / kSlope)), select(bright, kPower * light / base, broadcast(1 / kSlope))};
}
static inline Curve encode_curve(vfloat light) {
  const vfloat base = max(light, broadcast(kDarkLight)), raised = (1 + kOffset) * power(base, 1 / kPower);
  const vmask bright = gt(light, broadcast(kDarkLight));
  return {select(bright, raised - kOffset, light * kSlope),
          select(bright, raised / (kPower * base), broadcast(kSlope))};
}

}  // namespace rtgs::RTGS_ISA
