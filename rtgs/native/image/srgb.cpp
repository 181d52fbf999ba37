// Kernels of srgb.h, kLanes numbers at a time, the last of them as all others: a number's result does not depend on
// where it stands, so threads change nothing.
#include "common/parallel.h"
#include "image/srgb.h"

#include "common/rows.h"

namespace rtgs::RTGS_ISA {
namespace {

constexpr float kDarkColor = 0.04045f, kDarkLight = 0.0031308f, kSlope = 12.92f, kOffset = 0.055f, kPower = 2.4f;

// a normal and above 0; at most 2^126
inline vfloat power(vfloat a, float exponent) { return exp2_response(min(exponent * log2(a), broadcast(126.f))); }
inline vfloat decode_base(vfloat color) { return (max(color, broadcast(kDarkColor)) + kOffset) * (1 / (1 + kOffset)); }

// The line is the other case of "brighter than", so that it hands NaN on.
inline vfloat decoded(vfloat color) {
  return select(gt(color, broadcast(kDarkColor)), power(decode_base(color), kPower), color * (1 / kSlope));
}
inline vfloat encoded(vfloat light) {
  const vfloat bright = (1 + kOffset) * power(max(light, broadcast(kDarkLight)), 1 / kPower) - kOffset;
  return select(gt(light, broadcast(kDarkLight)), bright, light * kSlope);
}
inline vfloat decode_slope(vfloat color) {
  const vfloat bright = (kPower / (1 + kOffset)) * power(decode_base(color), kPower - 1);
  return select(gt(color, broadcast(kDarkColor)), bright, broadcast(1 / kSlope));
}
inline vfloat encode_slope(vfloat light) {
  const vfloat bright = ((1 + kOffset) / kPower) * power(max(light, broadcast(kDarkLight)), 1 / kPower - 1);
  return select(gt(light, broadcast(kDarkLight)), bright, broadcast(kSlope));
}

constexpr int64_t kWorthThreads = 16384;

template <typename F>
inline void for_groups(const SrgbNumbers& in, const F& result) {  // result(numbers, first, lanes)
  const int threads = in.count > kWorthThreads ? in.threads : 1;
  each_block(threads, in.count, kLanes, [&](int64_t first) {
    const int lanes = int(in.count - first < kLanes ? in.count - first : kLanes);
    store_first(in.to + first, result(load_first(in.from + first, lanes), first, lanes), lanes);
  });
}

}  // namespace

void srgb_decode(const SrgbNumbers& in) {
  for_groups(in, [](vfloat a, int64_t, int) { return decoded(a); });
}
void srgb_encode(const SrgbNumbers& in) {
  for_groups(in, [](vfloat a, int64_t, int) { return encoded(a); });
}
void srgb_decode_backward(const SrgbNumbers& in, const float* upstream) {
  for_groups(in, [=](vfloat a, int64_t first, int lanes) { return load_first(upstream + first, lanes) * decode_slope(a); });
}
void srgb_encode_backward(const SrgbNumbers& in, const float* upstream) {
  for_groups(in, [=](vfloat a, int64_t first, int lanes) { return load_first(upstream + first, lanes) * encode_slope(a); });
}

}  // namespace rtgs::RTGS_ISA
