// Kernels of srgb.h, kLanes numbers at a time, the last of them as all others: a number's result does not depend on
// where it stands, so threads change nothing.
#include "common/parallel.h"
#include "image/srgb.h"

#include "common/rows.h"
#include "image/srgb_curve.h"

namespace rtgs::RTGS_ISA {
namespace {

template <typename F>
inline void for_groups(const SrgbNumbers& in, const F& result) {  // result(numbers, first, lanes)
  each_block(worth(in.threads, in.count), in.count, kLanes, [&](int64_t first) {
    const int lanes = int(in.count - first < kLanes ? in.count - first : kLanes);
    store_first(in.to + first, result(load_first(in.from + first, lanes), first, lanes), lanes);
  });
}

}  // namespace

void srgb_decode(const SrgbNumbers& in) {
  for_groups(in, [](vfloat a, int64_t, int) { return decode_curve(a).value; });
}
void srgb_encode(const SrgbNumbers& in) {
  for_groups(in, [](vfloat a, int64_t, int) { return encode_curve(a).value; });
}
void srgb_decode_backward(const SrgbNumbers& in, const float* upstream) {
  for_groups(in, [=](vfloat a, int64_t first, int lanes) {
    return load_first(upstream + first, lanes) * decode_curve(a).slope;
  });
}
void srgb_encode_backward(const SrgbNumbers& in, const float* upstream) {
  for_groups(in, [=](vfloat a, int64_t first, int lanes) {
    return load_first(upstream + first, lanes) * encode_curve(a).slope;
  });
}

}  // namespace rtgs::RTGS_ISA
