// The sRGB curve (IEC 61966-2-1) and its inverse, for kernels. Twin: rtgs/optics/light.py.
#pragma once
#include "common/simd.h"

namespace rtgs::RTGS_ISA {

constexpr float kDarkColor = 0.04045f, kDarkLight = 0.0031308f, kSlope = 12.92f, kOffset = 0.055f, kPower = 2.4f;

// A value and its slope, by one power.
struct Curve {
  vfloat value, slope;
};

// a^exponent of a normal a above 0, at most 2^126. What is infinite stays so: the check of the loss must see it.
static inline vfloat power(vfloat a, float exponent) {
  return select(finite(a), exp2_response(min(exponent * log2(a), broadcast(126.f))), a);
}

// The line is the other case of "brighter than", so that it hands NaN on. Where all lanes are on it, as those of a light
// that a part of the picture does not have, there is no power to be taken.
static inline Curve decode_curve(vfloat color) {
  const vmask bright = gt(color, broadcast(kDarkColor));
  if (!any(bright)) return {color * (1 / kSlope), broadcast(1 / kSlope)};
  const vfloat base = max(color, broadcast(kDarkColor)) + kOffset, light = power(base * (1 / (1 + kOffset)), kPower);
  return {select(bright, light, color * (1 / kSlope)), select(bright, kPower * light / base, broadcast(1 / kSlope))};
}
static inline Curve encode_curve(vfloat light) {
  const vmask bright = gt(light, broadcast(kDarkLight));
  if (!any(bright)) return {light * kSlope, broadcast(kSlope)};
  const vfloat base = max(light, broadcast(kDarkLight)), raised = (1 + kOffset) * power(base, 1 / kPower);
  return {select(bright, raised - kOffset, light * kSlope),
          select(bright, raised / (kPower * base), broadcast(kSlope))};
}

}  // namespace rtgs::RTGS_ISA
