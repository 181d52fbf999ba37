// One register of floats for each instruction set: AVX-512 (16 lanes), AVX2 (8), anything else through the compiler's
// vector types (4). Include it in kernel files only; they are compiled once per set into the namespace rtgs::<isa>.
//
// vfloat and vint have the usual operators, also with a scalar on one side: `v * 2.f + w`. A comparison gives a vmask
// through ge/gt/lt/le/eq (not through >=); masks combine with & | and mask_not. Notes on -ffast-math: `/` and sqrt may
// be Newton-refined estimates (1-2 ulp, 1/0 is NaN), comparisons with NaN are false as they should be.
#pragma once
#include <cstdint>
#include <cstring>
#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace rtgs::RTGS_ISA {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float vfloat __attribute__((vector_size(4 * kLanes)));
typedef int32_t vint __attribute__((vector_size(4 * kLanes)));
#if defined(__AVX512F__)
typedef __mmask16 vmask;
#else
typedef vint vmask;  // all bits of a lane, or none
#endif

// ---- making, loading, storing ----------------------------------------------------------------------------------
static inline vfloat broadcast(float a) { return vfloat{} + a; }
static inline vint broadcast_int(int32_t a) { return vint{} + a; }
static inline vfloat load(const float* p) {  // any alignment
  vfloat v;
  memcpy(&v, p, sizeof v);
  return v;
}
static inline void store(float* p, vfloat v) { memcpy(p, &v, sizeof v); }
static inline vint load_int(const int32_t* p) {
  vint v;
  memcpy(&v, p, sizeof v);
  return v;
}
static inline vfloat lane_numbers() {  // 0, 1, 2, ...
  vfloat v;
  for (int lane = 0; lane < kLanes; ++lane) v[lane] = float(lane);
  return v;
}
static inline vfloat to_float(vint a) { return __builtin_convertvector(a, vfloat); }
static inline vint truncate(vfloat a) { return __builtin_convertvector(a, vint); }

#if defined(__AVX512F__)
// ---- AVX-512 ---------------------------------------------------------------------------------------------------
static inline vmask ge(vfloat a, vfloat b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GE_OQ); }
static inline vmask gt(vfloat a, vfloat b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ); }
static inline vmask eq(vfloat a, vfloat b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_EQ_OQ); }
static inline vmask eq_int(vint a, vint b) { return _mm512_cmpeq_epi32_mask((__m512i)a, (__m512i)b); }
static inline vmask gt_int(vint a, vint b) { return _mm512_cmpgt_epi32_mask((__m512i)a, (__m512i)b); }
static inline vint select_int(vmask m, vint a, vint b) { return (vint)_mm512_mask_blend_epi32(m, (__m512i)b, (__m512i)a); }
static inline vmask mask_not(vmask m) { return vmask(~m); }
static inline bool any(vmask m) { return m != 0; }
static inline uint32_t mask_bits(vmask m) { return m; }
static inline vmask first_lanes(int count) { return vmask(count >= 16 ? 0xffff : (1u << count) - 1); }
static inline vfloat select(vmask m, vfloat a, vfloat b) { return (vfloat)_mm512_mask_blend_ps(m, (__m512)b, (__m512)a); }
static inline vfloat where(vmask m, vfloat a) { return (vfloat)_mm512_maskz_mov_ps(m, (__m512)a); }  // else 0
static inline vfloat min(vfloat a, vfloat b) { return (vfloat)_mm512_min_ps((__m512)a, (__m512)b); }
static inline vfloat max(vfloat a, vfloat b) { return (vfloat)_mm512_max_ps((__m512)a, (__m512)b); }
static inline vfloat fma(vfloat a, vfloat b, vfloat c) { return (vfloat)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c); }
static inline vfloat round(vfloat a) { return (vfloat)_mm512_roundscale_ps((__m512)a, 8); }
static inline vfloat floor(vfloat a) { return (vfloat)_mm512_roundscale_ps((__m512)a, 9); }
static inline vfloat fraction(vfloat a) { return (vfloat)_mm512_reduce_ps((__m512)a, 1); }  // a - floor(a)
static inline vfloat sqrt(vfloat a) { return (vfloat)_mm512_sqrt_round_ps((__m512)a, 8); }
static inline vfloat scale_by_power(vfloat a, vfloat n) { return (vfloat)_mm512_scalef_ps((__m512)a, (__m512)n); }
static inline vfloat gather(const float* p, vint index) { return (vfloat)_mm512_i32gather_ps((__m512i)index, p, 4); }
static inline vint gather_int(const int32_t* p, vint index) { return (vint)_mm512_i32gather_epi32((__m512i)index, p, 4); }
static inline void scatter(float* p, vint index, vfloat v, vmask m) { _mm512_mask_i32scatter_ps(p, m, (__m512i)index, (__m512)v, 4); }
static inline void scatter_int(int32_t* p, vint index, vint v, vmask m) {
  _mm512_mask_i32scatter_epi32(p, m, (__m512i)index, (__m512i)v, 4);
}
static inline vint min_int(vint a, vint b) { return (vint)_mm512_min_epi32((__m512i)a, (__m512i)b); }
static inline vint max_int(vint a, vint b) { return (vint)_mm512_max_epi32((__m512i)a, (__m512i)b); }
static inline float smallest(vfloat a) { return _mm512_reduce_min_ps((__m512)a); }
static inline vfloat load_first(const float* p, int count) { return (vfloat)_mm512_maskz_loadu_ps(first_lanes(count), p); }
static inline void store_first(float* p, vfloat v, int count) { _mm512_mask_storeu_ps(p, first_lanes(count), (__m512)v); }
// 1/a within 1.5 ulp for normal a (estimate and one Newton step); a = 0 or inf gives NaN.
static inline vfloat reciprocal(vfloat a) {
  __m512 r = _mm512_rcp14_ps((__m512)a);
  __m512 e = _mm512_fnmadd_ps((__m512)a, r, _mm512_set1_ps(1.f));
  return (vfloat)_mm512_fmadd_ps(r, e, r);
}

#elif defined(__AVX2__)
// ---- AVX2 ------------------------------------------------------------------------------------------------------
static inline vmask ge(vfloat a, vfloat b) { return (vmask)_mm256_cmp_ps((__m256)a, (__m256)b, _CMP_GE_OQ); }
static inline vmask gt(vfloat a, vfloat b) { return (vmask)_mm256_cmp_ps((__m256)a, (__m256)b, _CMP_GT_OQ); }
static inline vmask eq(vfloat a, vfloat b) { return (vmask)_mm256_cmp_ps((__m256)a, (__m256)b, _CMP_EQ_OQ); }
static inline vmask eq_int(vint a, vint b) { return a == b; }
static inline vmask gt_int(vint a, vint b) { return a > b; }
static inline vint select_int(vmask m, vint a, vint b) { return (a & m) | (b & ~m); }
static inline vmask mask_not(vmask m) { return ~m; }
static inline bool any(vmask m) { return _mm256_movemask_ps((__m256)m) != 0; }
static inline uint32_t mask_bits(vmask m) { return uint32_t(_mm256_movemask_ps((__m256)m)); }
static inline vmask first_lanes(int count) { return vint{0, 1, 2, 3, 4, 5, 6, 7} < count; }
static inline vfloat select(vmask m, vfloat a, vfloat b) { return (vfloat)_mm256_blendv_ps((__m256)b, (__m256)a, (__m256)m); }
static inline vfloat where(vmask m, vfloat a) { return (vfloat)((vint)a & m); }  // else 0
static inline vfloat min(vfloat a, vfloat b) { return (vfloat)_mm256_min_ps((__m256)a, (__m256)b); }
static inline vfloat max(vfloat a, vfloat b) { return (vfloat)_mm256_max_ps((__m256)a, (__m256)b); }
static inline vfloat fma(vfloat a, vfloat b, vfloat c) { return (vfloat)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c); }
static inline vfloat round(vfloat a) { return (vfloat)_mm256_round_ps((__m256)a, 8); }
static inline vfloat floor(vfloat a) { return (vfloat)_mm256_round_ps((__m256)a, 9); }
static inline vfloat fraction(vfloat a) { return a - floor(a); }
static inline vfloat sqrt(vfloat a) { return (vfloat)_mm256_sqrt_ps((__m256)a); }
static inline vfloat scale_by_power(vfloat a, vfloat n) {  // n whole; result a 2^n for n in [-126, 127]
  __m256i e = _mm256_slli_epi32(_mm256_cvtps_epi32((__m256)n), 23);
  return a * (vfloat)_mm256_castsi256_ps(_mm256_add_epi32(e, _mm256_set1_epi32(127 << 23)));
}
static inline vfloat gather(const float* p, vint index) { return (vfloat)_mm256_i32gather_ps(p, (__m256i)index, 4); }
static inline vint gather_int(const int32_t* p, vint index) { return (vint)_mm256_i32gather_epi32(p, (__m256i)index, 4); }
static inline vint min_int(vint a, vint b) { return (vint)_mm256_min_epi32((__m256i)a, (__m256i)b); }
static inline vint max_int(vint a, vint b) { return (vint)_mm256_max_epi32((__m256i)a, (__m256i)b); }
static inline float smallest(vfloat a) {
  __m128 q = _mm_min_ps(_mm256_castps256_ps128((__m256)a), _mm256_extractf128_ps((__m256)a, 1));
  q = _mm_min_ps(q, _mm_movehl_ps(q, q));
  return _mm_cvtss_f32(_mm_min_ss(q, _mm_movehdup_ps(q)));
}
static inline vfloat load_first(const float* p, int count) {
  return (vfloat)_mm256_maskload_ps(p, (__m256i)first_lanes(count));
}
static inline void store_first(float* p, vfloat v, int count) {
  _mm256_maskstore_ps(p, (__m256i)first_lanes(count), (__m256)v);
}
static inline vfloat reciprocal(vfloat a) { return 1.f / a; }

#else
// ---- portable: 4 lanes, what SSE2 and NEON hold ----------------------------------------------------------------
static inline vmask ge(vfloat a, vfloat b) { return a >= b; }
static inline vmask gt(vfloat a, vfloat b) { return a > b; }
static inline vmask eq(vfloat a, vfloat b) { return a == b; }
static inline vmask eq_int(vint a, vint b) { return a == b; }
static inline vmask gt_int(vint a, vint b) { return a > b; }
static inline vint select_int(vmask m, vint a, vint b) { return (a & m) | (b & ~m); }
static inline vmask mask_not(vmask m) { return ~m; }
static inline bool any(vmask m) { return (m[0] | m[1] | m[2] | m[3]) != 0; }
static inline uint32_t mask_bits(vmask m) {
  return uint32_t((m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8));
}
static inline vmask first_lanes(int count) { return vint{0, 1, 2, 3} < count; }
static inline vfloat select(vmask m, vfloat a, vfloat b) { return (vfloat)(((vint)a & m) | ((vint)b & ~m)); }
static inline vfloat where(vmask m, vfloat a) { return (vfloat)((vint)a & m); }  // else 0
static inline vfloat min(vfloat a, vfloat b) { return select(a < b, a, b); }
static inline vfloat max(vfloat a, vfloat b) { return select(a > b, a, b); }
static inline vfloat fma(vfloat a, vfloat b, vfloat c) { return a * b + c; }  // rounds twice
static inline vfloat round(vfloat a) {                                       // |a| < 2^31; halves away from zero
  return to_float(truncate(a + select(a >= broadcast(0.f), broadcast(0.5f), broadcast(-0.5f))));
}
static inline vfloat floor(vfloat a) {  // |a| < 2^31
  vfloat whole = to_float(truncate(a));
  return whole - where(whole > a, broadcast(1.f));
}
static inline vfloat fraction(vfloat a) { return a - floor(a); }
static inline vfloat sqrt(vfloat a) {
  for (int lane = 0; lane < kLanes; ++lane) a[lane] = __builtin_sqrtf(a[lane]);
  return a;
}
static inline vfloat scale_by_power(vfloat a, vfloat n) { return a * (vfloat)((truncate(n) + 127) << 23); }
static inline vfloat gather(const float* p, vint index) { return vfloat{p[index[0]], p[index[1]], p[index[2]], p[index[3]]}; }
static inline vint gather_int(const int32_t* p, vint index) { return vint{p[index[0]], p[index[1]], p[index[2]], p[index[3]]}; }
static inline vint min_int(vint a, vint b) { return select_int(a < b, a, b); }
static inline vint max_int(vint a, vint b) { return select_int(a > b, a, b); }
static inline float smallest(vfloat a) {
  const float p = a[0] < a[1] ? a[0] : a[1], q = a[2] < a[3] ? a[2] : a[3];
  return p < q ? p : q;
}
static inline vfloat load_first(const float* p, int count) {
  vfloat v{};
  for (int lane = 0; lane < kLanes; ++lane)
    if (lane < count) v[lane] = p[lane];
  return v;
}
static inline void store_first(float* p, vfloat v, int count) {
  for (int lane = 0; lane < kLanes; ++lane)
    if (lane < count) p[lane] = v[lane];
}
static inline vfloat reciprocal(vfloat a) { return 1.f / a; }
#endif

// ---- for all sets ----------------------------------------------------------------------------------------------
static inline vmask lt(vfloat a, vfloat b) { return gt(b, a); }
static inline vmask le(vfloat a, vfloat b) { return ge(b, a); }
static inline vfloat abs(vfloat a) { return (vfloat)((vint)a & 0x7fffffff); }
static inline vfloat clamp(vfloat a, float low, float high) { return min(max(a, broadcast(low)), broadcast(high)); }

#if !defined(__AVX512F__)
// p[index[lane]] = v[lane] where m; of lanes with the same index the last one stays.
static inline void scatter(float* p, vint index, vfloat v, vmask m) {
  for (uint32_t lanes = mask_bits(m); lanes; lanes &= lanes - 1) p[index[__builtin_ctz(lanes)]] = v[__builtin_ctz(lanes)];
}
static inline void scatter_int(int32_t* p, vint index, vint v, vmask m) {
  for (uint32_t lanes = mask_bits(m); lanes; lanes &= lanes - 1) p[index[__builtin_ctz(lanes)]] = v[__builtin_ctz(lanes)];
}
#endif
static inline vfloat negated_where(vmask m, vfloat a) { return (vfloat)((vint)a ^ select_int(m, broadcast_int(INT32_MIN), broadcast_int(0))); }
static inline float largest(vfloat a) { return -smallest(-a); }
static inline vmask lanes_from_bits(uint32_t bits) {
#if defined(__AVX512F__)
  return vmask(bits);
#else
  vint bit;  // of each lane: a constant
  for (int lane = 0; lane < kLanes; ++lane) bit[lane] = 1 << lane;
  return (broadcast_int(int32_t(bits)) & bit) == bit;
#endif
}

// 16-bit integers, one per lane.
typedef uint16_t vshort __attribute__((vector_size(2 * kLanes)));
static inline void store_short(uint16_t* p, vint a) {
  const vshort v = __builtin_convertvector(a, vshort);
  memcpy(p, &v, sizeof v);
}
static inline vint load_short(const uint16_t* p) {
  vshort v;
  memcpy(&v, p, sizeof v);
  return __builtin_convertvector(v, vint);
}

// Lane k = p[k * stride]: one component of kLanes consecutive rows.
static inline vfloat load_strided(const float* p, int stride) { return gather(p, truncate(lane_numbers()) * stride); }

// The value, of which fast-math may not reason how it came about.
static inline vfloat as_rounded(vfloat a) {
#if defined(__clang__)
  return __arithmetic_fence(a);
#else
  return __builtin_assoc_barrier(a);
#endif
}

// exp(a), relative error <= 3e-7 (portable: 4e-6 where |a| is large); a is clamped to [-87, 88].
static inline vfloat exp(vfloat a) {
  constexpr float kLog2E = 1.44269504088896341f, kLog2ERest = 1.925963033500e-8f;
  a = clamp(a, -87.f, 88.f);
  vfloat t = as_rounded(a * kLog2E), n = round(t);
  vfloat lost = fma(a, broadcast(kLog2ERest), fma(a, broadcast(kLog2E), -t));  // by rounding t and log2(e)
  vfloat f = as_rounded(t - n) + as_rounded(lost);
  vfloat p = broadcast(0.0001534581242594868f);        // minimax polynomial of 2^f on [-1/2, 1/2]
  p = fma(p, f, broadcast(0.0013399930903688073f));
  p = fma(p, f, broadcast(0.009618489071726799f));
  p = fma(p, f, broadcast(0.05550328642129898f));
  p = fma(p, f, broadcast(0.24022646248340607f));
  p = fma(p, f, broadcast(0.6931471824645996f));
  p = fma(p, f, broadcast(1.f));
  return scale_by_power(p, n);
}
static inline vfloat sigmoid(vfloat a) { return 1.f / (1.f + exp(-a)); }

// 2^x, relative error 1e-7, for x <= 127; below 2^-100 it may stop falling.
static inline vfloat exp2_response(vfloat x) {
  if (kLanes < 16) x = max(x, broadcast(-100.f));  // the AVX-512 instruction takes any exponent
  vfloat f = fraction(x);
  vfloat p = broadcast(0.0018775766948238015f);  // minimax polynomial of 2^f on [0, 1)
  p = fma(p, f, broadcast(0.00898933969438076f));
  p = fma(p, f, broadcast(0.05582631751894951f));
  p = fma(p, f, broadcast(0.24015361070632935f));
  p = fma(p, f, broadcast(0.6931530833244324f));
  p = fma(p, f, broadcast(0.9999999403953552f));
  return scale_by_power(p, kLanes < 16 ? x - f : x);
}

// True where a is neither NaN nor infinite (on the bits: fast-math cannot fold it).
static inline vmask finite(vfloat a) { return gt_int(broadcast_int(0x7f800000), (vint)a & 0x7fffffff); }

// log2(a) for normal positive a, error <= 1e-7 of max(1, |result|).
static inline vfloat log2(vfloat a) {
  vint bits = (vint)a, exponent = (bits - 0x3f3504f3) >> 23;  // mantissa in [sqrt(1/2), sqrt(2))
  vfloat m = (vfloat)(bits - (exponent << 23));
  vfloat s = (m - 1.f) / (m + 1.f), q = s * s;  // log2(m) = 2 log2(e) artanh(s)
  vfloat p = broadcast(0.32059889f);
  p = fma(p, q, broadcast(0.41219859f));
  p = fma(p, q, broadcast(0.57707802f));
  p = fma(p, q, broadcast(0.96179669f));
  p = fma(p, q, broadcast(2.88539008f));
  return fma(p, s, to_float(exponent));
}

// ---- horizontal sums -------------------------------------------------------------------------------------------
template <int...>
struct LaneList {};
template <int N, int... I>
struct MakeLanes : MakeLanes<N - 1, N - 1, I...> {};
template <int... I>
struct MakeLanes<0, I...> {
  typedef LaneList<I...> type;
};

// From every group of 2 S lanes the first (Half 0) or second (Half 1) S lanes: of a into the first half of the result's
// group, of b into its second half.
template <int S, int Half, int... I>
static inline vfloat zip_groups(vfloat a, vfloat b, LaneList<I...>) {
  constexpr auto lane = [](int i) { return (i % (2 * S) < S ? 0 : kLanes - S) + i + Half * S; };
#if defined(__clang__)
  return __builtin_shufflevector(a, b, lane(I)...);
#else
  return __builtin_shuffle(a, b, vint{lane(I)...});
#endif
}
template <int S, int Half>
static inline vfloat zip_groups(vfloat a, vfloat b) {
  return zip_groups<S, Half>(a, b, typename MakeLanes<kLanes>::type{});
}
template <int S>
static inline vfloat add_groups(vfloat a, vfloat b) {
  return zip_groups<S, 0>(a, b) + zip_groups<S, 1>(a, b);
}

// Transpose and add: lane k of the result is the sum over the lanes of v[k], k = 0 .. kLanes - 1, in a fixed order.
template <int S = kLanes / 2>
static inline vfloat sums_of(const vfloat* v) {
  vfloat half[S];
#pragma GCC unroll 16
  for (int k = 0; k < S; ++k) half[k] = add_groups<S>(v[k], v[k + S]);
  if constexpr (S == 1) return half[0];
  else return sums_of<S / 2>(half);
}
static inline float sum(vfloat a) {  // by halves
#if defined(__AVX512F__)
  return _mm512_reduce_add_ps((__m512)a);
#elif defined(__AVX2__)
  __m128 q = _mm_add_ps(_mm256_castps256_ps128((__m256)a), _mm256_extractf128_ps((__m256)a, 1));
  q = _mm_add_ps(q, _mm_movehl_ps(q, q));
  return _mm_cvtss_f32(_mm_add_ss(q, _mm_movehdup_ps(q)));
#else
  return (a[0] + a[2]) + (a[1] + a[3]);
#endif
}

// The value as computed: fast-math may not regroup the additions behind it with those of what it is added to next.
static inline vfloat settled(vfloat a) {
#if defined(__AVX2__)
  asm("" : "+v"(a));
#else
  asm("" : "+m"(a));
#endif
  return a;
}
static inline float settled(float a) {
  asm("" : "+m"(a));
  return a;
}

}  // namespace rtgs::RTGS_ISA
