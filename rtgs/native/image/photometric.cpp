// L1 + D-SSIM with its gradient in one sweep (Wang et al. 2004; window and constants of method.md 9).
//
// With s = x + y and d = x - y, all that SSIM needs is in four blurred maps: s, d, s^2, d^2. Their means and variances
// give
//   A1 = 2 mu_x mu_y + C1 = B1 - mu_d^2        B1 = (mu_s^2 + mu_d^2) / 2 + C1
//   A2 = 2 cov_xy + C2    = B2 - var_d         B2 = (var_s + var_d) / 2 + C2
//   1 - SSIM = 1 - A1 A2 / (B1 B2) = mu_d^2 / B1 + var_d A1 / (B1 B2)
// which, like the gradient below, vanishes exactly for equal images instead of by cancellation in float32.
//
// The blur is separable and its own adjoint (symmetric window, zeros outside), so
//   dSSIM/dx = G*M1 + x G*M2 - d G*M3,  M3 = 2 A1 / (B1 B2),  M2 = M3 var_d / B2,
//   M1 = 2 / (B1 B2) (mu_x (A2 mu_d^2 / B1 - A1 var_d / B2) - mu_d (A2 - A1)).
//
// The sweep goes down the image in groups of kGroup rows. Each blur runs down the columns first, straight from the
// images, into padded rows that stay in L1, then along the rows. The M maps live in a ring of rows in L2, a few rows
// ahead of the gradient. Chunks of rows recompute their halo, so that no result depends on how many chunks there are.
//
// Measured and left out: statistics of the target kept per view (8 % at 400x300, 4 % at 800x600, for twice the target's
// memory); tiles of columns (8 to 20 % slower); shuffles instead of unaligned loads along the rows (no difference:
// the sweep runs at the rate of its multiply-adds).
#include "common/parallel.h"
#include "image/image.h"
#include "common/simd.h"

namespace rtgs::RTGS_ISA {
namespace {

constexpr int kRadius = 5;
constexpr int kTaps = 2 * kRadius + 1;
constexpr float kWindow[kTaps] = {  // exp(-k^2 / (2 1.5^2)), sum 1
    0.00102838008447911f, 0.00759875813523919f, 0.03600077212843083f, 0.10936068950970002f,
    0.21300553771125370f, 0.26601172486179436f, 0.21300553771125370f, 0.10936068950970002f,
    0.03600077212843083f, 0.00759875813523919f, 0.00102838008447911f};
constexpr float kC1 = 0.01f * 0.01f;
constexpr float kC2 = 0.03f * 0.03f;

#if defined(__AVX512F__)
constexpr int kGroup = 4;  // rows per step: 16 accumulators of 32 registers
#else
constexpr int kGroup = 2;
#endif
constexpr int kSpan = kGroup + 2 * kRadius;  // source rows of one group
static_assert(kRingSlots % kGroup == 0 && kRingSlots >= kSpan + kGroup - 1, "ring of gradient maps too short");

struct Plane {  // one channel, and where a thread works on it
  const float* image;
  const float* target;
  int height, width, stride;
  float* blurred;  // (kGroup, maps, stride), rows start at kRowPad
  float* ring;     // (kRingSlots, kGradientMaps, stride)
  const float* zeros;  // (kGradientMaps, stride)

  float* ring_row(int y) const { return ring + long(y % kRingSlots) * kGradientMaps * stride; }
};

inline vfloat load_columns(const float* p, int count) { return count >= kLanes ? load(p) : load_first(p, count); }
inline void store_columns(float* p, vfloat v, int count) { count >= kLanes ? store(p, v) : store_first(p, v, count); }

// Blurs `Maps` maps of one register of columns down kGroup rows. value(k, out): the maps of source row k.
template <int Maps, typename Value>
inline void blur_down(Value value, float* out, int stride) {
  vfloat total[kGroup][Maps] = {};
#pragma GCC unroll 16
  for (int k = 0; k < kSpan; ++k) {
    vfloat v[Maps];
    value(k, v);
#pragma GCC unroll 4
    for (int r = 0; r < kGroup; ++r) {
      if (k - r < 0 || k - r >= kTaps) continue;
#pragma GCC unroll 4
      for (int m = 0; m < Maps; ++m) total[r][m] = fma(broadcast(kWindow[k - r]), v[m], total[r][m]);
    }
  }
#pragma GCC unroll 4
  for (int r = 0; r < kGroup; ++r)
#pragma GCC unroll 4
    for (int m = 0; m < Maps; ++m) store(out + (r * Maps + m) * stride, total[r][m]);
}

inline vfloat blur_along(const float* row) {
  vfloat total = kWindow[0] * load(row - kRadius);
#pragma GCC unroll 16
  for (int k = 1; k < kTaps; ++k) total = fma(broadcast(kWindow[k]), load(row - kRadius + k), total);
  return total;
}

void statistics_down(const Plane& p, int y) {
  const float *image[kSpan], *target[kSpan];
  for (int k = 0; k < kSpan; ++k) {
    int row = y - kRadius + k;
    bool inside = row >= 0 && row < p.height;
    image[k] = inside ? p.image + long(row) * p.width : p.zeros;
    target[k] = inside ? p.target + long(row) * p.width : p.zeros;
  }
  auto column = [&](int x, auto read) {
    blur_down<4>([&](int k, vfloat* v) {
      vfloat a = read(image[k] + x), b = read(target[k] + x);
      v[0] = a + b;
      v[1] = a - b;
      v[2] = v[0] * v[0];
      v[3] = v[1] * v[1];
    }, p.blurred + kRowPad + x, p.stride);
  };
  int x = 0;
  for (; x + kLanes <= p.width; x += kLanes) column(x, [](const float* q) { return load(q); });
  int rest = p.width - x;
  if (rest > 0) column(x, [rest](const float* q) { return load_first(q, rest); });
}

struct Similarity {
  vfloat dissimilarity, m1, m2, m3;
};

inline Similarity compare(vfloat mean_sum, vfloat mean_difference, vfloat square_sum, vfloat square_difference) {
  vfloat mean_sum2 = mean_sum * mean_sum, mean_difference2 = mean_difference * mean_difference;
  // A variance is never negative, even with the window cut at the border; below 0 it is round-off.
  vfloat variance_sum = max(square_sum - mean_sum2, broadcast(0.f));
  vfloat variance_difference = max(square_difference - mean_difference2, broadcast(0.f));
  vfloat b1 = 0.5f * (mean_sum2 + mean_difference2) + kC1, b2 = 0.5f * (variance_sum + variance_difference) + kC2;
  vfloat a1 = b1 - mean_difference2, a2 = b2 - variance_difference;
  vfloat r1 = reciprocal(b1), r2 = reciprocal(b2), r12 = r1 * r2;
  Similarity out;
  out.dissimilarity = mean_difference2 * r1 + variance_difference * a1 * r12;
  out.m3 = 2.f * a1 * r12;
  out.m2 = out.m3 * variance_difference * r2;
  vfloat of_mean = a2 * mean_difference2 * r1 - a1 * variance_difference * r2;
  out.m1 = 2.f * r12 * (0.5f * (mean_sum + mean_difference) * of_mean - mean_difference * (a2 - a1));
  return out;
}

// One row along: its sum of 1 - SSIM; the gradient maps go to the ring, the picture of 1 - SSIM to `picture`.
template <bool Gradient>
double similarity_along(const Plane& p, int r, int y, float* picture) {
  const float* blurred = p.blurred + kRowPad + long(r) * 4 * p.stride;
  float* ring = p.ring_row(y);
  vfloat total{};
  for (int x = 0; x < p.width; x += kLanes) {
    int count = p.width - x;
    Similarity s = compare(blur_along(blurred + x), blur_along(blurred + p.stride + x),
                           blur_along(blurred + 2 * p.stride + x), blur_along(blurred + 3 * p.stride + x));
    if (count < kLanes) {  // lanes past the image would blur it onto zeros: they are not part of it
      vmask inside = first_lanes(count);
      s = {where(inside, s.dissimilarity), where(inside, s.m1), where(inside, s.m2), where(inside, s.m3)};
    }
    total += s.dissimilarity;
    if (Gradient) {
      store(ring + x, s.m1);
      store(ring + p.stride + x, s.m2);
      store(ring + 2 * p.stride + x, s.m3);
    }
    if (picture) store_columns(picture + x, s.dissimilarity, count);
  }
  return sum(total);
}

void gradient_down(const Plane& p, int y) {
  const float* rows[kSpan];
  for (int k = 0; k < kSpan; ++k) {
    int row = y - kRadius + k;
    rows[k] = row >= 0 && row < p.height ? p.ring_row(row) : p.zeros;
  }
  for (int x = 0; x < p.width; x += kLanes)
    blur_down<kGradientMaps>([&](int k, vfloat* v) {
#pragma GCC unroll 4
      for (int m = 0; m < kGradientMaps; ++m) v[m] = load(rows[k] + m * p.stride + x);
    }, p.blurred + kRowPad + x, p.stride);
}

inline vfloat signed_like(vfloat a, float magnitude) {
  vfloat zero{};
  return where(gt(a, zero), broadcast(magnitude)) - where(lt(a, zero), broadcast(magnitude));
}

// One row along: its sum of |x - y|, and the gradient of the whole loss.
double gradient_along(const Plane& p, const PhotometricArguments& a, int r, int y, float* gradient) {
  const float* blurred = p.blurred + kRowPad + long(r) * kGradientMaps * p.stride;
  const float *image = p.image + long(y) * p.width, *target = p.target + long(y) * p.width;
  vfloat total{};
  for (int x = 0; x < p.width; x += kLanes) {
    int count = p.width - x;
    vfloat value = load_columns(image + x, count), difference = value - load_columns(target + x, count);
    vfloat ssim = blur_along(blurred + x) + value * blur_along(blurred + p.stride + x) -
                  difference * blur_along(blurred + 2 * p.stride + x);
    total += abs(difference);
    store_columns(gradient + x, signed_like(difference, a.l1_scale) - a.dssim_scale * ssim, count);
  }
  return sum(total);
}

double difference_row(const float* image, const float* target, int width, float l1_scale, float* gradient) {
  vfloat total{};
  for (int x = 0; x < width; x += kLanes) {
    vfloat difference = load_columns(image + x, width - x) - load_columns(target + x, width - x);
    total += abs(difference);
    if (gradient) store_columns(gradient + x, signed_like(difference, l1_scale), width - x);
  }
  return sum(total);
}

// Rows [first, end) of one channel; the gradient maps of kRadius rows on either side are recomputed here.
template <bool Gradient>
void sweep(const PhotometricArguments& a, const Plane& p, int channel, int first, int end) {
  long plane_rows = long(channel) * a.height;
  int ready = Gradient ? (first > kRadius ? (first - kRadius) / kGroup * kGroup : 0) : first;
  for (int y = first; y < end; y += kGroup) {
    int needed = Gradient ? y + kGroup + kRadius : y + kGroup;
    if (needed > a.height) needed = a.height;
    for (; ready < needed; ready += kGroup) {
      statistics_down(p, ready);
      for (int r = 0; r < kGroup && ready + r < a.height; ++r) {
        bool own = ready + r >= first && ready + r < end;
        long row = plane_rows + ready + r;
        float* picture = own && a.dissimilarity ? a.dissimilarity + row * a.width : nullptr;
        double total = similarity_along<Gradient>(p, r, ready + r, picture);
        if (own) a.dssim_rows[row] = total;
      }
    }
    if (Gradient) gradient_down(p, y);
    for (int r = 0; r < kGroup && y + r < end; ++r) {
      long row = plane_rows + y + r, at = row * a.width;
      a.l1_rows[row] = Gradient ? gradient_along(p, a, r, y + r, a.gradient + at)
                                : difference_row(a.image + at, a.target + at, a.width, 0.f, nullptr);
    }
  }
}

}  // namespace

void photometric(const PhotometricArguments& a) {
  int rows = a.channels * a.height;
  if (!a.dssim_rows) {
    each_in_shares(a.threads, rows, [&](int64_t row) {
      long at = long(row) * a.width;
      float* gradient = a.gradient ? a.gradient + at : nullptr;
      a.l1_rows[row] = difference_row(a.image + at, a.target + at, a.width, a.l1_scale, gradient);
    });
    return;
  }
  constexpr int kLeastRows = 32;  // below that a chunk mostly computes its halo
  int chunks = a.threads, most = (a.height + kLeastRows - 1) / kLeastRows;
  if (chunks > most) chunks = most;
  int chunk_rows = ((a.height + chunks - 1) / chunks + kGroup - 1) / kGroup * kGroup;
  in_turns(a.threads, a.channels * chunks, 1, [&](int part, Turns& turns) {
    Plane p;
    p.height = a.height;
    p.width = a.width;
    p.stride = padded_width(a.width);
    p.blurred = a.scratch + part * photometric_scratch(a.width);
    p.ring = p.blurred + kBlurRows * p.stride;
    float* zeros = p.ring + kRingSlots * kGradientMaps * p.stride;
    p.zeros = zeros;
    memset(p.blurred, 0, sizeof(float) * kBlurRows * p.stride);
    memset(zeros, 0, sizeof(float) * kGradientMaps * p.stride);
    for (int64_t item, after; turns.next(item, after);) {
      int channel = int(item / chunks), first = int(item % chunks) * chunk_rows;
      int end = first + chunk_rows < a.height ? first + chunk_rows : a.height;
      p.image = a.image + long(channel) * a.height * a.width;
      p.target = a.target + long(channel) * a.height * a.width;
      if (first >= end) continue;
      if (a.gradient) sweep<true>(a, p, channel, first, end);
      else sweep<false>(a, p, channel, first, end);
    }
  });
}

}  // namespace rtgs::RTGS_ISA
