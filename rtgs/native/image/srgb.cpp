// Kernels of srgb.h, kLanes numbers at a time, the last of them as all others: a number's result does not depend on
// where it stands, so threads change nothing.
#include "common/parallel.h"
#include "image/srgb.h"

#include "common/rows.h"
#include "image/srgb_curve.h"

namespace rtgs::RTGS_ISA {
namespace {

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
